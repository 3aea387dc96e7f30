"""Curves of a metric over steps, with bands: the mean and the range over the leagues of a cell."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from league.config.schema import ConfigError
from league.queries.ratings.rating_rows import rating_rows
from league.runs.comparison.cells import Cell, Member
from league.runs.sweeps.objective import measured_players

OF_SNAPSHOTS = ("vs_initial", "success", "elo")
"""Metrics of rated snapshots, from each league's own ladder; all others are recorded in each learning iteration."""
POINTS = 100  # most steps at which a band is told


@dataclass(frozen=True, eq=False)
class Band:
    """A metric of a cell over steps: arrays (n,), up to the last step that all its leagues have reached."""

    cell: str
    leagues: int
    steps: np.ndarray
    mean: np.ndarray
    low: np.ndarray  # of the lowest league
    high: np.ndarray  # of the highest league

    def at(self, step: float) -> tuple[float, float, float]:
        """Return mean, low and high at a step, from the points beside it."""
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


def bands(found: Sequence[Cell], metric: str) -> list[Band]:
    """Return the band of each cell that has the metric.

    Raises ConfigError, which lists the recorded metrics, if no league has it.
    """
    curves = {cell.text: [_curve(member, metric) for member in cell.members] for cell in found}
    if not any(len(steps) for each in curves.values() for steps, _ in each):
        known = sorted({key for cell in found for m in cell.members for p in m.opened.points() for key in p.values})
        if metric in OF_SNAPSHOTS or not known:
            return []
        raise ConfigError(
            ("metric",), f"metric {metric!r} was not recorded; there are: {', '.join((*OF_SNAPSHOTS, *known))}"
        )
    return [band for text, own in curves.items() if (band := _band(text, own)) is not None]


def _curve(member: Member, metric: str) -> tuple[np.ndarray, np.ndarray]:
    """Return steps and values (n,) of a league: the mean over the players by which it is measured.

    Between the points of a player its curve is interpolated.
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


def _of_player(points: Sequence[tuple[int, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Return steps and values (n,) of a player: the mean of its values where it has several at a step."""
    x, y = np.array(points, float).T
    steps, place = np.unique(x, return_inverse=True)
    return steps, np.bincount(place, y) / np.bincount(place)


def _aligned(curves: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Return the steps (n,) of all curves from the latest first to the earliest last one, and their values (curves, n).

    Outside these steps a mean would jump where one of the curves begins or ends.
    """
    begin, end = max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves)
    at = np.unique(np.concatenate([steps for steps, _ in curves]))
    at = at[(at >= begin) & (at <= end)] if end >= begin else np.array([end])
    return at, np.stack([np.interp(at, steps, own) for steps, own in curves])


def _band(text: str, curves: Sequence[tuple[np.ndarray, np.ndarray]]) -> Band | None:
    known = [(steps, values) for steps, values in curves if len(steps)]
    if not known:
        return None
    at, values = _aligned(known)
    if len(at) > POINTS:
        shown = np.unique(np.linspace(0, len(at) - 1, POINTS).round().astype(int))
        at, values = at[shown], values[:, shown]
    return Band(text, len(known), at, values.mean(0), values.min(0), values.max(0))
