"""Learning curves as the page needs them: columns of the metrics that it plots, and the newest rows."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from league.queries.columns import NEWEST
from league.queries.query import Open, curve_rows
from league.queries.ratings.rating_rows import Row
from storage.records import CurveColumns

DRAWN = {
    "score": "score in training", "reward": "reward per step", "length": "steps per episode", "entropy": "entropy",
    "explained_variance": "explained variance of the critic",
}  # fmt: skip
"""Metrics of learning that are plotted if they were recorded."""
SPEED = "steps_per_second"


@dataclass(frozen=True)
class LearningCurves:
    """Curves of all players. A row for each of millions of iterations would take gigabytes."""

    columns: Mapping[str, CurveColumns]  # by player
    newest: Sequence[Row]  # of all players, by (iteration, player), at most NEWEST

    @classmethod
    def of(cls, opened: Open) -> "LearningCurves":
        """Read the curves of a league."""
        columns = opened.store.curve_columns(opened.league, (*DRAWN, SPEED))
        return cls(columns, curve_rows(opened.store.newest_curves(opened.league, NEWEST)))

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

    def lines(self, metric: str, over: Literal["steps", "seconds"] = "steps") -> dict[str, list[tuple[float, float]]]:
        """Return a metric of each player that has it, as points over its steps or seconds of training."""
        return {name: found for name, own in self.columns.items() if (found := list(_points(own, metric, over)))}


def _points(own: CurveColumns, metric: str, over: Literal["steps", "seconds"]) -> Iterator[tuple[float, float]]:
    values = own.values[metric]
    if over == "steps":
        return ((x, y) for x, y in zip(own.steps, values, strict=True) if not math.isnan(y))
    return ((round(x, 3), y) for x, y in zip(own.seconds, values, strict=True) if not math.isnan(y))
