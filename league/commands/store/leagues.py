"""`league list`: the leagues of a store."""

from dataclasses import dataclass
from typing import Literal

from dashboards.tables import Column, render
from league.commands.options import STORE, parse
from league.queries.ratings.rating_rows import when
from league.state.league_list import league_rows
from storage.store import Store

COLUMNS = (
    Column("league", no_wrap=True), Column("state", no_wrap=True), "steps", Column("newest", no_wrap=True),
    Column("last", "last activity", no_wrap=True), "arena", "players",
)  # fmt: skip
STAGE = Column("stage", no_wrap=True)


@dataclass(frozen=True)
class ListOptions:
    """The store, and the format of the output."""

    store: str = STORE
    """The store: a folder, or a URL such as sqlite:///runs/league.db or postgresql://host/league."""
    blobs: str | None = None
    """Place of the store's policies and recordings (none: ROBOT_LEAGUE_BLOBS if set, else beside a SQLite store)."""
    format: Literal["table", "json", "csv"] = "table"
    """table for people, json or csv for programs."""


def list(args: list[str]) -> int:
    """Print the leagues of a store."""
    what = "The leagues of a store: arena, players, newest snapshot, steps, whether each runs, when it last did."
    options = parse(ListOptions, args, "list", what)
    with Store.open(options.store, blobs=options.blobs) as store:
        rows, where = [{**row, "active": when(row["active"])} for row in league_rows(store)], store.where
    if options.format != "table":
        print(render(rows, (), options.format))
        return 0
    rows = [{**row, "last": row["active"][:16].replace("T", " ")} for row in rows]
    staged = [STAGE] if any(row["stage"] for row in rows) else []
    print(render(rows, [COLUMNS[0], *staged, *COLUMNS[1:]]))
    none = f"\n{where} holds no league yet: `league run` makes one."
    print("\n--league NAME names one of them to any other command." if rows else none)
    return 0
