"""Fit of networks to observations with other parts, as a league's `after_parts` says.

The inputs of a network follow the parts of an observation by their names. Parts that it has never seen begin without
effect, and those that are gone have none, so the policy acts at first as it did where it learnt.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from arenas.description import Part, Place, first_numbers

EVERY = "*"
"""The entry of `after_parts` for all parts of equal name and size."""


class Fit(NamedTuple):
    """A network's inputs for another observation."""

    places: np.ndarray  # (n,) int: for each number of the observation here its place there; -1: it is new
    kept: tuple[str, ...]  # parts that it sees as before; THERE as HERE, where it is another one
    new: tuple[str, ...]  # parts here that it has never seen
    lost: tuple[str, ...]  # parts there of which it sees none here

    def __str__(self) -> str:
        sentences = {"they see": self.kept, "new to them": self.new, "no longer seen": self.lost}
        return "; ".join(f"{what}: {', '.join(names)}" for what, names in sentences.items() if names)


def fit(there: Sequence[Part], here: Sequence[Part], named: Iterable[str]) -> Fit | None:
    """Return the fit of a network that saw the parts `there` to an observation of the parts `here`.

    Args:
        there: parts of the observation from which it learnt.
        here: parts of the agent's observation now.
        named: names of parts that both have; THERE=HERE for parts whose names differ; `EVERY`.

    Returns:
        None if both observations have the same parts in the same order: then nothing is to be fitted.

    Raises:
        ValueError: a named part is not there, not here, or has another size here; one line.
    """
    if [part[:2] for part in there] == [part[:2] for part in here]:
        return None
    pairs = _pairs(there, here, named)
    firsts, sizes = first_numbers(there), [part.size for part in here]
    sources = [pairs.get(place) for place in first_numbers(here)]
    places = [
        np.full(size, -1) if source is None else firsts[source] + np.arange(size)
        for size, source in zip(sizes, sources, strict=True)
    ]
    seen = {source for source in sources if source is not None}
    kept = [
        part.name if source[0] == part.name else f"{source[0]} as {part.name}"
        for part, source in zip(here, sources, strict=True)
        if source is not None
    ]
    new = [part.name for part, source in zip(here, sources, strict=True) if source is None]
    lost = [place[0] for place in firsts if place not in seen]
    return Fit(np.concatenate(places).astype(np.int32), tuple(kept), tuple(new), tuple(lost))


def _pairs(there: Sequence[Part], here: Sequence[Part], named: Iterable[str]) -> dict[Place, Place]:
    """Return for each part here the part there that stands for it. Raises ValueError, one line."""
    known, own, pairs = list(first_numbers(there)), list(first_numbers(here)), dict[Place, Place]()
    for text in named:
        before, _, now = text.partition("=")
        if text == EVERY:
            continue
        sources, targets = _called(before, known, "where it learnt"), _called(now or before, own, "here")
        if [place[1] for place in sources] != [place[1] for place in targets]:
            raise ValueError(f"{text}: {_sized(sources)} where it learnt, and {_sized(targets)} here")
        pairs |= dict(zip(targets, sources, strict=True))
    taken = set(pairs.values())
    if EVERY in named:
        pairs |= {place: place for place in own if place not in pairs and place in known and place not in taken}
    return pairs


def _called(name: str, places: Sequence[Place], where: str) -> list[Place]:
    """Return the parts of that name, in their order. Raises ValueError if there is none."""
    found = [place for place in places if place[0] == name]
    if not found:
        names = ", ".join(dict.fromkeys(place[0] for place in places))
        raise ValueError(f"{name}: no part of the observation {where} has this name; it has {names}")
    return found


def _sized(places: Sequence[Place]) -> str:
    sizes = " and ".join(str(size) for _, size, _ in places)
    return f"{places[0][0]} has {sizes} numbers"
