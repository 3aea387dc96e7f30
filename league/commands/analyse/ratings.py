"""`league ratings`: the ladders, for people and for programs."""

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from dashboards.tables import render
from dashboards.terminal import supports_colour
from league.commands.ladder_text import rated_table
from league.commands.options import Listing, parse
from league.config.schema import ConfigError
from league.queries.ratings.ladder_tables import called
from league.queries.ratings.rating_rows import Row, chosen, moment, rating_rows, with_ticker
from matchmaking.ratings.ladder import Ladder
from matchmaking.ratings.online_elo import online_elo
from storage.records import RATED_PURPOSES, ArenaKey, Match


def _dated(value: str) -> None:
    moment(value)


@dataclass(frozen=True)
class RatingOptions(Listing):
    """The league and its ladder, and the format of the output."""

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


def ratings(args: list[str]) -> int:
    """Print the ladders."""
    options = parse(RatingOptions, args, "ratings", "Who is better, and how sure that is.")
    as_of = None if options.as_of is None else moment(options.as_of)
    with options.open() as opened:
        shown, teams = opened.shown(options.arena, options.engine, as_of, options.all), opened.teams()
        log = opened.store.matches(opened.league, RATED_PURPOSES) if options.ticker else []
    if options.ticker and any(ladder.payoff.rankings for ladder in shown.ladders):
        raise ConfigError(("ticker",), "--ticker follows games of two teams, and this arena has more: leave it out")
    found = []
    for ladder in shown.ladders:
        rows = rating_rows(ladder, shown.snapshots, shown.players, shown.void_limit)
        rows = chosen(rows, shown.players, teams, options.team, options.role)
        if options.ticker:
            rows = with_ticker(rows, online_elo(_until(log, ladder, as_of), ladder.pool.parents))
        found.append((ladder, rows))
    if options.format == "parquet":
        _write_parquet([row for _, rows in found for row in rows])
    elif options.format == "table":
        tables = [rated_table(ladder, rows, shown, options.ticker, supports_colour()) for ladder, rows in found]
        print("\n\n".join([*tables, *_others(shown.others, shown.key)]))
    else:
        print(render([row for _, rows in found for row in rows], (), options.format))
    return 0


def _until(log: Sequence[Match], ladder: Ladder, as_of: float | None) -> list[Match]:
    return [m for m in log if m.arena == ladder.arena and (as_of is None or m.created <= as_of)]


def _write_parquet(rows: list[Row]) -> None:
    """Write rows to standard output, which must not be a terminal. Raises ConfigError."""
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


def _others(keys: Sequence[ArenaKey], shown: ArenaKey | None) -> list[str]:
    """List the other ladders, and the command that shows them."""
    if not keys or shown is None:
        return []
    lines = [f"  {called(key)}: {_reached_by(key, shown)}" for key in keys]
    return ["\n".join(["Other ladders, not to be compared with this one (--all shows every one):", *lines])]


def _reached_by(key: ArenaKey, shown: ArenaKey) -> str:
    flags = [("--arena", key.arena)] if key.arena != shown.arena else []
    flags += [("--engine", key.engine)] if key.engine != shown.engine else []
    return f"league ratings {shlex.join(x for flag in flags for x in flag)}" if flags else "older rules, --all"
