"""`league matches`, `snapshots`, `curves`: the store's tables, for people and for programs."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field

from dashboards.tables import Column, Format, render
from dashboards.text import wrapped
from league.commands.options import Listing, parse
from league.config.schema import ConfigError
from league.queries.columns import CURVES, NEWEST, PURPOSE, SNAPSHOTS, match_columns, result_text
from league.queries.query import MATCH_COLUMNS, curve_rows, match_rows, snapshot_rows
from league.queries.ratings.rating_rows import Row, when
from league.system.provenance import LINE
from storage.database.urls import without_passwords

POINT = "player", "iteration", "steps"  # what every row of learning curves begins with


@dataclass(frozen=True)
class LogOptions(Listing):
    """The league, the number of rows, and the format of the output."""

    last: int | None = field(default=None, metadata={"low": 1})
    """Number of the newest rows (none: 30 in a table, all of them as json and csv)."""
    all: bool = False
    """All rows, in a table too."""


@dataclass(frozen=True)
class CurveOptions(LogOptions):
    """The players whose learning curves are printed, the number of rows, and the format of the output."""

    player: str | None = None
    """Only this player's points (none: all players')."""
    metrics: tuple[str, ...] = ()
    """Print these metrics alone, such as event.goal,reward.result (none: the most important ones, and all of them as
    json and csv)."""


def matches(args: list[str]) -> int:
    """Print the match log."""
    options = parse(LogOptions, args, "matches", "Every batch of episodes, counted for a; the newest at the end.")
    with options.open() as opened:
        total = opened.store.last_match(opened.league)
        rows = match_rows(opened.store.log(opened.league, after=total - _asked(options, total)))
    if options.format == "table":
        rows = [{**row, "result": result_text(row)} for row in rows]
    columns = match_columns(rows)
    unlike = [key for key in ("arena", "engine") if len({row[key] for row in rows}) > 1]
    shown = columns if all(row["purpose"] == "rating" for row in rows) else [columns[0], PURPOSE, *columns[1:]]
    shown = [*shown, *(Column(key, no_wrap=True) for key in unlike)]
    print(_newest(rows, shown, options, args, "matches", total, MATCH_COLUMNS))
    return 0


def snapshots(args: list[str]) -> int:
    """Print the frozen policies."""
    options = parse(Listing, args, "snapshots", "The frozen policies and scripted opponents.")
    with options.open() as opened:
        ends = opened.store.settings_ends(opened.league, LINE)
        rows = snapshot_rows(opened.store.snapshots(opened.league, brief=True), ends)
    if options.format == "table":
        rows = [{**row, "digest": row["digest"][:12], "thinned": when(row["thinned"] or 0) or ""} for row in rows]
    shown = [*SNAPSHOTS, *(["thinned"] if any(row["thinned"] for row in rows) else [])]
    if len({row["code"] for row in rows if row["code"]}) > 1:
        shown.append(Column("code", no_wrap=True))
    print(render(rows, shown if options.format == "table" else (), options.format))
    return 0


def curves(args: list[str]) -> int:
    """Print learning curves."""
    options = parse(CurveOptions, args, "curves", "What learning was like, iteration by iteration.")
    with options.open() as opened:
        points = opened.points(options.player)
    rows = curve_rows(
        sorted(points, key=lambda p: (p.iteration, p.player))
    )  # of several players, the newest row of each
    columns = list(CURVES)
    if options.metrics and rows:
        rows, columns = _only(options.metrics, rows)
    elif options.format == "table":
        rows = [{**row, "void": _void(row)} for row in rows]
    known = {key for row in rows for key in row}
    shown = [
        c for c in columns if not known or (c if isinstance(c, str) else c.key) in known
    ]  # no player has learnt yet
    print(_newest(rows, shown, options, args, "curves", len(rows)))
    return 0


def _only(metrics: Sequence[str], rows: Sequence[Row]) -> tuple[list[Row], list[Column | str]]:
    """Return rows with these metrics alone, and their columns. Raises ConfigError for one that no row has."""
    asked = [name for name in dict.fromkeys(metrics) if name not in POINT]  # which every row shows
    recorded = {key for row in rows for key in row} - {*POINT}
    if unknown := [name for name in asked if name not in recorded]:
        there = ", ".join(sorted(recorded))
        raise ConfigError(("metrics",), f"nobody recorded {', '.join(unknown)}; there are {there}")
    columns = [*CURVES[: len(POINT)], *(Column(name, decimals=4) for name in asked)]
    return [{key: row.get(key) for key in (*POINT, *asked)} for row in rows], columns


def _void(row: Row) -> float | None:
    """Return the percentage of an iteration's episodes that were void; None if no episode ended."""
    void, ended = row.get("voids") or 0.0, row.get("episodes") or 0.0
    return 100 * void / (void + ended) if void + ended else None


def _asked(options: LogOptions, total: int) -> int:
    """Return the number of newest rows to print, of `total` rows."""
    last = options.last if options.last is not None else NEWEST if options.format == "table" else total
    return total if options.all else min(last, total)


def _newest(
    rows: list[Row], columns: Sequence[Column | str], options: LogOptions, args: Sequence[str], command: str,
    total: int, keys: Sequence[str] = (),
) -> str:  # fmt: skip
    """Return the newest of `total` rows as text; below a table, a hint how to see the others.

    `rows` has at least those that are printed; `keys` are the columns of a CSV without rows.
    """
    format: Format = options.format
    last = _asked(options, total)
    shown = rows[len(rows) - min(last, len(rows)) :]
    every = () if shown else keys
    text = render(shown, columns if format == "table" else every, format)
    if format != "table" or last == total:
        return text
    given = [without_passwords(word) for word in _without(args, "--last")]
    more = f"league {command} {shlex.join([*given, '--last', str(4 * last)])}"
    return f"{text}\n\n" + wrapped(f"The newest {len(shown):,} of {total:,}; `{more}` shows more, --all everything.")


def _without(args: Sequence[str], flag: str) -> list[str]:
    """Return the arguments without a flag and its value."""
    kept = list(args)
    for i, arg in enumerate(args):
        if arg == flag:
            return kept[:i] + kept[i + 2 :]
        if arg.startswith(f"{flag}="):
            return kept[:i] + kept[i + 1 :]
    return kept
