"""Episodes that an experiment plays after training, more than a league would, and their scores."""

import time
from collections.abc import Sequence
from dataclasses import replace

from league.config.experiment import Config
from league.matches.evaluator import MatchEvaluator
from league.state.jobs import RatingMatch
from matchmaking.ratings.ladder import Ladder
from matchmaking.ratings.scores import Score
from storage.records import Snapshot
from storage.store import Store

Pair = tuple[Snapshot, Snapshot | None]
"""Two opponents; in an arena of one team the second is None."""


def rate(
    store: Store, config: Config, league: str, pairs: Sequence[Pair], episodes: int, worlds: int = 4096
) -> tuple[Ladder, int, float]:
    """Play `episodes` of each pair, at most `worlds` at once.

    Returns:
        The ladder, the number of void episodes, and the seconds without compilation.
    """
    pairings = min(len(pairs), max(1, worlds // episodes))
    config = replace(config, rating=replace(config.rating, worlds=pairings * episodes, pairings=pairings, record=False))
    arena = config.arena.build(engine=config.engine, worlds=config.rating.worlds)
    evaluator = MatchEvaluator(config, arena, league)
    names = tuple((a.name, None if b is None else b.name) for a, b in pairs)
    evaluator.play(store, RatingMatch(names[:1], 0))  # compiles
    began, matches = time.monotonic(), []
    for i in range(0, len(names), pairings):
        matches += evaluator.play(store, RatingMatch(names[i : i + pairings], 20_000 + i))
    return Ladder((), matches), sum(m.voids for m in matches), time.monotonic() - began


def bare(toml: str) -> str:
    """Return a configuration without its comments."""
    return "\n".join(line for line in toml.splitlines() if line and not line.startswith("#"))


def score(ladder: Ladder, snapshot: Snapshot, other: Snapshot | None) -> dict:
    """Return the score with its 95 % interval, and the draws; in an arena of one team the share of successes."""
    found: Score = ladder.success(snapshot.name) if other is None else ladder.score(snapshot.name, other.name)
    row = {"score": round(found.score, 4), "low": round(found.low, 4), "high": round(found.high, 4), "n": found.games}
    if other is None:
        return row
    payoff = ladder.payoff
    a, b = payoff.index(snapshot.name), payoff.index(other.name)
    return row | {"draws": int(payoff.draws[a, b])}
