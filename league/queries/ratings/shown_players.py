"""Choice of the snapshots that a long table shows if there is no room for all."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from league.queries.ratings.rating_rows import opponents_met
from matchmaking.ratings.ladder import Ladder
from storage.records import Snapshot

if TYPE_CHECKING:
    from league.queries.ratings.metagame import Table

MOST = 300
"""Most rows or columns of a payoff table: solving 1,000 takes minutes, and 10,000 snapshots take 1.6 GB."""

SHOWN = "the newest of each player, the best, initial snapshots and those of no player, then those that have met most"
"""The order of `prominent`, in words."""


def prominent(names: Sequence[str], met: np.ndarray, ladder: Ladder, snapshots: Sequence[Snapshot]) -> list[int]:
    """Return the positions of all names, ordered by their interest to a reader.

    The order is: the newest of each player, the best by their ratings (of all, then of each player), initial
    snapshots, those of no player (scripts and imports), then those that have met the most opponents, later ones first.

    Args:
        names: (N,) of snapshots, older ones first.
        met: (N,) number of opponents that each has met.
        ladder: the games.
        snapshots: all snapshots of the league; older ones of a player first.
    """
    of, place = {s.name: s for s in snapshots}, {name: i for i, name in enumerate(names)}
    own = [of[name] for name in names if name in of]
    newest = {s.player: s.name for s in sorted(own, key=lambda s: s.iteration) if s.player}
    rated = [s for s in own if ladder.known(s.name)]
    rated.sort(key=lambda s: -ladder.ratings.elo[ladder.payoff.index(s.name)])
    best = {s.player: s.name for s in reversed(rated) if s.player}
    by_met = np.lexsort((-np.arange(len(names)), -met))
    order = [
        *newest.values(), *(s.name for s in rated[:1]), *best.values(), *(s.name for s in own if s.initial),
        *(s.name for s in own if s.player is None),
    ]  # fmt: skip
    return list(dict.fromkeys([*(place[name] for name in order), *by_met.tolist()]))


def foremost(names: Sequence[str], ladder: Ladder, snapshots: Sequence[Snapshot], most: int = MOST) -> tuple[str, ...]:
    """Return at most `most` of the names, the first by `prominent`, in their original order."""
    if len(names) <= most:
        return tuple(names)
    met = np.array(opponents_met(ladder.payoff))[[ladder.payoff.index(name) for name in names]]
    return tuple(names[i] for i in sorted(prominent(names, met, ladder, snapshots)[:most]))


def of_table(found: "Table", ladder: Ladder, snapshots: Sequence[Snapshot], most: int) -> tuple[list[int], list[int]]:
    """Return the positions of at most `most` rows and `most` columns of a payoff table, in the table's order."""
    rows = prominent(found.rows, (found.games > 0).sum(1), ladder, snapshots)[:most]
    columns = prominent(found.columns, (found.games > 0).sum(0), ladder, snapshots)[:most]
    return sorted(rows), sorted(columns)
