"""A ladder: the payoff and the ratings of one match log, by snapshot name; whoever asks who is better asks this.

There is a ladder for each ArenaKey, and figures of two are not comparable as they stand: under other rules, bodies or
physics the same two policies play another game, and each ladder's Elo counts from its own initial snapshots. Two
engines may be compared where the same pairs of snapshots have met under both for enough episodes, pair by pair: on
those whose scores lie in each other's intervals they agree. Nothing here pools games of two keys.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from matchmaking.payoff import Payoff, Score, score_interval, tally
from matchmaking.priors import parents
from matchmaking.ratings import Ratings, fit
from storage.records import ArenaKey, Match, Player, Snapshot, Totals

ANCHOR_ELO = 1000.0
"""Where the mean of the anchors stands."""

UNKNOWN = 1000.0
"""Elo: a rating whose interval is wider than this is not yet known."""


class VoidRate(NamedTuple):
    """Which share of a snapshot's episodes was stopped by unstable physics, by whose robots."""

    own: float  # only its own went bad
    unclear: float  # both sides', or it could not be told whose
    episodes: int  # void ones included

    @property
    def suspect(self) -> float:
        """The share that may be its doing."""
        return self.own + self.unclear


@dataclass(frozen=True)
class Pool:
    """Who stands on a ladder, and what is known of them beside their results."""

    names: tuple[str, ...] = ()  # that shall have a place even if they have not played yet
    anchors: tuple[str, ...] = ()  # whose mean is put at ANCHOR_ELO
    parents: Mapping[str, str] = field(default_factory=dict)  # snapshot -> the one that it goes on from
    populations: Mapping[str, str] = field(default_factory=dict)  # snapshot -> roster, where teams' rosters are unlike

    @classmethod
    def of(cls, snapshots: Iterable[Snapshot], players: Iterable[Player]) -> "Pool":
        """That of a league. Its anchors are the initial snapshots.

        Where the teams' rosters are unlike, those of one roster never meet: what one side is worth and how strong its
        players are cannot be told apart, so each roster is a population with anchors of its own.
        """
        found = list(snapshots)
        return cls(
            tuple(s.name for s in found),
            tuple(s.name for s in found if s.initial),
            {s.name: s.parent for s in found if s.parent is not None},
            {s.name: s.roster for s in found} if len({p.roster for p in players}) > 1 else {},
        )


class Ladder:
    """Results under one ArenaKey as a value: nothing in it changes, and it is fitted once, when somebody asks.

    A longer log is another ladder, see `extended`.
    """

    def __init__(
        self,
        names: Iterable[str] | Pool,
        matches: Sequence[Match] | Totals = (),
        anchors: Iterable[str] = (),
        *,
        onto: Payoff | None = None,
    ):
        """Tally a log.

        Args:
            names: snapshots that shall have a place even if they have not played yet, or the whole pool.
            matches: rows of one ArenaKey, or their sums; ValueError if there are several, or if a row contradicts
                itself.
            anchors: snapshots whose mean is put at ANCHOR_ELO: those of them that have played, for one of which nothing
                is known would blur every interval; all snapshots if empty.
            onto: what earlier rows of the log were summed into.
        """
        self.pool = names if isinstance(names, Pool) else Pool(tuple(names), tuple(anchors))
        self.payoff = tally(matches, [*self.pool.names, *self.pool.anchors], onto)

    def extended(self, matches: Sequence[Match], names: Iterable[str] | Pool = ()) -> "Ladder":
        """The ladder of this log and further rows, with further names or another pool.

        It is itself, fit and all, where nothing is new.
        """
        pool = names if isinstance(names, Pool) else replace(self.pool, names=(*self.pool.names, *names))
        new = any(name not in self.payoff.positions for name in pool.names)
        known = replace(pool, names=self.pool.names) == self.pool
        if not matches and not new and known:
            return self
        return Ladder(pool, matches, onto=self.payoff)

    @property
    def anchors(self) -> tuple[str, ...]:
        """Snapshots whose mean is put at ANCHOR_ELO."""
        return self.pool.anchors

    @property
    def arena(self) -> ArenaKey | None:
        """What its matches are filed under; None where nothing was played."""
        return self.payoff.arena

    @property
    def names(self) -> tuple[str, ...]:
        """Every snapshot, sorted."""
        return self.payoff.names

    @cached_property
    def ratings(self) -> Ratings:
        """The fit of all games, see matchmaking.ratings; the prior leans on parents, see matchmaking.priors."""
        payoff = self.payoff
        played = [name for name in self.anchors if payoff.games[payoff.index(name)].any()]
        return fit(
            payoff, prior=parents(payoff, self.pool.parents), anchors=played or self.anchors, anchor_elo=ANCHOR_ELO,
            populations=self.pool.populations,
        )  # fmt: skip

    @property
    def one_team(self) -> bool:
        """Whether there is nobody to be better than: its matches are trials of one team."""
        return bool(self.payoff.trials.any())

    def known(self, a: str) -> bool:
        """Whether a's rating says something: it has played, and its interval is at most UNKNOWN wide."""
        i = self.payoff.index(a)
        return bool(self.payoff.games[i].any() and self.ratings.high[i] - self.ratings.low[i] <= UNKNOWN)

    def score(self, a: str, *others: str) -> Score:
        """Mean score of a over all its games against `others`."""
        return self.payoff.score(a, *others)

    def success(self, a: str) -> Score:
        """How often a succeeds in an arena of one team: a draw is no success, and a void counts for nothing."""
        successes, failures = map(int, self.payoff.trials[self.payoff.index(a), :2])
        low, high = score_interval(successes, 0, failures)
        n = successes + failures
        return Score(successes / n if n else float("nan"), float(low), float(high), n)

    def tried(self, a: str) -> int:
        """Episodes that a has played in an arena of one team, void ones included."""
        return int(self.payoff.trials[self.payoff.index(a), :3].sum())

    def void_rate(self, a: str) -> VoidRate:
        """How many of a's episodes were void, in how many of them for its own robots' sake."""
        own, unclear, episodes = self._voids[self.payoff.index(a)].tolist()
        return VoidRate(own / max(episodes, 1), unclear / max(episodes, 1), episodes)

    @cached_property
    def _voids(self) -> np.ndarray:
        """(P, 3) Each snapshot's void episodes by its own robots, those of unclear cause, and all its episodes."""
        payoff, P = self.payoff, len(self.names)
        ends = (payoff.first, payoff.second)
        voids = sum(np.bincount(end, payoff.voids, P) for end in ends) + payoff.trials[:, 2]
        own, theirs = (
            sum(np.bincount(end, payoff.culprits[:, who], P) for end, who in zip(ends, order, strict=True))
            for order in ((0, 1), (1, 0))
        )
        own = own + payoff.trials[:, 3]
        episodes = payoff.episodes.sum(1) + payoff.trials[:, :3].sum(1)
        return np.stack([own, voids - own - theirs, episodes], 1).astype(int)
