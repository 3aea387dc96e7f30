"""A ladder: the payoff and the ratings of one match log, by snapshot name; all questions of strength go through it.

There is a ladder for each ArenaKey, and numbers of two ladders are not comparable directly: under other rules, bodies
or physics the same two policies play another game, and each ladder's Elo counts from its own initial snapshots. Two
engines may be compared if the same pairs of snapshots have met under both for enough episodes, pair by pair: they agree
on pairs whose scores lie in each other's intervals. Nothing here pools games of two keys.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from matchmaking.ratings.fit import Ratings, fit
from matchmaking.ratings.likelihoods.priors import parents
from matchmaking.ratings.payoff import Payoff, sum_matches
from matchmaking.ratings.scores import Score, score_interval
from matchmaking.ratings.separation import Separation, examined, islands
from storage.records import ArenaKey, Match, MatchTotals, Player, RankedMatch, Snapshot

ANCHOR_ELO = 1000.0
"""Elo of the anchors' mean."""

UNKNOWN = 1000.0
"""Elo: a rating whose interval is wider than this is not yet known."""


class VoidRate(NamedTuple):
    """Shares of a snapshot's episodes that unstable physics stopped, by the robots that caused it."""

    own: float  # only its own robots failed
    unclear: float  # those of both sides, or unclear
    episodes: int  # void ones included

    @property
    def suspect(self) -> float:
        """The share that it may have caused."""
        return self.own + self.unclear


@dataclass(frozen=True)
class Pool:
    """Snapshots of a ladder, and what is known of them besides their results."""

    names: tuple[str, ...] = ()  # these have a place even if they have not played yet
    anchors: tuple[str, ...] = ()  # their mean is placed at ANCHOR_ELO
    parents: Mapping[str, str] = field(default_factory=dict)  # snapshot -> its parent
    populations: Mapping[str, str] = field(default_factory=dict)  # snapshot -> roster, if teams' rosters differ

    @classmethod
    def of(cls, snapshots: Iterable[Snapshot], players: Iterable[Player]) -> "Pool":
        """Return the pool of a league. Its anchors are the initial snapshots.

        If the teams' rosters differ, snapshots of one roster never meet each other: the advantage of a side and the
        strength of its players cannot be separated, so each roster is a population with anchors of its own.
        """
        found = list(snapshots)
        return cls(
            tuple(s.name for s in found),
            tuple(s.name for s in found if s.initial),
            {s.name: s.parent for s in found if s.parent is not None},
            {s.name: s.roster for s in found} if len({p.roster for p in players}) > 1 else {},
        )


class Ladder:
    """Results under one ArenaKey as an immutable value, fitted once on demand. `extended` adds further rows."""

    def __init__(
        self,
        names: Iterable[str] | Pool,
        matches: Sequence[Match | RankedMatch] | MatchTotals = (),
        anchors: Iterable[str] = (),
        *,
        onto: Payoff | None = None,
    ):
        """Sum a log.

        Args:
            names: snapshots that have a place even if they have not played yet, or the whole pool.
            matches: rows of one ArenaKey, or their sums; ValueError if there are several, or if a row contradicts
                itself.
            anchors: snapshots whose mean is placed at ANCHOR_ELO: those of them that have played, because an anchor
                without
                games would widen every interval; all snapshots if empty.
            onto: sums of earlier rows of the log.
        """
        self.pool = names if isinstance(names, Pool) else Pool(tuple(names), tuple(anchors))
        self.payoff = sum_matches(matches, [*self.pool.names, *self.pool.anchors], onto)

    def extended(self, matches: Sequence[Match | RankedMatch], names: Iterable[str] | Pool = ()) -> "Ladder":
        """Return the ladder of this log and further rows, with further names or another pool.

        If nothing is new, it is this ladder, with its fit.
        """
        pool = names if isinstance(names, Pool) else replace(self.pool, names=(*self.pool.names, *names))
        new = any(name not in self.payoff.positions for name in pool.names)
        known = replace(pool, names=self.pool.names) == self.pool
        if not matches and not new and known:
            return self
        return Ladder(pool, matches, onto=self.payoff)

    @property
    def anchors(self) -> tuple[str, ...]:
        """Snapshots whose mean is placed at ANCHOR_ELO."""
        return self.pool.anchors

    @property
    def arena(self) -> ArenaKey | None:
        """Key of its matches; None if nothing was played."""
        return self.payoff.arena

    @property
    def names(self) -> tuple[str, ...]:
        """All snapshots, sorted."""
        return self.payoff.names

    @cached_property
    def ratings(self) -> Ratings:
        """Fit of all games (`matchmaking.ratings.fit`), with a prior on parents
        (`matchmaking.ratings.likelihoods.priors`).
        """
        payoff = self.payoff
        played = [name for name in self.anchors if payoff.played[payoff.index(name)]]
        return fit(
            payoff, prior=parents(payoff, self.pool.parents), anchors=played or self.anchors, anchor_elo=ANCHOR_ELO,
            populations=self.pool.populations or self._islands(played),
        )  # fmt: skip

    def _islands(self, anchors: Sequence[str]) -> dict[str, str]:
        """Return snapshot -> its island, if several islands have anchors: no game tells their distance.

        Snapshots of islands without an anchor count from those of the first: the prior alone places them.
        """
        payoff, met = self.payoff, self.payoff.home.any(1) | self.payoff.away.any(1)
        island = islands(len(self.names), payoff.first[met], payoff.second[met])
        anchored = {int(island[self.payoff.index(name)]) for name in anchors}
        if len(anchored) < 2:
            return {}
        first = min(anchored)
        return {
            name: str(number if number in anchored else first)
            for name, number in zip(self.names, island.tolist(), strict=True)
        }

    @cached_property
    def separation(self) -> Separation:
        """Ratings, sides and draws that the games alone do not bound, and snapshots that no games connect."""
        return examined(self.payoff)

    @property
    def one_team(self) -> bool:
        """True in arenas of one team: its matches are trials, without an opponent."""
        return bool(self.payoff.trials.any())

    def known(self, a: str) -> bool:
        """Return True if a's rating is meaningful: it has played, and its interval is at most UNKNOWN wide."""
        i = self.payoff.index(a)
        return bool(self.payoff.played[i] and 2 * self.ratings.quantile * self.ratings.stderr[i] <= UNKNOWN)

    def score(self, a: str, *others: str) -> Score:
        """Return the mean score of a over all its games against `others`."""
        return self.payoff.score(a, *others)

    def mean_score(self, a: str, *others: str) -> Score:
        """Return the mean of the scores of a against each of `others`, each with the same weight."""
        return self.payoff.mean_score(a, *others)

    def success(self, a: str) -> Score:
        """Return the success rate of a in an arena of one team: a draw is no success, and a void does not count."""
        successes, failures = map(int, self.payoff.trials[self.payoff.index(a), :2])
        low, high = score_interval(successes, 0, failures)
        n = successes + failures
        voids = int(self.payoff.trials[self.payoff.index(a), 2])
        return Score(successes / n if n else float("nan"), float(low), float(high), n, voids)

    def trial_episodes(self, a: str) -> int:
        """Return the episodes that a has played in an arena of one team, void ones included."""
        return int(self.payoff.trials[self.payoff.index(a), :3].sum())

    def void_rate(self, a: str) -> VoidRate:
        """Return the shares of a's episodes that were void, by cause."""
        own, unclear, episodes = self._voids[self.payoff.index(a)].tolist()
        return VoidRate(own / max(episodes, 1), unclear / max(episodes, 1), episodes)

    @cached_property
    def _voids(self) -> np.ndarray:
        """Void episodes (P, 3) of each snapshot by its own robots, those of unclear cause, and all its episodes."""
        payoff, P = self.payoff, len(self.names)
        ends = (payoff.first, payoff.second)
        voids = sum(np.bincount(end, payoff.voids, P) for end in ends) + payoff.trials[:, 2]
        own, theirs = (
            sum(np.bincount(end, payoff.at_fault[:, place], P) for end, place in zip(ends, order, strict=True))
            for order in ((0, 1), (1, 0))
        )
        own = own + payoff.trials[:, 3]
        episodes = payoff.total_episodes + payoff.trials[:, :3].sum(1)
        return np.stack([own, voids - own - theirs, episodes], 1).astype(int)
