"""`league matches`, `snapshots`, `curves`: the store's tables, for people and for programs."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field

from dashboards.tables import Column, Format, render
from league.commands.options import Listing, parse
from league.query import curve_rows, match_rows, snapshot_rows
from league.rated import Row, when
from league.words import wrapped

NEWEST = 30
"""Rows of a long table that are printed unless more are asked for."""
RECORDED = Column("recorded", "rec.")
MATCHES = (
    "match", Column("a", whole=True), Column("b", whole=True), Column("result", "w-d-l", whole=True), "voids",
    Column("score", decimals=3), RECORDED,
)  # fmt: skip
PURPOSE = Column("purpose", "for", whole=True)  # where there are others than the league's own rating matches
SNAPSHOTS = (
    Column("name", whole=True), "iteration", "steps", Column("seconds", "trained s", 1), "origin",
    Column("digest", "digest"),
)  # fmt: skip
# What a curve's table shows of the figures recorded, the most telling first; json and csv have them all.
CURVES = (
    Column("player", whole=True), Column("iteration", "it."), "steps", Column("score", decimals=2),
    Column("reward", decimals=4), Column("length", decimals=0), Column("entropy", decimals=2),
    Column("explained_variance", "expl.", 2), Column("voids", decimals=0), Column("steps_per_second", "steps/s", 0),
    Column("seconds", "trained s", 0),
)  # fmt: skip


@dataclass(frozen=True)
class LogOptions(Listing):
    """Which league, how much of it, and how to print it."""

    last: int | None = field(default=None, metadata={"low": 1})
    """So many of the newest rows (none: 30 in a table, all of them as json and csv)."""
    all: bool = False
    """Everything, in a table too."""


@dataclass(frozen=True)
class CurveOptions(LogOptions):
    """Whose learning curves, how much of them, and how to print them."""

    player: str | None = None
    """One player's (none: everyone's)."""


def matches(args: list[str]) -> int:
    """Print the match log."""
    options = parse(LogOptions, args, "matches", "Every batch of episodes, counted for a; the newest at the end.")
    with options.open() as opened:
        total = opened.store.last_match(opened.league)
        rows = match_rows(opened.store.matches(opened.league, after=total - _asked(options, total)))
    if options.format == "table":
        rows = [{**row, "result": f"{row['wins']}-{row['draws']}-{row['losses']}"} for row in rows]
    unlike = [key for key in ("arena", "engine") if len({row[key] for row in rows}) > 1]
    shown = list(MATCHES) if all(row["purpose"] == "rating" for row in rows) else [MATCHES[0], PURPOSE, *MATCHES[1:]]
    print(_newest(rows, [*shown, *(Column(key, whole=True) for key in unlike)], options, args, "matches", total))
    return 0


def snapshots(args: list[str]) -> int:
    """Print the frozen policies."""
    options = parse(Listing, args, "snapshots", "The frozen policies and scripted opponents.")
    with options.open() as opened:
        rows = snapshot_rows(opened.store.snapshots(opened.league))
    if options.format == "table":
        rows = [{**row, "digest": row["digest"][:12], "thinned": when(row["thinned"] or 0) or ""} for row in rows]
    shown = [*SNAPSHOTS, *(["thinned"] if any(row["thinned"] for row in rows) else [])]
    print(render(rows, shown if options.format == "table" else (), options.format))
    return 0


def curves(args: list[str]) -> int:
    """Print learning curves."""
    options = parse(CurveOptions, args, "curves", "What learning was like, iteration by iteration.")
    with options.open() as opened:
        points = opened.points(options.player)
    rows = curve_rows(sorted(points, key=lambda p: (p.iteration, p.player)))  # of several players the newest of each
    known = {key for row in rows for key in row}
    shown = [c for c in CURVES if not known or (c if isinstance(c, str) else c.key) in known]  # none has learnt yet
    print(_newest(rows, shown, options, args, "curves", len(rows)))
    return 0


def _asked(options: LogOptions, total: int) -> int:
    """How many of the newest of so many rows are wanted."""
    last = options.last if options.last is not None else NEWEST if options.format == "table" else total
    return total if options.all else min(last, total)


def _newest(
    rows: list[Row], columns: Sequence[Column | str], options: LogOptions, args: Sequence[str], command: str, total: int
) -> str:
    """The newest of so many rows, of which those at least are given, as text; in a table also how to see the others."""
    format: Format = options.format
    last = _asked(options, total)
    shown = rows[len(rows) - min(last, len(rows)) :]
    text = render(shown, columns if format == "table" else (), format)
    if format != "table" or last == total:
        return text
    more = f"league {command} {shlex.join([*_without(args, '--last'), '--last', str(4 * last)])}"
    return f"{text}\n\n" + wrapped(f"The newest {len(shown):,} of {total:,}; `{more}` shows more, --all everything.")


def _without(args: Sequence[str], flag: str) -> list[str]:
    """The arguments less a flag and its value."""
    kept = list(args)
    for i, arg in enumerate(args):
        if arg == flag:
            return kept[:i] + kept[i + 2 :]
        if arg.startswith(f"{flag}="):
            return kept[:i] + kept[i + 1 :]
    return kept
