"""Schedules as values: which team learns when, when a snapshot is due, and which pairs should be rated next."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from matchmaking.payoff import Payoff
from matchmaking.ratings import ELO, fit

Kind = Literal["simultaneous", "leapfrog", "frozen"]


@dataclass(frozen=True)
class Schedule:
    """Which teams learn: all of them, one after the other, or one against frozen opponents for ever."""

    kind: Kind = "simultaneous"
    """simultaneous: every team learns; leapfrog: the teams take turns; frozen: only `learner` ever learns."""

    period: int = 50
    """Leapfrog: learning iterations in a team's turn."""

    learner: int = 0
    """The team that learns first (leapfrog) or alone (frozen), counted from 0."""

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ValueError(f"kind is {self.kind!r}; choose one of {', '.join(get_args(Kind))}")
        if self.period < 1:
            raise ValueError(f"period is {self.period}; a turn lasts 1 iteration or more")
        if self.learner < 0:
            raise ValueError(f"learner is {self.learner}; it is a team's number, counted from 0")


def learners(schedule: Schedule, iteration: int, n_teams: int) -> tuple[int, ...]:
    """Teams that learn in the league's iteration `iteration` (counted from 0, whoever learns in it)."""
    if schedule.learner >= n_teams:
        raise ValueError(f"learner is {schedule.learner}, but the arena's teams are 0 to {n_teams - 1}")
    if schedule.kind == "simultaneous":
        return tuple(range(n_teams))
    turn = iteration // schedule.period if schedule.kind == "leapfrog" else 0
    return ((schedule.learner + turn) % n_teams,)


def next_swap(schedule: Schedule, iteration: int) -> int | None:
    """The first iteration after `iteration` in which another team learns, or None if that never comes."""
    return (iteration // schedule.period + 1) * schedule.period if schedule.kind == "leapfrog" else None


def next_due(iteration: int, per_doubling: int = 1) -> int:
    """The first iteration after `iteration` at which a snapshot is due: ⌊2^(m/r)⌉ for whole m, r = `per_doubling`.

    With r = 1 these are 1, 2, 4, 8, ...: learning is fast at first, and a history of n iterations is told by about
    r log2(n) snapshots. The initial snapshot is iteration 0.
    """
    if per_doubling < 1:
        raise ValueError(f"per_doubling is {per_doubling}; it must be 1 or more")
    m = max(math.floor(per_doubling * math.log2(max(iteration, 1))) - 1, 0)
    while (due := round(2 ** (m / per_doubling))) <= iteration:
        m += 1
    return due


def pairings(
    payoff: Payoff,
    candidates: Sequence[str],
    *,
    quota: int,
    per_batch: int,
    always: Mapping[str, Sequence[str]] | None = None,
    may_meet: Callable[[str, str], bool] = lambda a, b: True,
) -> list[tuple[str, str]]:
    """The pairs of snapshots to be rated next, most useful first.

    Again and again the candidate with the fewest episodes is chosen, the newest of those if they tie: everything plays
    something before anything plays much. Its opponent is the first of its `always` list that it has not met for
    `quota` episodes, else the candidate of whom a game tells most about the gap: a game's information is the variance
    of its score, p(1-p), and what it adds to the knowledge of a gap of variance V grows with p(1-p) V (expected
    information gain, Lindley 1956). That prefers equals over the far, and the unknown over the known.
    A planned pair counts as `quota` episodes for the rest of the batch, and as the information that they will give.
    Ties go to the newest, so the same arguments always give the same plan. Void episodes count as played, lest a pair
    that always fails be planned for ever.

    Args:
        payoff: what has been played, tallied with `players=` all names used here.
        candidates: digests that want a rating, oldest first.
        quota: episodes after which a pair is played enough.
        per_batch: at most so many pairs.
        always: digest -> opponents that it shall meet first, e.g. its player's initial snapshot, in order.
        may_meet: whether two snapshots can play each other at all, e.g. by their rosters; symmetric.

    Returns:
        pairs (candidate, opponent), no pair twice and no one against itself; empty once every pair has its quota.
    """
    ratings = fit(payoff)
    chance = ratings.expected_scores()
    information = chance * (1 - chance)  # of one game, in (log odds)⁻²
    covariance = ratings.covariance / ELO**2
    episodes = payoff.episodes.astype(float)
    effort = episodes.sum(1)
    newest_first = [payoff.index(name) for name in reversed(candidates)]
    first_of = {payoff.index(a): [payoff.index(b) for b in others] for a, others in (always or {}).items()}

    def opponent(i: int) -> int | None:
        def wanted(j: int) -> bool:
            return j != i and episodes[i, j] < quota and may_meet(payoff.names[i], payoff.names[j])

        for required in filter(wanted, first_of.get(i, ())):
            return required
        gain = information[i] * (covariance[i, i] + np.diag(covariance) - 2 * covariance[i])
        rounded = np.round(gain, 6)  # so that the last bits of the linear algebra do not break ties
        return max(filter(wanted, newest_first), key=rounded.__getitem__, default=None)

    plan: list[tuple[str, str]] = []
    while len(plan) < per_batch:
        by_effort = sorted(newest_first, key=effort.__getitem__)  # a stable sort: the newest first among equals
        found = next(((i, j) for i in by_effort if (j := opponent(i)) is not None), None)
        if found is None:
            break
        i, j = found
        plan.append((payoff.names[i], payoff.names[j]))
        effort[[i, j]] += quota
        episodes[[i, j], [j, i]] = np.inf  # never twice in a batch
        # What the planned games will tell of the gap i - j, by the Sherman-Morrison formula.
        shared = covariance[i] - covariance[j]
        expected = quota * information[i, j]
        covariance = covariance - np.outer(shared, shared) * expected / (1 + expected * (shared[i] - shared[j]))
    return plan
