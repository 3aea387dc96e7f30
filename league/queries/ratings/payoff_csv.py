"""A payoff table of all snapshots as CSV, for any number of snapshots."""

from collections.abc import Iterator, Sequence

import numpy as np

from dashboards.untrusted_text import csv_line
from matchmaking.ratings.ladder import Ladder


def lines(ladder: Ladder, rows: Sequence[str], columns: Sequence[str]) -> Iterator[str]:
    """Yield a payoff table as lines of CSV, one row at a time; a field is empty if the two have not met.

    Memory holds only one line and the pairs that met, so the number of snapshots is not limited.
    """
    payoff, both = ladder.payoff, ladder.payoff.home + ladder.payoff.away
    column = np.full(len(payoff.names), -1)
    column[[payoff.index(name) for name in columns]] = np.arange(len(columns))
    ends = np.append(payoff.first, payoff.second), np.append(payoff.second, payoff.first)
    games = np.concatenate([both, both[:, ::-1]])
    shown = (column[ends[1]] >= 0) & games.any(1)
    order = np.argsort(ends[0][shown], kind="stable")
    own, other, games = ends[0][shown][order], column[ends[1][shown][order]], games[shown][order]
    scores = ((games[:, 0] + games[:, 1] / 2) / games.sum(1)).tolist()
    yield csv_line(["", *columns])
    for name in rows:
        i = payoff.index(name)
        cells = [""] * len(columns)
        if column[i] >= 0:
            cells[column[i]] = "0.5"
        for at in range(*np.searchsorted(own, [i, i + 1]).tolist()):
            cells[other[at]] = repr(scores[at])
        yield ",".join([csv_line([name]), *cells])
