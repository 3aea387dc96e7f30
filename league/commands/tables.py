"""`league ratings`, `matches`, `snapshots`, `curves`: the store's tables, for people and for programs."""

import shlex
import shutil
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations, product
from typing import Literal

from dashboards.tables import Column, Format, render
from league.commands.options import Listing, parse
from league.config.schema import ConfigError
from league.query import Shown, curve_rows, match_rows, score_text, snapshot_rows
from league.rated import (
    VOID_LIMIT,
    Row,
    chosen,
    moment,
    rating_rows,
    side_score,
    side_text,
    unlike_sides,
    with_ticker,
)
from matchmaking.ladder import ANCHOR_ELO, UNKNOWN, Ladder
from matchmaking.payoff import quantile
from matchmaking.ticker import K, ticker
from storage.records import RATED, ArenaKey, Match, Player, Snapshot

TICKING = (
    f"The ticker is a sequential Elo (K = {K:g} a game) over the log: it depends on the order of the games and has no"
    " interval. elo ± is the rating, a fit of all games at once."
)
NEWEST = 30
"""Rows of a long table that are printed unless more are asked for."""

ABOUT = (
    Column("trained", whole=True), Column("role", whole=True), Column("player", whole=True),
    Column("last", "last played", whole=True),
)  # fmt: skip
LADDER = (
    Column("rank", "", 0), Column("name", "snapshot", whole=True), Column("elo", decimals=0), Column("error", "±", 0),
    "games", Column("win_rate", "win rate", 3), Column("vs_initial", "vs initial", 3),
    Column("void", "void %", whole=True), Column("result", "w-d-l", whole=True), *ABOUT,
)  # fmt: skip
TRIED = (
    Column("rank", "", 0), Column("name", "snapshot", whole=True), Column("success", decimals=3),
    Column("success_low", "from", 3), Column("success_high", "to", 3), "games", Column("void", "void %", whole=True),
    *ABOUT,
)  # fmt: skip
TICKED = (
    Column("rank", "", 0), Column("name", "snapshot", whole=True), Column("ticker", decimals=0),
    Column("elo", decimals=0), Column("error", "±", 0), "games", Column("role", whole=True),
    Column("player", whole=True),
)  # fmt: skip
MATCHES = (
    "match", Column("a", whole=True), Column("b", whole=True), Column("result", "w-d-l", whole=True), "voids",
    Column("score", decimals=3), Column("recorded", "rec."),
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


def _dated(value: str) -> None:
    moment(value)


@dataclass(frozen=True)
class RatingOptions(Listing):
    """Which ladder of which league, and how to print it."""

    arena: str | None = None
    """The ladder of this arena (none: that of the newest matches)."""
    engine: str | None = None
    """The ladder under this engine: c, jax or warp (none: that of the newest matches)."""
    all: bool = False
    """Every ladder, one after the other."""
    team: str | None = None
    """Only snapshots of this team, by its name or number, and scripts and imports of its roster (none: everyone's)."""
    role: str | None = None
    """Only snapshots of this role, such as main or fixed, which is that of scripts and imports (none: every role)."""
    as_of: str | None = field(default=None, metadata={"valid": _dated})
    """As it stood at the end of this day, or at this time: 2026-11-22 or 2026-11-22T10:30, in UTC (none: now)."""
    ticker: bool = False
    """The online Elo ticker beside the ratings: quick to follow, but it depends on the order of the games."""
    format: Literal["table", "json", "csv", "parquet"] = "table"  # type: ignore[assignment]
    """table for people; json, csv or parquet for programs."""


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


def ratings(args: list[str]) -> int:
    """Print the ladders."""
    options = parse(RatingOptions, args, "ratings", "Who is better, and how sure that is.")
    as_of = None if options.as_of is None else moment(options.as_of)
    with options.open() as opened:
        shown, teams = opened.shown(options.arena, options.engine, as_of, options.all), opened.teams()
        log = opened.store.matches(opened.league, RATED) if options.ticker else []
    found = []
    for ladder in shown.ladders:
        rows = rating_rows(ladder, shown.snapshots, shown.players, shown.void_limit)
        rows = chosen(rows, shown.players, teams, options.team, options.role)
        if options.ticker:
            rows = with_ticker(rows, ticker(_until(log, ladder, as_of), ladder.pool.parents))
        found.append((ladder, rows))
    if options.format == "parquet":
        _write_parquet([row for _, rows in found for row in rows])
    elif options.format == "table":
        tables = [rated_table(ladder, rows, shown, options.ticker) for ladder, rows in found]
        print("\n\n".join([*tables, *_others(shown.others, shown.key)]))
    else:
        print(render([row for _, rows in found for row in rows], (), options.format))
    return 0


def _until(log: Sequence[Match], ladder: Ladder, as_of: float | None) -> list[Match]:
    return [m for m in log if m.arena == ladder.arena and (as_of is None or m.created <= as_of)]


def _write_parquet(rows: list[Row]) -> None:
    """To standard output, which must not be a terminal. Raises ConfigError."""
    if sys.stdout.isatty():
        raise ConfigError(("format",), "--format parquet is no text: send it to a file, as in ... > ratings.parquet")
    try:
        import pandas as pd
        import pyarrow as pa
        import pyarrow.parquet
    except ImportError as error:
        need = f"--format parquet needs pyarrow ({error}): pip install 'robot-league[parquet]'"
        raise ConfigError(("format",), need) from None
    pyarrow.parquet.write_table(pa.Table.from_pandas(pd.DataFrame(rows), preserve_index=False), sys.stdout.buffer)


def matches(args: list[str]) -> int:
    """Print the match log."""
    options = parse(LogOptions, args, "matches", "Every batch of episodes, counted for a; the newest at the end.")
    with options.open() as opened:
        rows = match_rows(opened.store.matches(opened.league))
    if options.format == "table":
        rows = [{**row, "result": f"{row['wins']}-{row['draws']}-{row['losses']}"} for row in rows]
    unlike = [key for key in ("arena", "engine") if len({row[key] for row in rows}) > 1]
    shown = list(MATCHES) if all(row["purpose"] == "rating" for row in rows) else [MATCHES[0], PURPOSE, *MATCHES[1:]]
    print(_newest(rows, [*shown, *(Column(key, whole=True) for key in unlike)], options, args, "matches"))
    return 0


def snapshots(args: list[str]) -> int:
    """Print the frozen policies."""
    options = parse(Listing, args, "snapshots", "The frozen policies and scripted opponents.")
    with options.open() as opened:
        rows = snapshot_rows(opened.store.snapshots(opened.league))
    if options.format == "table":
        rows = [{**row, "digest": row["digest"][:12]} for row in rows]
    print(render(rows, SNAPSHOTS if options.format == "table" else (), options.format))
    return 0


def curves(args: list[str]) -> int:
    """Print learning curves."""
    options = parse(CurveOptions, args, "curves", "What learning was like, iteration by iteration.")
    with options.open() as opened:
        points = opened.points(options.player)
    rows = curve_rows(sorted(points, key=lambda p: (p.iteration, p.player)))  # of several players the newest of each
    known = {key for row in rows for key in row}
    columns = [c for c in CURVES if not known or (c if isinstance(c, str) else c.key) in known]  # none has learnt yet
    print(_newest(rows, columns, options, args, "curves"))
    return 0


def ratings_table(
    ladder: Ladder, frozen: Sequence[Snapshot], players: Sequence[Player], void_limit: float = VOID_LIMIT
) -> str:
    """A ladder as a table with what its figures mean, best first; where teams are unlike, a table for each side."""
    rows = rating_rows(ladder, frozen, players, void_limit)
    return rated_table(ladder, rows, Shown(ladder.arena, [ladder], [], list(frozen), list(players), void_limit))


def rated_table(ladder: Ladder, rows: list[Row], shown: Shown, ticking: bool = False) -> str:
    """The same of some of a ladder's rows, which get columns for people; or its ticker."""
    rows = for_people(rows)
    columns, sides = TRIED if ladder.one_team else LADDER, unlike_sides(shown.players)
    title = f"Online Elo ticker in {_told(ladder.arena)}" if ticking and ladder.arena else title_of(ladder)
    columns = TICKED if ticking else columns
    parts = [render(rows, columns, title=title)]
    if sides:
        of = {roster: [row for row in rows if row["roster"] == roster] for roster in sides}
        parts = [title, *(render(of[r], columns, title=f"{side_text(r)}:") for r in sides if of[r])]
    notes = notes_on(ladder, rows, shown)
    notes = [TICKING, *notes] if ticking else notes
    return "\n\n".join([*parts, *(["\n".join(map(wrapped, notes))] if notes else [])])


def for_people(rows: Sequence[Row]) -> list[Row]:
    """A ladder's rows with the columns that tables for people have beside those for programs."""
    return [
        {
            **row,
            "error": (row["high"] - row["low"]) / 2 if row["known"] else None,
            "elo": row["elo"] if row["known"] else None,
            "trained": None if row["seconds"] is None else clock(row["seconds"]),
            "void": _void(row),
            "result": f"{row['wins']}-{row['draws']}-{row['losses']}" if row["games"] else None,
            "last": row["last_played"] and row["last_played"][:16].replace("T", " "),
        }
        for row in rows
    ]


def notes_on(ladder: Ladder, rows: Sequence[Row], shown: Shown) -> list[str]:
    """What figures of a ladder mean, and how unlike sides fared; a line each."""
    sides = unlike_sides(shown.players)
    return [*_notes(ladder, rows, shown.void_limit, bool(sides)), *_between(ladder, shown.snapshots, sides)]


def clock(seconds: float) -> str:
    """A time as h:mm:ss, or m:ss below an hour."""
    hours, rest = divmod(int(seconds), 3600)
    minutes, rest = divmod(rest, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def title_of(ladder: Ladder) -> str:
    """What a ladder's table is called."""
    if ladder.arena is None:
        return "No rating match has been played yet."
    what = "Success" if ladder.one_team else "Elo"
    return f"{what} with 95 % intervals in {_told(ladder.arena)}"


def _told(key: ArenaKey) -> str:
    return f"{key.arena} under {key.engine} (rules {key.config_hash[:8]})"


def _notes(ladder: Ladder, rows: Sequence[Row], void_limit: float, by_side: bool) -> list[str]:
    """What the table's figures mean, one sentence or two for each that stands in it."""
    notes = []
    if ladder.arena is not None and not ladder.one_team:
        of = "each side's" if by_side else "the"
        notes.append(f"The mean of {of} initial snapshots is {ANCHOR_ELO:.0f} Elo.")
        if not all(row["known"] for row in rows):
            notes[0] += f" –: not yet known (an interval wider than {UNKNOWN:.0f} Elo, or no game)."
        if abs(side := ladder.ratings.side_advantage) >= 0.5:
            notes.append(
                f"Playing the first side is worth {side:+.0f} Elo: against an equal it scores"
                f" {100 * ladder.ratings.first_side():.1f} %, not 50."
            )
    if any(row["voids_own"] or row["voids_unclear"] for row in rows):
        text = "void %: episodes that unstable physics stopped, by the snapshot's own robots + of unclear cause."
        if any(row["flagged"] for row in rows):
            text += f" !: above {100 * void_limit:g} % by its own robots; ?: above it if the unclear ones are its own."
        notes.append(text)
    return notes


def _between(ladder: Ladder, frozen: Sequence[Snapshot], sides: Sequence[str]) -> list[str]:
    """How unlike sides fared against each other: all of them, and the newest of each."""
    notes = []
    for one, other in combinations(sides, 2):
        score = side_score(ladder, frozen, one, other)
        if not score.games:
            continue
        text = f"{side_text(one)} against {side_text(other)}: {score_text(score)} in all."
        known = sorted((s for s in frozen if s.player and ladder.known(s.name)), key=lambda s: s.iteration)
        newest = [[s.name for s in known if s.roster == roster][-1:] for roster in (one, other)]
        for a, b in product(*newest):
            text += f" By these ratings {a} scores {100 * ladder.ratings.expected(a, b):.1f} % against {b}."
        notes.append(text)
        if not {one, other} <= set(ladder.ratings.populations):
            continue
        tilt, error = ladder.ratings.tilt(one, other)
        notes.append(
            f"Between what stands at {ANCHOR_ELO:.0f} on either side the arena leans to"
            f" {side_text(one if tilt >= 0 else other)} by {abs(tilt):.0f} Elo (± {quantile(0.95) * error:.0f})."
        )
    if notes:
        notes.append("Elo tells skill within a side; between sides the tilt comes on top, role and skill in one.")
    return notes


def _void(row: Row) -> str | None:
    own, unclear = 100 * row["voids_own"], 100 * row["voids_unclear"]
    if not row["games"] and not own + unclear:
        return None
    return (f"{own:.1f}" + (f" + {unclear:.1f}" if unclear else "") if own or unclear else "0") + row["flagged"]


def _others(keys: Sequence[ArenaKey], shown: ArenaKey | None) -> list[str]:
    """Which other ladders there are, and how to see them."""
    if not keys or shown is None:
        return []
    lines = [f"  {_told(key)}: {_reached_by(key, shown)}" for key in keys]
    return ["\n".join(["Other ladders, not to be compared with this one (--all shows every one):", *lines])]


def _reached_by(key: ArenaKey, shown: ArenaKey) -> str:
    flags = [("--arena", key.arena)] if key.arena != shown.arena else []
    flags += [("--engine", key.engine)] if key.engine != shown.engine else []
    return f"league ratings {shlex.join(x for flag in flags for x in flag)}" if flags else "older rules, --all"


def _newest(
    rows: list[Row], columns: Sequence[Column | str], options: LogOptions, args: Sequence[str], command: str
) -> str:
    """The newest rows as text, and in a table how to see the others."""
    format: Format = options.format
    last = options.last if options.last is not None else NEWEST if format == "table" else len(rows)
    shown = rows if options.all else rows[max(0, len(rows) - last) :]
    text = render(shown, columns if format == "table" else (), format)
    if format != "table" or len(shown) == len(rows):
        return text
    more = f"league {command} {shlex.join([*_without(args, '--last'), '--last', str(4 * last)])}"
    return f"{text}\n\n" + wrapped(
        f"The newest {len(shown):,} of {len(rows):,}; `{more}` shows more, --all everything."
    )


def _without(args: Sequence[str], flag: str) -> list[str]:
    """The arguments less a flag and its value."""
    kept = list(args)
    for i, arg in enumerate(args):
        if arg == flag:
            return kept[:i] + kept[i + 2 :]
        if arg.startswith(f"{flag}="):
            return kept[:i] + kept[i + 1 :]
    return kept


def wrapped(text: str) -> str:
    """A paragraph, broken into lines of the terminal's width."""
    return textwrap.fill(text, shutil.get_terminal_size().columns)
