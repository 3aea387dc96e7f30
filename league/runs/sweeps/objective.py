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
    newest, key = _newest_rated(opened, kind)
    return statistics.fmean(row[key] for row in newest.values()) if newest else math.nan


def too_early(opened: Open, kind: Objective = "vs_initial") -> str:
    """Return a remark if a player's newest rated snapshot is from the first half of training; else an empty text.

    The figure of merit is then that of the first steps: the time for ratings ended before newer snapshots were rated.
    """
    newest, _ = _newest_rated(opened, kind)
    steps = {s.name: s.step for s in opened.store.snapshots(opened.league, brief=True)}
    trained = opened.store.newest_checkpoints(opened.league)
    found = [(steps[newest[p]["name"]] if p in newest else 0, last.step) for p, last in trained.items()]
    reached, all_steps = max(found, key=lambda each: each[1] - each[0], default=(0, 0))
    if 2 * reached > all_steps or not newest:
        return ""
    return f"of snapshots at {reached:,} of {all_steps:,} steps; a longer budget.rating_time rates newer ones"


def _newest_rated(opened: Open, kind: Objective) -> tuple[dict[str, Row], str]:
    """Return player -> the row of its newest snapshot that has the value, and the row's key of the value."""
    shown = opened.shown()
    ladder = shown.ladders[0]
    rows = rating_rows(ladder, shown.snapshots, shown.players, shown.void_limit)
    key = "success" if kind == "vs_initial" and ladder.one_team else kind
    newest: dict[str, Row] = {}
    for row in sorted(rows, key=lambda row: row["iteration"] or 0):
        if row["player"] and row["iteration"] and row[key] is not None and (row["known"] or key != "elo"):
            newest[row["player"]] = row
    return newest, key
