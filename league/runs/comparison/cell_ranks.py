"""Ranks of cells: the mean of their leagues on one ladder, with an interval over the leagues."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from scipy.stats import t as student

from league.queries.ratings.rating_rows import Row
from league.runs.comparison.cells import Cell
from matchmaking.ratings.scores import quantile
from matchmaking.roles import without_exploiters


@dataclass(frozen=True)
class CellRank:
    """A cell on the ladder. `low` and `high` are the 95 % interval of its mean; `worst` and `best` its range."""

    cell: Cell
    leagues: int
    mean: float
    low: float
    high: float
    worst: float
    best: float

    @property
    def error(self) -> float:
        """Standard error of the mean."""
        return (self.high - self.low) / 2 / _quantile(self.leagues)

    def row(self) -> dict[str, Any]:
        """Return the cell as a row of a table."""
        return {
            "cell": self.cell.text, "leagues": self.leagues, "mean": self.mean, "low": self.low, "high": self.high,
            "worst": self.worst, "best": self.best, **self.cell.settings,
        }  # fmt: skip


def ranked(found: Sequence[Cell], rows: Sequence[Row], merit: str) -> list[CellRank]:
    """Return the cells with a known mean, best first.

    A league counts with the mean of its players that are no exploiters, or of all if there are no others. Over several
    leagues the interval is Student's, which holds what seeds and ratings vary; of one league it is that of its ratings.

    Args:
        found: the cells.
        rows: the ladder's rows, each with its `league` and the player's `role`.
        merit: `elo` or `success`.
    """
    ranks = []
    for cell in found:
        each = [r for m in cell.members if (r := _league(m.name, rows, merit)) is not None]
        if each:
            values = [value for value, _ in each]
            mean = statistics.fmean(values)
            if len(each) > 1:
                error = _quantile(len(each)) * statistics.stdev(values) / math.sqrt(len(each))
            else:
                error = each[0][1]
            ranks.append(CellRank(cell, len(each), mean, mean - error, mean + error, min(values), max(values)))
    return sorted(ranks, key=lambda rank: -rank.mean)


def verdict(ranks: Sequence[CellRank], digits: int) -> str:
    """Return a sentence that names the best cell, and tells whether it is surely better than the next."""
    if len(ranks) < 2:
        return ""
    first, second = ranks[:2]
    gap, sure = first.mean - second.mean, _sure(first, second)
    by = f"by {gap:.{digits}f} ({gap - sure:.{digits}f} to {gap + sure:.{digits}f})"
    if gap > sure:
        return f"Best: {first.cell.text}, better than the next, {second.cell.text}, {by}."
    seeds = "" if min(first.leagues, second.leagues) > 4 else "; more seeds would tell"
    return f"Highest: {first.cell.text}; it is not known whether it is better than {second.cell.text}, {by}{seeds}."


def _sure(first: CellRank, second: CellRank) -> float:
    """Return half of the 95 % interval of the difference of two means, by Welch's approximation."""
    parts = [(rank.error**2, rank.leagues - 1) for rank in (first, second)]
    total = sum(variance for variance, _ in parts)
    if total == 0:
        return 0.0
    spread = sum(variance**2 / free for variance, free in parts if free)
    free = total**2 / spread if spread else math.inf
    return float(student.ppf(0.975, free) if math.isfinite(free) else quantile(0.95)) * math.sqrt(total)


def _quantile(leagues: int) -> float:
    return float(student.ppf(0.975, leagues - 1)) if leagues > 1 else quantile(0.95)


def _league(name: str, rows: Sequence[Row], merit: str) -> tuple[float, float] | None:
    """Return the mean of a league's players and half of its interval; None if none that counts is known."""
    low, high = ("low", "high") if merit == "elo" else (f"{merit}_low", f"{merit}_high")
    of_league = [r for r in rows if r["league"] == name]
    counted = without_exploiters({r["name"]: r["role"] for r in of_league})
    known = [r for r in of_league if r[merit] is not None and (r["known"] or merit != "elo")]
    own = [r for r in known if r["name"] in counted]
    if not own:
        return None
    half = [(r[high] - r[low]) / 2 for r in own]
    return statistics.fmean(r[merit] for r in own), math.hypot(*half) / len(half)
