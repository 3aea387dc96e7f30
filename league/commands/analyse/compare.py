"""`league compare`: curves of several leagues with bands, and one ladder over their newest snapshots."""

import json
import os
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from dashboards.tables import render
from dashboards.text import wrapped
from league.commands.options import STORE, parse, positional, spelt
from league.commands.progress_bar import Progress, report_kernels
from league.config.durations import seconds
from league.config.schema import ConfigError
from league.config.sections import check_name
from league.queries.ratings.rating_rows import Row, side_text
from league.runs.comparison.cells import Cell, Member, cells, members
from league.runs.comparison.comparison_report import Comparison, page, text
from league.runs.comparison.curve_bands import OF_SNAPSHOTS, bands, metric_of, unrated
from storage.blobs.files import new_file
from storage.database.urls import display_location
from storage.store import Store

LISTED = 8  # most leagues that a line names


def _lasts(value: str) -> None:
    seconds(value)


@dataclass(frozen=True)
class CompareOptions:
    """The leagues, what is compared, and the format of the output."""

    leagues: tuple[str, ...] = positional((), many=True)
    """Leagues by name, by a pattern such as 'lr.*', or as STORE#LEAGUE of another store."""
    sweep: str | None = None
    """All leagues of the sweep of this name."""
    store: str = STORE
    """The store: a folder, or a URL such as sqlite:///runs/league.db or postgresql://host/league."""
    blobs: str | None = None
    """Place of the store's policies and recordings (none: ROBOT_LEAGUE_BLOBS if set, else beside a SQLite store)."""
    metric: str | None = None
    """The metric of the curves: vs_initial, success or elo of rated snapshots, or a recorded one such as reward (none:
    vs_initial, in an arena of one team success)."""
    play: bool = True
    """Play the newest snapshots against each other; --no-play shows curves, and the matches that were played before."""
    budget: str = field(default="1m", metadata={"flag": "for", "valid": _lasts})
    """Most time for these matches."""
    width: float | None = field(default=100.0, metadata={"above": 0.0, "high": 4000.0})
    """They end earlier when no 95 % interval is wider than this, in Elo."""
    episodes: int | None = field(default=None, metadata={"low": 2, "high": 2**40})
    """Most episodes of these matches (none: as the time allows)."""
    into: str | None = field(default=None, metadata={"valid": check_name})
    """The league of the store that keeps these matches, a new one or one that --into made (none: cross-play. and a
    digest of the arena's settings)."""
    format: Literal["table", "json", "csv"] = "table"
    """table for people; json has all; csv has the cells."""
    output: str | None = None
    """Also write a page with figures to this file, also as -o FILE.html; never over another one."""


def compare(args: list[str]) -> int:
    """Compare leagues."""
    what = (
        "Several leagues side by side: curves with the mean and range of leagues that differ by their seeds alone, one"
        " ladder over all their newest snapshots by matches between them, and which settings are best."
    )
    options = parse(CompareOptions, spelt(args), "compare", what)
    with ExitStack() as until_the_end:
        store = until_the_end.enter_context(Store.open(options.store, blobs=options.blobs))
        found = members(options.leagues, options.sweep, store, until_the_end)
        compared = _compared(options, found, store)
        title = f"Comparison of {options.sweep or ', '.join(m.name for m in found[:4])}"
        where = store.where
    if options.output is not None:
        from dashboards.web.document import document

        with new_file(Path(options.output)) as file:
            file.write(document(page(compared, title, f"Robot League, {where}")).encode())
    print(_told(options, compared))
    return 0


def _compared(options: CompareOptions, found: Sequence[Member], store: Store) -> Comparison:
    groups = cells(found)
    metric = options.metric or metric_of(found)
    curves = bands(groups, metric)
    rows, notes = _ladder(options, found, store)
    if metric in OF_SNAPSHOTS and (short := unrated(groups, curves)):
        notes = [*notes, wrapped(short)]
    merit = "success" if any(row["success"] is not None for row in rows) else "elo"
    if merit == "elo" and (missing := unplaced(rows)):
        notes = [*notes, wrapped(missing)]
    return Comparison(groups, metric, curves, rows, _ranks(groups, rows, merit), merit, notes)


def unplaced(rows: Sequence[Row]) -> str:
    """Return a line that names the leagues with a snapshot whose rating is not known; else an empty text."""
    names = list(dict.fromkeys(row["league"] for row in rows if not row["known"]))
    if not names:
        return ""
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return (
        f"Ratings are not known yet (–) in {', '.join(names[:LISTED])}{more}: matches with the others are too few or"
        " none, and cells count what is known. A longer --for plays more."
    )


def _ranks(groups: Sequence[Cell], rows: Sequence[Row], merit: str) -> list:
    """Return the ranks of cells, of each side apart where the teams are unlike."""
    from league.runs.comparison.cell_ranks import ranked

    rosters = list(dict.fromkeys(row["roster"] for row in rows))
    sides = [
        ("" if len(rosters) == 1 else side_text(each), [r for r in rows if r["roster"] == each]) for each in rosters
    ]
    return [(side, ranks) for side, own in sides if (ranks := ranked(groups, own, merit))]


def _ladder(options: CompareOptions, found: Sequence[Member], store: Store) -> tuple[list[Row], list[str]]:
    """Play, unless --no-play, and return the rows of the ladder and notes about it."""
    from league.runs.comparison.cross_play import CrossPlay, require_own

    require_own(store, options.into)
    if not options.play:
        os.environ.setdefault("JAX_PLATFORMS", "cpu")
    try:
        crossed = CrossPlay(found, store, options.into)
    except ConfigError:
        if options.play:
            raise
        return [], []
    episodes, repeated = 0, ""
    if options.play:
        with report_kernels(), Progress("cross-play") as progress:
            for done in crossed.play(seconds(options.budget), options.episodes, options.width):
                episodes, repeated = done.episodes, done.repetition
                widest = "" if done.widest is None else f"widest interval {done.widest:.0f} Elo, "
                progress.tell(f"{widest}episodes", episodes, options.episodes)
    ladder, own = crossed.ladder(), crossed.arena.config_hash
    uncounted = [
        f"Not on the ladder: {number:,} episodes under {'other rules and ' * (key.config_hash != own)}engine"
        f" {key.engine}, because scores in them cannot be compared with those under engine {crossed.arena.engine.name}."
        for key, number in crossed.uncounted.items()
    ]
    if ladder.arena is None:
        return [], [*map(wrapped, uncounted)]
    notes = [
        f"{episodes:,} episodes were played now in {crossed.arena.name}; all are kept, and show who beats whom:"
        f"\n  league payoff --store {display_location(options.store)} --league {crossed.league}"
    ]
    notes += [repeated] if repeated else []
    if others := crossed.elsewhere:
        notes.append(f"These learnt under other rules or rewards than those of the matches: {', '.join(others)}.")
    if crossed.left_out:
        notes.append(f"Without a snapshot to play: {', '.join(crossed.left_out)}.")
    notes += uncounted
    return crossed.rows(ladder), [notes[0], *map(wrapped, notes[1:])]


def _told(options: CompareOptions, compared: Comparison) -> str:
    match options.format:
        case "json":
            return json.dumps({
                "curves": compared.curve_rows(), "ladder": compared.ladder_rows(), "cells": compared.cell_rows(),
                "verdicts": compared.verdicts(),
            }, indent=2)  # fmt: skip
        case "csv":
            return render(compared.cell_rows(), (), "csv")
    page = [f"Wrote {options.output}: any browser opens it."] if options.output else []
    return "\n\n".join([*text(compared), *page])
