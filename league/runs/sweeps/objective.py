"""The figure of merit of a league: how good its players' newest rated snapshots are."""

import math
import statistics

from league.queries.query import Open
from league.queries.ratings.rating_rows import Row, rating_rows
from league.runs.sweeps.sweep_file import Objective


def objective(opened: Open, kind: Objective = "vs_initial") -> float:
    """Return the mean over players of their newest rated snapshot's score against initial, success or Elo.

    In an arena of one team a score against initial is the success rate. nan if no player has a rated snapshot.
    """
    shown = opened.shown()
    ladder = shown.ladders[0]
    rows = rating_rows(ladder, shown.snapshots, shown.players, shown.void_limit)
    key = "success" if kind == "vs_initial" and ladder.one_team else kind
    newest: dict[str, Row] = {}
    for row in sorted(rows, key=lambda row: row["iteration"] or 0):
        if row["player"] and row["iteration"] and row[key] is not None and (row["known"] or key != "elo"):
            newest[row["player"]] = row
    return statistics.fmean(row[key] for row in newest.values()) if newest else math.nan
