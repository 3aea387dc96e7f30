"""Curves of a metric over steps, with bands: the mean and the range over the leagues of a cell."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from league.config.schema import ConfigError
from league.queries.ratings.rating_rows import rating_rows
from league.runs.comparison.cells import Cell, Member
from league.runs.sweeps.objective import measured_players

OF_SNAPSHOTS = ("vs_initial", "success", "elo")
"""Metrics of rated snapshots, from each league's own ladder; all others are recorded in each learning iteration."""
POINTS = 100  # most steps at which a band is told

Curve = tuple[np.ndarray, np.ndarray]  # (n,) steps, and one or more rows of values (n,)


@dataclass(frozen=True, eq=False)
class Band:
    """A metric of a cell over steps: arrays (n,), up to the last step that all leagues counted in it have reached."""

    cell: str
    leagues: int  # that are counted
    steps: np.ndarray
    mean: np.ndarray
    low: np.ndarray  # of the lowest league
    high: np.ndarray  # of the highest league
    left_out: Sequence[str] = ()  # leagues that have the metric, but at none of these steps

    def at(self, step: float) -> tuple[float, float, float] | None:
        """Return mean, low and high at a step, from the points beside it; None before the first and after the last."""
        if not self.steps[0] <= step <= self.steps[-1]:
            return None
        mean, low, high = (float(np.interp(step, self.steps, each)) for each in (self.mean, self.low, self.high))
        return mean, low, high


def metric_of(found: Sequence[Member]) -> str:
    """Return the metric that tells how far leagues are: success in arenas of one team, else the score vs initial."""
    one_team = len({p.team for p in found[0].opened.store.players(found[0].opened.league)}) == 1
    return "success" if one_team else "vs_initial"


def unrated(found: Sequence[Cell], curves: Sequence[Band]) -> str:
    """Return a line if ratings of snapshots reach less than half of the training of all leagues; else an empty text."""
    newest = [m.opened.store.newest_checkpoints(m.opened.league).values() for cell in found for m in cell.members]
    trained = min((max((each.step for each in own), default=0) for own in newest), default=0)
    reached = min((int(band.steps[-1]) for band in curves), default=0)
    if not curves or 2 * reached >= trained:
        return ""
    return (
        f"Rated snapshots reach {reached:,} of {trained:,} steps: `league rate --store STORE --league NAME` rates more,"
        " a longer budget.rating_time does so in the runs, and --metric reward needs no ratings."
    )


def apart(curves: Sequence[Band], metric: str) -> str:
    """Return a line about leagues that are not in the band of their cell; an empty text if there are none."""
    found = [f"{', '.join(band.left_out)} (cell {band.cell})" for band in curves if band.left_out]
    if not found:
        return ""
    return f"Not counted in the curves, because {metric} is known at none of their cell's steps: {'; '.join(found)}."


def bands(found: Sequence[Cell], metric: str) -> list[Band]:
    """Return the band of each cell that has the metric.

    Raises ConfigError, which lists the recorded metrics, if no league has it.
    """
    made = [_band(cell.text, {member.name: _curve(member, metric) for member in cell.members}) for cell in found]
    if not any(made) and metric not in OF_SNAPSHOTS:
        known = sorted({key for cell in found for m in cell.members for p in m.opened.points() for key in p.values})
        if known and metric not in known:
            raise ConfigError(
                ("metric",), f"metric {metric!r} was not recorded; there are: {', '.join((*OF_SNAPSHOTS, *known))}"
            )
    return [band for band in made if band is not None]


def _curve(member: Member, metric: str) -> Curve:
    """Return steps and values (n,) of a league: the mean over the players by which it is measured.

    Between the points of a player its curve is interpolated. Where players have no step in common, there is no mean.
    """
    measured, points = measured_players(member.opened), defaultdict[str, list[tuple[int, float]]](list)
    for player, step, value in _points(member, metric):
        if player in measured:
            points[player].append((step, value))
    if not points:
        return np.zeros(0), np.zeros(0)
    steps, values = _aligned([_of_player(each) for each in points.values()])
    return steps, values.mean(0)


def _points(member: Member, metric: str) -> list[tuple[str, int, float]]:
    """Return player, step and value of each point of a league."""
    opened = member.opened
    if metric not in OF_SNAPSHOTS:
        return [(p.player, p.step, p.values[metric]) for p in opened.points() if metric in p.values]
    shown = opened.shown()
    steps = {s.name: s.step for s in shown.snapshots if s.player}
    rows = rating_rows(shown.ladders[0], shown.snapshots, shown.players, shown.void_limit)
    rated = [row for row in rows if metric != "elo" or row["known"]]
    return [(r["player"], steps[r["name"]], r[metric]) for r in rated if r["player"] and r[metric] is not None]


def _of_player(points: Sequence[tuple[int, float]]) -> Curve:
    """Return steps and values (n,) of a player: the mean of its values where it has several at a step."""
    x, y = np.array(points, float).T
    steps, place = np.unique(x, return_inverse=True)
    return steps, np.bincount(place, y) / np.bincount(place)


def _aligned(curves: Sequence[Curve]) -> Curve:
    """Return the steps (n,) of all curves from the latest first to the earliest last one, and their values (curves, n).

    Outside these steps a mean would jump where one of the curves begins or ends. There are none (n = 0) if a curve
    begins only after another has ended.
    """
    begin, end = max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves)
    at = np.unique(np.concatenate([steps for steps, _ in curves]))
    at = at[(at >= begin) & (at <= end)]
    return at, np.stack([np.interp(at, steps, own) for steps, own in curves])


def _most_together(curves: Mapping[str, Curve]) -> list[str]:
    """Return the names of the most curves that have a step in common, at the earliest such step."""
    together = [
        [name for name, (steps, _) in curves.items() if steps[0] <= begin <= steps[-1]]
        for begin in sorted(steps[0] for steps, _ in curves.values())
    ]
    return max(together, key=len)


def _band(text: str, curves: Mapping[str, Curve]) -> Band | None:
    """Return the band of a cell from its leagues' curves; None if no league has one."""
    known = {name: curve for name, curve in curves.items() if len(curve[0])}
    if not known:
        return None
    counted = _most_together(known)
    at, values = _aligned([known[name] for name in counted])
    if len(at) > POINTS:
        shown = np.unique(np.linspace(0, len(at) - 1, POINTS).round().astype(int))
        at, values = at[shown], values[:, shown]
    left_out = tuple(name for name in known if name not in counted)
    return Band(text, len(counted), at, values.mean(0), values.min(0), values.max(0), left_out)
