"""The curriculum and the stage of a league, from its name and the store. Reads settings as text only."""

import tomllib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from storage.store import Store


class Course(NamedTuple):
    """A curriculum: the name of the league that has the stages, and the names of the stages."""

    root: str
    stages: tuple[str, ...]


def course(store: Store, league: str) -> Course | None:
    """Return the curriculum that a league is, or is a stage of (`main.walk` of `main`); None for any other league."""
    there = {each.name: each.config for each in store.leagues()}
    own = stages_of(there.get(league, ""))
    if own:
        return Course(league, own)
    for at, letter in reversed(list(enumerate(league))):
        root, name = league[:at], league[at + 1 :]
        if letter == "." and name in (stages := stages_of(there.get(root, ""))):
            return Course(root, stages)
    return None


def at_work(store: Store, league: str) -> str:
    """Return the league that a name means: for a curriculum its newest stage in the store, else the league itself."""
    there = {each.name: each.config for each in store.leagues()}
    begun = [f"{league}.{name}" for name in stages_of(there.get(league, "")) if f"{league}.{name}" in there]
    return begun[-1] if begun else league


def stages_of(text: str) -> tuple[str, ...]:
    """Return the names of the stages in a league's settings; empty if it has no stages or the text is invalid."""
    try:
        tables: Sequence[Mapping[str, Any]] = tomllib.loads(text).get("stages", ())
        return tuple(str(table["name"]) for table in tables)
    except (ValueError, RecursionError, KeyError, TypeError, AttributeError):
        return ()
