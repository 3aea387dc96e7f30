"""A ladder: the payoff and the ratings of one match log, by snapshot name; whoever asks who is better asks this.

There is a ladder for each ArenaKey, and figures of two are not comparable as they stand: under other rules, bodies or
physics the same two policies play another game, and each ladder's Elo counts from its own initial snapshots. Two
engines may be compared where the same pairs of snapshots have met under both for enough episodes, pair by pair: on
those whose scores lie in each other's intervals they agree. Nothing here pools games of two keys.
"""

from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import NamedTuple

from matchmaking.payoff import Payoff, Score, score_interval, tally
from matchmaking.ratings import Ratings, fit
from storage.records import ArenaKey, Match

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


class Ladder:
    """Results under one ArenaKey as a value: nothing in it changes, and it is fitted once, when somebody asks.

    A longer log is another ladder, see `extended`.
    """

    def __init__(
        self,
        names: Iterable[str],
        matches: Sequence[Match] = (),
        anchors: Iterable[str] = (),
        *,
        onto: Payoff | None = None,
    ):
        """Tally a log.

        Args:
            names: snapshots that shall have a place even if they have not played yet.
            matches: rows of one ArenaKey; ValueError if there are several, or if a row contradicts itself.
            anchors: snapshots whose mean is put at ANCHOR_ELO: those of them that have played, for one of which nothing
                is known would blur every interval; all snapshots if empty.
            onto: what earlier rows of the log were summed into.
        """
        self.anchors = tuple(anchors)
        self.payoff = tally(matches, [*names, *self.anchors], onto)

    def extended(
        self, matches: Sequence[Match], names: Iterable[str] = (), anchors: Iterable[str] | None = None
    ) -> "Ladder":
        """The ladder of this log and further rows and names; itself, fit and all, where nothing is new."""
        new = [name for name in names if name not in self.payoff.positions]
        anchors = self.anchors if anchors is None else tuple(anchors)
        if not matches and not new and anchors == self.anchors:
            return self
        return Ladder(new, matches, anchors, onto=self.payoff)

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
        """The fit of all games, see matchmaking.ratings."""
        payoff = self.payoff
        played = [name for name in self.anchors if payoff.games[payoff.index(name)].any()]
        return fit(payoff, anchors=played or self.anchors, anchor_elo=ANCHOR_ELO)

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
        payoff, i = self.payoff, self.payoff.index(a)
        first, second = payoff.first == i, payoff.second == i
        own = payoff.culprits[first, 0].sum() + payoff.culprits[second, 1].sum()
        others = payoff.culprits[first, 1].sum() + payoff.culprits[second, 0].sum()
        voids = payoff.voids[first | second].sum() + payoff.trials[i, 2]
        own += payoff.trials[i, 3]
        episodes = int(payoff.episodes[i].sum()) + self.tried(a)
        n = max(episodes, 1)
        return VoidRate(float(own / n), float((voids - own - others) / n), episodes)
