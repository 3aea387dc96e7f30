"""The share of void episodes among a league's newest, with causes and the setting to raise.

Reads the store. The words for causes come from the arenas, which are imported only if there are void episodes.
"""

import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import NamedTuple

from storage.records import RATED_PURPOSES, CurvePoint
from storage.store import Store

LIMIT = 0.01
"""Share of void episodes above which a league warns."""
ITERATIONS, MATCHES = 50, 200
"""Number of newest iterations of each player, and of newest matches, that are counted."""
FEWEST = 100
"""Minimum number of episodes, void ones included, for a meaningful share."""


class Voids(NamedTuple):
    """Void episodes of training or of matches."""

    what: str  # training or rating
    void: int
    episodes: int  # void ones included
    causes: tuple[int, ...] = ()  # bits of arenas.physics.void_causes, the most frequent first
    arena: str = "ARENA"  # its name, if known

    @property
    def share(self) -> float:
        """Share of void episodes; 0 if there are no episodes."""
        return self.void / max(self.episodes, 1)

    @property
    def warns(self) -> bool:
        """True if the share deserves a warning."""
        return self.episodes >= FEWEST and self.share > LIMIT

    @property
    def short(self) -> str:
        """The share in a few words, e.g. `83 % of training void`."""
        return f"{100 * self.share:.{0 if self.share > 0.1 else 1}f} % of {self.what} void"

    @property
    def describe(self) -> str:
        """The share with its causes and a remedy, in words."""
        from arenas.physics.void_causes import Cause, describe_causes

        why = describe_causes(map(Cause, self.causes)) or "of a cause that was not recorded"
        return f"{100 * self.share:.1f} % of the newest {self.episodes:,} {self.what} episodes were void: {why}."


def found(store: Store, league: str, training: Iterable[Mapping[str, int]]) -> tuple[Voids, ...]:
    """Return the void episodes of the newest training and of the newest rated matches, if they deserve a warning.

    `training` has the `sums` of each player.
    """
    rated = store.voids(league, RATED_PURPOSES, after=store.last_match(league) - MATCHES)
    warned = [each for each in (of_training(training), of_matches(rated)) if each.warns]
    arena = _arena(store.league(league).config) if warned else ""
    return tuple(each._replace(arena=arena) if arena else each for each in warned)


def sums(points: Iterable[CurvePoint]) -> Counter[str]:
    """Return the sums of the metrics that count episodes and void ones, over some training iterations."""
    found: Counter[str] = Counter()
    for point in points:
        found.update({name: int(n) for name, n in point.values.items() if name.startswith(("episodes", "void"))})
    return found


def of_training(parts: Iterable[Mapping[str, int]]) -> Voids:
    """Count the void episodes of training from the `sums` of each player."""
    total: Counter[str] = Counter()
    for part in parts:
        total.update(part)
    causes: Counter[int] = Counter()
    if total["voids"]:
        from arenas.physics.void_causes import METRIC_PREFIX, Cause

        causes = Counter({int(cause): total[f"{METRIC_PREFIX}{cause.key}"] for cause in Cause})
    return Voids("training", total["voids"], total["voids"] + total["episodes"], _often(causes))


def of_matches(rows: Iterable[tuple[int, int, int]]) -> Voids:
    """Count the void episodes of matches, given as rows of (mask of causes, void episodes, other episodes)."""
    causes: Counter[int] = Counter()
    void = others = 0
    for mask, bad, sound in rows:
        void, others = void + bad, others + sound
        causes.update({1 << bit: bad for bit in range(mask.bit_length()) if mask >> bit & 1})
    return Voids("rating", void, void + others, _often(causes))


def names(mask: int) -> str:
    """Return the keys of the causes in a mask, e.g. `pairs+rows`; empty if there are none."""
    if not mask:
        return ""
    from arenas.physics.void_causes import causes_in

    return "+".join(cause.key for cause in causes_in(mask))


def warnings(voids: Iterable[Voids]) -> list[str]:
    """Return a line for each, and a hint on how to find sizes if a setting helps."""
    lines = {each.describe: each.arena for each in voids}
    helped = [arena for line, arena in lines.items() if "raise buffers." in line]
    check = [f"`league check {arena} --engine warp` says which sizes untrained play needs." for arena in helped[:1]]
    return [*lines, *check]


def _arena(config_toml: str) -> str:
    """Return the name of the arena in a league's settings; empty if they have none."""
    with suppress(ValueError, RecursionError, KeyError, TypeError):
        return str(tomllib.loads(config_toml)["arena"]["name"])
    return ""


def _often(causes: Counter[int]) -> tuple[int, ...]:
    return tuple(cause for cause, n in causes.most_common() if n)
