"""Episodes that a benchmark plays after training, more than a league would: who played whom, and the scores told."""

import time
from collections.abc import Sequence
from dataclasses import replace

from league.config.experiment import Config
from league.evaluate import Referee
from league.jobs import RatingMatch
from matchmaking.ladder import Ladder
from matchmaking.payoff import Score
from storage.records import Snapshot
from storage.store import Store

Pair = tuple[Snapshot, Snapshot | None]
"""Two who meet; in an arena of one team the second is None."""


def rate(
    store: Store, config: Config, league: str, pairs: Sequence[Pair], episodes: int, worlds: int = 4096
) -> tuple[Ladder, int, float]:
    """Play pairs for so many episodes each, at most `worlds` at once: the ladder, void episodes and seconds.

    Compiling is not in the seconds.
    """
    pairings = min(len(pairs), max(1, worlds // episodes))
    config = replace(config, rating=replace(config.rating, worlds=pairings * episodes, pairings=pairings, record=False))
    arena = config.arena.build(engine=config.engine, worlds=config.rating.worlds)
    referee = Referee(config, arena, league)
    names = tuple((a.name, None if b is None else b.name) for a, b in pairs)
    referee.play(store, RatingMatch(names[:1], 0))  # compiles
    began, matches = time.monotonic(), []
    for i in range(0, len(names), pairings):
        matches += referee.play(store, RatingMatch(names[i : i + pairings], 20_000 + i))
    return Ladder((), matches), sum(m.voids for m in matches), time.monotonic() - began


def bare(toml: str) -> str:
    """A configuration without its comments."""
    return "\n".join(line for line in toml.splitlines() if line and not line.startswith("#"))


def score(ladder: Ladder, snapshot: Snapshot, other: Snapshot | None) -> dict:
    """Score with its 95 % interval, and how many games were drawn; how often it succeeds in an arena of one team."""
    found: Score = ladder.success(snapshot.name) if other is None else ladder.score(snapshot.name, other.name)
    told = {"score": round(found.score, 4), "low": round(found.low, 4), "high": round(found.high, 4), "n": found.games}
    if other is None:
        return told
    payoff = ladder.payoff
    a, b = payoff.index(snapshot.name), payoff.index(other.name)
    return told | {"draws": int(payoff.draws[a, b])}
