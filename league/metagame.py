"""A league's meta-game: its payoff table as a matrix, and what follows from it. Reads no configuration."""

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from typing import NamedTuple

import numpy as np

from league.measures import can_meet
from matchmaking.equilibrium import Equilibrium
from matchmaking.ladder import Ladder
from matchmaking.meta import Shares, decompose, relative_performance
from matchmaking.payoff import Score
from storage.errors import StorageError
from storage.records import Player, Snapshot

BACK = (3, 10)
"""How many snapshots back a player is asked whether it has forgotten."""


@dataclass(frozen=True, eq=False)
class Table:
    """Scores of snapshots against snapshots."""

    rows: tuple[str, ...]  # (N,)
    columns: tuple[str, ...]  # (M,)
    scores: np.ndarray  # (N, M) of the row, a draw half; nan where two have not met, ½ for one against itself
    games: np.ndarray  # (N, M)

    @property
    def square(self) -> bool:
        """Whether the rows are the columns: a symmetric game."""
        return self.rows == self.columns

    @property
    def unknown(self) -> int:
        """Pairs that have not met."""
        missing = int(np.isnan(self.scores).sum())
        return missing // 2 if self.square else missing

    @property
    def filled(self) -> np.ndarray:
        """(N, M) The scores, ½ for pairs that have not met."""
        return np.nan_to_num(self.scores, nan=0.5)

    @cached_property
    def shares(self) -> Shares | None:
        """The transitive and cyclic parts of a symmetric game."""
        return decompose(self.scores) if self.square else None

    def relative(self) -> Equilibrium:
        """What the rows' population is worth against the columns', ½ where they are equal."""
        return relative_performance(self.filled)


def table(
    ladder: Ladder,
    snapshots: Sequence[Snapshot],
    players: Sequence[Player],
    rows: str | None = None,
    columns: str | None = None,
    newest: bool = False,
) -> Table:
    """The payoff table of a ladder.

    Where the teams are alike everybody meets everybody, and rows and columns are the same; else those of the first team
    are the rows and those of the second the columns.

    Args:
        ladder: what was played.
        snapshots: those of the league, oldest first.
        players: those of the league.
        rows: a pattern such as blue@* that the rows' names must match; None for all.
        columns: the same of the columns.
        newest: only each player's newest snapshot, and those of no player: cross-play.

    Raises:
        StorageError: no rating match, or none of those asked for has played.
    """
    played = ladder.payoff.games.sum(1) > 0
    last = {s.player: s.name for s in sorted(snapshots, key=lambda s: s.iteration) if s.player}
    kept = [
        s
        for s in snapshots
        if played[ladder.payoff.index(s.name)] and (not newest or s.player is None or last[s.player] == s.name)
    ]
    if not kept:
        raise StorageError("No rating match has been played yet, so there is no payoff table: `league run` plays them.")
    if not players:
        raise StorageError("The league has rated snapshots and no players; `league verify` says what else is damaged.")
    rosters = list(dict.fromkeys(p.roster for p in sorted(players, key=lambda p: p.team)))
    sides = [rosters[0], rosters[-1]]
    named = [
        tuple(s.name for s in kept if s.roster == side and (pattern is None or fnmatchcase(s.name, pattern)))
        for side, pattern in zip(sides, (rows, columns), strict=True)
    ]
    for names, pattern in zip(named, (rows, columns), strict=True):
        if not names:
            there = ", ".join(s.name for s in kept[:8]) + (", ..." if len(kept) > 8 else "")
            raise StorageError(f"No rated snapshot matches {pattern!r}; there are: {there}.")
    place = np.ix_(*([ladder.payoff.index(name) for name in names] for names in named))
    scores = ladder.payoff.scores()[place]
    scores[np.array([[a == b for b in named[1]] for a in named[0]])] = 0.5
    return Table(named[0], named[1], scores, ladder.payoff.games[place])


class Kept(NamedTuple):
    """How a player's newest rated snapshot fares against an older one of its own."""

    player: str
    snapshot: str
    back: int  # how many snapshots older
    older: str
    score: Score

    @property
    def forgotten(self) -> bool:
        """Whether it loses to its own past: the whole 95 % interval lies below one half."""
        return self.score.games > 0 and self.score.high < 0.5


def forgetting(ladder: Ladder, snapshots: Sequence[Snapshot], players: Sequence[Player]) -> list[Kept]:
    """Each player's newest rated snapshot against its own 3 and 10 back, of players whose snapshots can meet.

    A self-play that runs in circles loses to its past (Balduzzi et al. 2019); so does one that forgets.
    """
    played = ladder.payoff.games.sum(1) > 0
    found = []
    for player in players:
        own = [s for s in snapshots if s.player == player.name]
        own = [s for s in own if played[ladder.payoff.index(s.name)] and can_meet(s, s, players)]
        for back in BACK:
            if len(own) > back:
                now, older = own[-1].name, own[-1 - back].name
                found.append(Kept(player.name, now, back, older, ladder.score(now, older)))
    return found
