"""Learning curves as the page needs them: columns of the metrics that it plots, and the newest rows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from arenas.description import EVENT_METRIC
from dashboards.web.figures import Line
from league.queries.columns import NEWEST
from league.queries.query import Open, curve_rows
from league.queries.ratings.rating_rows import Row
from storage.records import CurveColumns

DRAWN = {
    "score": "score in training", "reward": "reward per step", "length": "steps per episode", "entropy": "entropy",
    "explained_variance": "explained variance of the critic",
}  # fmt: skip
"""Metrics of learning that are plotted if they were recorded, before the arena's events."""
SPEED = "steps_per_second"


@dataclass(frozen=True)
class LearningCurves:
    """Curves of all players. A row for each of millions of iterations would take gigabytes."""

    columns: Mapping[str, CurveColumns]  # by player
    newest: Sequence[Row]  # of all players, by (iteration, player), at most NEWEST
    drawn: Mapping[str, str]  # what is plotted if it was recorded: metric -> title

    @classmethod
    def of(cls, opened: Open) -> "LearningCurves":
        """Read the curves of a league."""
        newest = curve_rows(opened.store.newest_curves(opened.league, NEWEST))
        drawn = DRAWN | {
            name: f"share of episodes with “{name.removeprefix(EVENT_METRIC)}”"
            for name in sorted({name for row in newest for name in row if name.startswith(EVENT_METRIC)})
        }
        return cls(opened.store.curve_columns(opened.league, (*drawn, SPEED)), newest, drawn)

    @property
    def total(self) -> int:
        """Number of iterations of all players."""
        return sum(len(own.iterations) for own in self.columns.values())

    @property
    def longest(self) -> int:
        """Number of iterations of the player that has the most."""
        return max((len(own.iterations) for own in self.columns.values()), default=0)

    @property
    def metrics(self) -> set[str]:
        """Names of all metrics that were recorded, also of those that are not plotted."""
        return {name for own in self.columns.values() for name in own.recorded}

    def lines(self, metric: str, over: Literal["steps", "seconds"] = "steps") -> dict[str, Line]:
        """Return a metric of each player that has it over its steps or seconds of training, as x and y."""
        found = ((name, _line(own, metric, over)) for name, own in self.columns.items())
        return {name: line for name, line in found if len(line[0])}


def _line(own: CurveColumns, metric: str, over: Literal["steps", "seconds"]) -> Line:
    x = own.steps if over == "steps" else [round(second, 3) for second in own.seconds]
    y, there = own.values[metric], ~np.isnan(own.values[metric])
    if there.all():
        return x, y
    kept = np.flatnonzero(there).tolist()
    return [x[i] for i in kept], [y[i] for i in kept]
