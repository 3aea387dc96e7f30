"""A league's meta-game: its payoff table as a matrix, and results computed from it. No configuration is read."""

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from typing import NamedTuple

import numpy as np

from league.queries.ratings.rating_rows import VOID_MARK, side_text
from league.queries.ratings.shown_players import foremost
from league.scheduling.progress_metrics import can_meet
from matchmaking.match_design import HISTORY_OFFSETS
from matchmaking.metagame.alpharank import Decomposition, decompose, relative_population_performance
from matchmaking.metagame.mixtures import PayoffPosterior
from matchmaking.metagame.nash import Equilibrium
from matchmaking.ratings.ladder import Ladder
from matchmaking.ratings.scores import Score
from storage.errors import StorageError
from storage.records import Player, Snapshot


@dataclass(frozen=True, eq=False)
class Table:
    """Scores of snapshots against snapshots."""

    rows: tuple[str, ...]  # (N,)
    columns: tuple[str, ...]  # (M,)
    games: np.ndarray  # (N, M)
    evidence: PayoffPosterior  # of the U snapshots that have a row or a column
    place: tuple[np.ndarray, np.ndarray]  # (N,), (M,): index into them of each row, and of each column
    island: np.ndarray  # (U,) int: number of the group that games connect
    suspect: frozenset[frozenset[str]]  # pairs of which many episodes were void, see Score.suspect
    asked: tuple[int, int]  # number of all rows and columns, of which these are the first

    @property
    def square(self) -> bool:
        """Return whether the rows are the columns: a symmetric game."""
        return self.rows == self.columns

    def cell(self, row: str, column: str, score: float) -> float | str | None:
        """Return a score in per cent for people, marked if many episodes were void; None if the two have not met."""
        if np.isnan(score):
            return None
        return f"{100 * score:.0f}{VOID_MARK}" if frozenset((row, column)) in self.suspect else 100 * float(score)

    def of(self, square: np.ndarray) -> np.ndarray:
        """(N, M) Rows and columns of this table, taken from a table (U, U) of the snapshots."""
        return square[np.ix_(*self.place)]

    @cached_property
    def scores(self) -> np.ndarray:
        """(N, M) Scores of the rows; a draw counts half; nan if two have not met, ½ for a snapshot against itself."""
        return self.of(self.evidence.scores)

    @cached_property
    def _pairs(self) -> np.ndarray:
        """(U, U) bool, above the diagonal: the pairs that are in the table, in either order of row and column."""
        inside = np.zeros(self.evidence.scores.shape, bool)
        inside[np.ix_(*self.place)] = True
        return np.triu(inside | inside.T, 1)

    @property
    def pairs(self) -> int:
        """Pairs of two snapshots."""
        return int(self._pairs.sum())

    @property
    def unknown(self) -> int:
        """Pairs that have not met."""
        return int(np.isnan(self.evidence.scores[self._pairs]).sum())

    @property
    def apart(self) -> int:
        """Unknown pairs that no chain of games connects, so only a prior compares them."""
        return int((self.island[:, None] != self.island)[self._pairs].sum())

    @property
    def completed(self) -> np.ndarray:
        """(N, M) Scores; for pairs that have not met, the scores that the ratings predict."""
        return self.of(self.evidence.completed())

    @cached_property
    def shares(self) -> Decomposition | None:
        """The transitive and cyclic parts of a symmetric game."""
        return decompose(self.scores, self.of(self.evidence.variances())) if self.square else None

    def sample_tables(self, count: int) -> Iterator[np.ndarray]:
        """Yield tables (N, M) drawn from the posterior of the scores, see `PayoffPosterior.sample_tables`."""
        return map(self.of, self.evidence.sample_tables(count))

    def relative(self) -> Equilibrium:
        """Value of the rows' population against the columns' population; ½ if they are equal."""
        return relative_population_performance(self.completed)


def table(
    ladder: Ladder,
    snapshots: Sequence[Snapshot],
    players: Sequence[Player],
    rows: str | None = None,
    columns: str | None = None,
    newest: bool = False,
) -> Table:
    """Return the payoff table of a ladder.

    If the teams are alike, every snapshot can meet every other, and rows and columns are the same. Otherwise the rows
    are snapshots of the first team and the columns snapshots of the second.

    Args:
        ladder: the games.
        snapshots: all snapshots of the league, oldest first.
        players: all players of the league.
        rows: a pattern such as blue@* that the rows' names must match; None for all.
        columns: such a pattern for the columns.
        newest: only each player's newest snapshot, and snapshots of no player: cross-play.

    Raises:
        StorageError: there is no rating match, or no requested snapshot has played.
    """
    named = sides_of(ladder, snapshots, players, rows, columns, newest)
    chosen = [foremost(names, ladder, snapshots) for names in named]
    names = list(dict.fromkeys([*chosen[0], *chosen[1]]))
    number = {name: i for i, name in enumerate(names)}
    place = [np.array([number[name] for name in each], int) for each in chosen]
    at = np.array([ladder.payoff.index(name) for name in names], int)
    return Table(
        chosen[0], chosen[1],
        games=ladder.payoff.block(at[place[0]], at[place[1]])[:3].sum(0),
        evidence=PayoffPosterior.of(ladder.payoff, ladder.ratings, names),
        place=(place[0], place[1]),
        island=ladder.separation.island[at],
        suspect=ladder.payoff.suspect,
        asked=(len(named[0]), len(named[1])),
    )  # fmt: skip


def sides_of(
    ladder: Ladder, snapshots: Sequence[Snapshot], players: Sequence[Player], rows: str | None, columns: str | None,
    newest: bool = False,
) -> list[tuple[str, ...]]:  # fmt: skip
    """Return the names of all rows and columns requested of `table`, without a limit. Raises StorageError."""
    played = ladder.payoff.played > 0
    last = {s.player: s.name for s in sorted(snapshots, key=lambda s: s.iteration) if s.player}
    rated = [s for s in snapshots if played[ladder.payoff.index(s.name)]]
    kept = [s for s in rated if not newest or s.player is None or last[s.player] == s.name]
    if ladder.one_team and ladder.arena is not None:
        raise StorageError("The arena has one team, so nobody meets anybody: `league ratings` has the successes.")
    if not rated:
        raise StorageError("No rating match has been played yet, so there is no payoff table: `league run` plays them.")
    if not players:
        raise StorageError("The league has rated snapshots and no players; `league verify` says what else is damaged.")
    rosters = list(dict.fromkeys(p.roster for p in sorted(players, key=lambda p: p.team)))
    sides = [rosters[0], rosters[-1]]
    named = [
        tuple(s.name for s in kept if s.roster == side and (pattern is None or fnmatchcase(s.name, pattern)))
        for side, pattern in zip(sides, (rows, columns), strict=True)
    ]
    for names, pattern, side, where in zip(named, (rows, columns), sides, ("rows", "columns"), strict=True):
        if not names:
            which, among = "newest" if newest else "rated", rated
            lacks = f"matches {pattern!r}" if pattern is not None else "of a side is rated yet"
            if pattern is not None and sides[0] != sides[1]:
                lacks = f"{lacks} in the {where}, which are of {side_text(side)}"
                among = [s for s in rated if s.roster == side]
            there = ", ".join(s.name for s in among[:8])
            more = f" and {len(among) - 8} more" if len(among) > 8 else ""
            raise StorageError(f"No {which} snapshot {lacks}; rated are: {there or 'none'}{more}.")
    return named


class Kept(NamedTuple):
    """Score of a player's newest rated snapshot against an older snapshot of the same player."""

    player: str
    snapshot: str
    back: int  # distance between the two, in snapshots
    older: str
    score: Score

    @property
    def forgotten(self) -> bool:
        """Return whether the player loses to its own past: the whole 95 % interval lies below one half."""
        return self.score.games > 0 and self.score.high < 0.5


def forgetting(ladder: Ladder, snapshots: Sequence[Snapshot], players: Sequence[Player]) -> list[Kept]:
    """Compare each player's newest rated snapshot with its own 3 and 10 back, for players whose snapshots can meet.

    The snapshot used is the newest that has met the older one, since the design of rating matches lets them meet
    (`league.scheduling.progress_metrics.wishes`); if none has, the newest that has played at all. Self-play that cycles
    loses to its past (Balduzzi et al. 2019); so does self-play that forgets.
    """
    played = ladder.payoff.played > 0
    found = []
    for player in players:
        own = [s for s in snapshots if s.player == player.name]
        own = [s for s in own if can_meet(s, s, players)]
        rated = [i for i, s in enumerate(own) if played[ladder.payoff.index(s.name)]]
        for back in HISTORY_OFFSETS:
            if pair := _looking_back(ladder, own, rated, back):
                now, older = pair
                found.append(Kept(player.name, now, back, older, ladder.score(now, older)))
    return found


def _looking_back(ladder: Ladder, own: Sequence[Snapshot], rated: Sequence[int], back: int) -> tuple[str, str] | None:
    """Return the newest rated snapshot of a player that has met its snapshot `back` earlier, and the earlier one.

    Without such a pair, see `forgetting`. The distance counts all of the player's snapshots, or only those that have
    not been thinned.
    """
    kept, first = [i for i, s in enumerate(own) if s.thinned is None], None
    for i in reversed(rated):
        for past, end in ((range(len(own)), i), (kept, bisect_left(kept, i))):
            if end >= back:
                pair = own[i].name, own[past[end - back]].name
                first = first or pair
                if any(ladder.payoff.against(pair[0], pair[1:])):
                    return pair
    return first
