"""The newest part of each player's learning curve, as the plan takes it: read again only for those that went on.

A curve grows only in the transaction that writes its player's checkpoint, so an equal checkpoint means an equal curve.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

from league.state import void_rates
from matchmaking.ratings.scores import Score
from matchmaking.schedule import phase_score
from storage.records import Checkpoint, CurvePoint, Phase
from storage.store import Store

ENOUGH = 128
"""Training episodes from which a share of successes is computed."""


@dataclass(frozen=True)
class RecentCurve:
    """The newest part of a player's learning curve, at a checkpoint and in a phase."""

    at: Checkpoint | None = None
    phase: Phase | None = None  # that ends by the player's score; None if none does
    recent: int = 0  # learning iterations over which reward and success are averaged
    voids: Mapping[str, int] = field(default_factory=dict)  # sums over the newest void_rates.ITERATIONS
    reward: float | None = None  # per episode; None with fewer iterations or without an ended episode
    success: float | None = None  # share of ENOUGH or more ended episodes
    score: Score | None = None  # in the phase


def read(
    store: Store,
    league: str,
    checkpoints: Mapping[str, Checkpoint],
    phases: Mapping[str, Phase],
    recent: int = 0,
    before: Mapping[str, RecentCurve] = MappingProxyType({}),
) -> dict[str, RecentCurve]:
    """Return the newest part of each player's curve: that of `before` where its checkpoint and phase are the same."""
    by_score = {name: phase for phase in phases.values() if "score" in phase.until for name in phase.learners}
    found = {}
    for name in {**checkpoints, **by_score}:
        known, now = before.get(name), (checkpoints.get(name), by_score.get(name), recent)
        if known is None or (known.at, known.phase, known.recent) != now:
            known = _read(store, league, name, *now)
        found[name] = known
    return found


def _read(
    store: Store, league: str, player: str, at: Checkpoint | None, phase: Phase | None, recent: int
) -> RecentCurve:
    last, begun = at.iteration if at else 0, phase.since.get(player, 0) if phase else None
    since = last - max(recent, void_rates.ITERATIONS)
    points = store.curves(league, player, after=since if begun is None else min(since, begun))
    reward, success = _averages([p for p in points if p.iteration > last - recent], recent)
    score = None
    if begun is not None:
        score = phase_score(episode_scores([p for p in points if p.iteration > begun]))
    voids = void_rates.sums(p for p in points if at and p.iteration > last - void_rates.ITERATIONS)
    return RecentCurve(at, phase, recent, voids, reward, success, score)


def episode_scores(points: Sequence[CurvePoint]) -> list[tuple[float, float]]:
    """Return (number of episodes that count, their mean score) for each iteration in which any ended."""
    return [(_counted(p.values), p.values["score"]) for p in points if "score" in p.values]


def _counted(values: Mapping[str, float]) -> float:
    """Return the episodes of which a score is; in curves of earlier versions all that ended."""
    return values.get("counted", values["episodes"])


def _averages(points: Sequence[CurvePoint], recent: int) -> tuple[float | None, float | None]:
    """Return reward per episode and share of successes over the last `recent` iterations of training.

    There is a reward with that many iterations and an episode that counts, a share with ENOUGH of these.
    """
    ended = [p.values for p in points if "length" in p.values]
    if not recent or len(points) < recent or not ended:
        return None, None
    length = sum(p["length"] for p in ended) / len(ended)
    reward = sum(p.values["reward"] for p in points) / len(points) * length
    counted = [(_counted(p), p["score"]) for p in ended if {"episodes", "score"} <= p.keys()]
    episodes = sum(n for n, _ in counted)
    return reward, sum(n * score for n, score in counted) / episodes if episodes >= ENOUGH else None
