"""`league thin`: remove what a store can do without, after saying what that is."""

import json
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from dashboards.tables import Column, render
from league.commands.moving import Progress
from league.commands.options import STORE, parse
from league.commands.verify import lasts
from league.config.durations import seconds
from league.config.schema import ConfigError
from league.config.sections import Storage
from league.history import may_go
from league.liveness import leader, processes
from league.query import Open
from storage.places import are_apart, blobs_place, database_url
from storage.store import Store
from storage.thinning import Policy, Waste

WORKING = 3600.0
"""Seconds: while a league runs nothing younger goes. From a blob to the row that names it no worker takes so long."""


@dataclass(frozen=True)
class ThinOptions:
    """What stays, and where."""

    checkpoints: int | None = field(default=None, metadata={"low": 1})
    """Of each player so many of the newest checkpoints stay (none: as many as its league's storage.checkpoints)."""
    recordings: int | None = field(default=None, metadata={"low": 0})
    """Of each league so many of the newest recordings stay (none: all); the matches stay in the log."""
    recordings_for: str | None = field(default=None, metadata={"valid": lasts})
    """Recordings that are older go, e.g. 30d (none: none for their age)."""
    snapshots: int | None = field(default=None, metadata={"low": 1})
    """Of each player so many snapshots of every doubling of its iterations stay (none: all), and those that are needed;
    the others keep their matches and ratings, and never play again."""
    age: str = field(default="1d", metadata={"valid": lasts})
    """Nothing younger goes, whatever it is."""
    dry_run: bool = False
    """Only say what would go."""
    alone: bool = False
    """No other store keeps its blobs in the same folder; to be said where the folder may be shared."""
    store: str = STORE
    """The store: a folder, or a URL such as sqlite:///runs/league.db or postgresql://host/league."""
    blobs: str | None = None
    """Where the store keeps policies and recordings (none: ROBOT_LEAGUE_BLOBS if set, else beside a SQLite store)."""
    format: Literal["table", "json"] = "table"
    """table for people, json for programs."""


def thin(args: list[str]) -> int:
    """Remove what nobody needs."""
    what = (
        "Remove blobs that no row names, what killed processes left, old checkpoints and, if asked, old recordings and"
        " snapshots. Never what a row still needs. The league may run meanwhile."
    )
    options = parse(ThinOptions, args, "thin", what)
    progress, age = Progress("thinning"), seconds(options.age)
    _require_alone(options)
    with Store.open(options.store, blobs=options.blobs) as store:
        _require_rest(store, age)
        waste = store.waste(_policy(store, options, age))
        rows = _rows(waste)
        if options.format == "table" and waste:
            print(render(rows, COLUMNS, title="What would go:" if options.dry_run else "What goes:"), flush=True)
        done = None if options.dry_run or not waste else store.thin(waste, progress.tell)
        progress.end()
    if options.format == "json":
        print(json.dumps({"store": store.where, "found": rows, "removed": done and asdict(done)}, indent=2))
    elif not waste:
        print(f"{store.where}: there is nothing to remove.")
    elif done is None:
        print("Nothing was removed: this was a dry run.")
    else:
        print(
            f"Removed {done.bytes:,} bytes: {done.blobs:,} blobs and {done.files:,} files of killed writers; forgot"
            f" {done.checkpoints:,} checkpoints, {done.recordings:,} recordings and {done.workers:,} processes; thinned"
            f" {done.snapshots:,} snapshots."
        )
    return 0


COLUMNS = (Column("what", whole=True), Column("number", whole=True), Column("bytes", whole=True), "why")


def _rows(waste: Waste) -> list[dict[str, Any]]:
    """What can go, as rows. Bytes stand with the blobs, which several rows may have named."""
    found = [
        ("checkpoints", len(waste.checkpoints), None, "each player has as many newer ones as stay"),
        ("snapshots", len(waste.snapshots), None, "others near them stay; their matches stay, and count"),
        ("recordings", len(waste.recordings), None, "older than those that stay; the matches stay"),
        ("blobs", len(waste.blobs), sum(e.bytes for e in waste.blobs), "no row names them, or none will after that"),
        ("files", len(waste.files), sum(e.bytes for e in waste.files), "writers that were killed left them"),
        ("processes", len(waste.workers), None, "they went without a word"),
    ]
    return [dict(zip(("what", "number", "bytes", "why"), row, strict=True)) for row in found if row[1]]


def _policy(store: Store, options: ThinOptions, age: float) -> Policy:
    leagues = [league.name for league in store.leagues()]
    keep = {
        name: options.checkpoints
        or max(1, Open(store, name).setting("storage", "checkpoints", otherwise=Storage().checkpoints))
        for name in leagues
    }
    span = None if options.recordings_for is None else seconds(options.recordings_for)
    chosen = {} if options.snapshots is None else {n: may_go(Open(store, n), options.snapshots) for n in leagues}
    return Policy(age, keep, options.recordings, span, chosen)


def _require_rest(store: Store, age: float) -> None:
    """While a league runs, only what is surely not in use goes. Raises ConfigError."""
    running = [x.name for x in store.leagues() if leader(store, x.name) or processes(store, x.name)]
    if running and age < WORKING:
        raise ConfigError(
            ("age",),
            f"--age is less than 1h and league {running[0]} runs: what is so young may be in use. Give --age 1h or"
            " more, or `league stop` it first",
        )


def _require_alone(options: ThinOptions) -> None:
    """Blobs of another store would look like orphans of this one. Raises ConfigError where there may be some."""
    url = database_url(options.store)
    kept = blobs_place(options.blobs, url)
    if not (options.alone or are_apart(kept, url)):
        raise ConfigError(
            ("alone",),
            f"another store may keep its blobs in {kept} too, and they would be taken for orphans: --alone says that"
            " none does",
        )
