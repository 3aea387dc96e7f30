"""A comparison of leagues as values: curves with bands, the ladder of cross-play, cells; and as a page."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from dashboards.tables import Column, render
from dashboards.text import wrapped
from dashboards.web import figures
from dashboards.web.document import FigureBlock, Page, Section, TableBlock
from league.queries.ratings.rating_rows import Row
from league.runs.comparison.cell_ranks import CellRank, verdict
from league.runs.comparison.cells import Cell
from league.runs.comparison.curve_bands import Band, apart

SHOWN_STEPS = 5  # steps at which a table tells a curve


@dataclass(frozen=True)
class Comparison:
    """All that `league compare` tells. `ranks` has the cells of each side: one, unless the teams are unlike."""

    cells: Sequence[Cell]
    metric: str
    bands: Sequence[Band]
    rows: Sequence[Row]  # of the ladder, best first; empty without cross-play
    ranks: Sequence[tuple[str, Sequence[CellRank]]]  # (side, cells), best first
    merit: str  # of the ladder: elo or success
    notes: Sequence[str]

    @property
    def digits(self) -> int:
        """Decimals of the merit."""
        return 0 if self.merit == "elo" else 3

    def curve_rows(self) -> list[dict[str, Any]]:
        """Return a row for each cell and step."""
        return [
            {"cell": band.cell, "leagues": band.leagues, "metric": self.metric, "steps": int(step), "mean": mean,
             "low": low, "high": high}
            for band in self.bands
            for step, mean, low, high in zip(*(a.tolist() for a in (band.steps, band.mean, band.low, band.high)),
                                             strict=True)
        ]  # fmt: skip

    def ladder_rows(self) -> list[dict[str, Any]]:
        """Return a row for each newest snapshot, best first."""
        cell_of = {member.name: cell.text for cell in self.cells for member in cell.members}
        low, high = figures.bounds(self.merit)
        return [
            {"rank": r["rank"], "name": r["name"], "league": r["league"], "cell": cell_of[r["league"]],
             self.merit: r[self.merit], "low": r[low], "high": r[high], "known": r["known"], "games": r["games"],
             "win_rate": r["win_rate"], "roster": r["roster"]}
            for r in self.rows
        ]  # fmt: skip

    def cell_rows(self) -> list[dict[str, Any]]:
        """Return a row for each cell, best first, of each side."""
        return [({"side": side} if side else {}) | rank.row() for side, ranks in self.ranks for rank in ranks]

    def verdicts(self) -> list[str]:
        """Return a sentence about the best cell, for each side."""
        found = [(side, verdict(ranks, self.digits)) for side, ranks in self.ranks]
        return [f"{side}: {text}" if side else text for side, text in found if text]


def text(found: Comparison) -> list[str]:
    """Return the comparison as blocks of text."""
    blocks = [_curves(found)] if found.bands else [f"No league has a curve of {found.metric} yet."]
    if alone := apart(found.bands, found.metric):
        blocks.append(wrapped(alone))
    if found.rows:
        columns = (
            Column("rank", "", 0), Column("name", "snapshot", no_wrap=True),
            Column(found.merit, decimals=found.digits), Column("error", "±", found.digits), "games", "cell",
        )  # fmt: skip
        rows = [
            {**row, "error": (row["high"] - row["low"]) / 2 if row["known"] else None,
             found.merit: row[found.merit] if row["known"] or found.merit != "elo" else None}
            for row in found.ladder_rows()
        ]  # fmt: skip
        mean = "; the mean of all is 1000" if found.merit == "elo" else ""
        blocks.append(f"Newest snapshots on one ladder, with 95 % intervals{mean}:\n{render(rows, columns)}")
    for side, ranks in found.ranks:
        of = f" of {side}" if side else ""
        digits = found.digits
        columns = (
            "cell", "leagues", Column("mean", decimals=digits), Column("low", "from", digits),
            Column("high", "to", digits), Column("worst", decimals=digits), Column("best", decimals=digits),
        )  # fmt: skip
        title = f"Cells{of}: mean over leagues with its 95 % interval, and the range of leagues:"
        blocks.append(f"{title}\n{render([rank.row() for rank in ranks], columns)}")
    return [*blocks, *found.verdicts(), *found.notes]


def _curves(found: Comparison) -> str:
    """Return the bands at a few steps as a table; a cell has no value at a step where it has no band."""
    at = _shown_steps(found.bands)
    rows = []
    for band in found.bands:
        told = {f"{step:,.0f}": _at(band, step) for step in at}
        rows.append({"cell": band.cell, "leagues": band.leagues, **told})
    columns = ["cell", "leagues", *(Column(f"{step:,.0f}", no_wrap=True) for step in at)]
    ranges = ", mean over leagues (lowest-highest)" if any(band.leagues > 1 for band in found.bands) else ""
    return f"{found.metric} over training steps{ranges}:\n{render(rows, columns)}"


def _shown_steps(bands: Sequence[Band]) -> list[float]:
    """Return steps from the latest first to the earliest last one of all bands.

    If one begins only after another has ended, return last steps of bands instead.
    """
    begin, end = max(band.steps[0] for band in bands), min(band.steps[-1] for band in bands)
    if end < begin:
        last = sorted({float(band.steps[-1]) for band in bands})
        return list(dict.fromkeys(last[i * (len(last) - 1) // (SHOWN_STEPS - 1)] for i in range(SHOWN_STEPS)))
    return [begin + (end - begin) * i / (SHOWN_STEPS - 1) for i in range(SHOWN_STEPS)] if end > begin else [end]


def _at(band: Band, step: float) -> str | None:
    """Return a band's mean at a step, with its range if it has several leagues; None where it has no band."""
    if (told := band.at(step)) is None:
        return None
    mean, low, high = told
    return f"{mean:.3g}" + (f" ({low:.3g}-{high:.3g})" if band.leagues > 1 else "")


def page(found: Comparison, title: str, about: str) -> Page:
    """Return the comparison as a page with figures."""
    points = found.curve_rows()
    caption = f"{found.metric} over training steps: mean of each cell's leagues, and the range of leagues."
    caption = " ".join(filter(None, [caption, apart(found.bands, found.metric)]))
    sections = [Section("curves", "Curves", [FigureBlock(figures.bands(points, found.metric), caption)])]
    if found.rows:
        rows = found.ladder_rows()
        low, high = figures.bounds(found.merit)
        drawn = [
            {**row, "player": row["cell"], low: row["low"], high: row["high"]}
            for row in rows
            if row["known"] or found.merit != "elo"
        ]
        about_ladder = "The newest snapshots on one ladder, with 95 % intervals, coloured by cell."
        table = TableBlock(render(rows, (), "html", "Ladder"), "Ladder")
        sections.append(
            Section("ladder", "Ladder", [FigureBlock(figures.ladder(drawn, found.merit), about_ladder), table])
        )
        cells = TableBlock(render(found.cell_rows(), (), "html", "Cells"), "Cells")
        sections.append(Section("cells", "Cells", ["\n".join([*found.verdicts(), *found.notes]), cells]))
    return Page(title, about, sections)
