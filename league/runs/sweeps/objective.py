"""The figure of merit of a league: how good its players' newest rated snapshots are."""

import math

from league.queries.query import Open
from league.runs.sweeps.sweep_file import Objective


def objective(opened: Open, kind: Objective = "vs_initial") -> float:
    """Return the mean over players of their newest rated snapshot's score against initial, success or Elo.

    In an arena of one team a score against initial is the success rate. nan if no player has a rated snapshot.
    """
    shown = opened.ratings()
    if kind == "vs_initial" and "success" in shown and shown["success"].notna().any():
        kind = "success"
    if "player" not in shown:
        return math.nan
    rated = shown[shown["player"].notna() & shown[kind].notna() & (shown["iteration"] > 0)]
    if kind == "elo":
        rated = rated[rated["known"]]
    newest = rated.sort_values("iteration").groupby("player").tail(1)
    return float(newest[kind].astype(float).mean()) if len(newest) else math.nan
