"""The figure of merit of a league: how good its players' newest rated snapshots are."""

import math
import statistics

from league.queries.query import Open
from league.queries.ratings.rating_rows import Row, rating_rows
from league.runs.sweeps.sweep_file import Objective
from matchmaking.roles import without_exploiters


def measured_players(opened: Open) -> set[str]:
    """Return the names of the players by which a league is measured: those that have learnt, but for exploiters.

    If exploiters alone have learnt, these count; if nobody has, all players.
    """
    store, league = opened.store, opened.league
    learnt = {c.player for c in store.newest_checkpoints(league).values() if c.iteration}
    learnt |= {s.player for s in store.snapshots(league, brief=True) if s.player and s.iteration}
    roles = {p.name: p.role for p in store.players(league)}
    return without_exploiters({name: role for name, role in roles.items() if name in learnt}) or {*roles}


def objective(opened: Open, kind: Objective = "vs_initial") -> float:
    """Return the mean over the measured players of their newest rated snapshot's score against initial, success or Elo.

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
    trained, measured = opened.store.newest_checkpoints(opened.league), measured_players(opened)
    found = [
        (steps[newest[p]["name"]] if p in newest else 0, last.step) for p, last in trained.items() if p in measured
    ]
    reached, all_steps = max(found, key=lambda each: each[1] - each[0], default=(0, 0))
    if 2 * reached > all_steps or not newest:
        return ""
    return f"of snapshots at {reached:,} of {all_steps:,} steps; a longer budget.rating_time rates newer ones"


def _newest_rated(opened: Open, kind: Objective) -> tuple[dict[str, Row], str]:
    """Return measured player -> the row of its newest snapshot that has the value, and the row's key of the value."""
    shown, measured = opened.shown(), measured_players(opened)
    ladder = shown.ladders[0]
    rows = rating_rows(ladder, shown.snapshots, shown.players, shown.void_limit)
    key = "success" if kind == "vs_initial" and ladder.one_team else kind
    newest: dict[str, Row] = {}
    for row in sorted(rows, key=lambda row: row["iteration"] or 0):
        if row["player"] in measured and row["iteration"] and row[key] is not None and (row["known"] or key != "elo"):
            newest[row["player"]] = row
    return newest, key
