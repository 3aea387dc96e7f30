"""`league thin`: list the data that a store no longer needs, then remove it."""

import json
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from dashboards.tables import Column, render
from league.commands.options import STORE, parse
from league.commands.progress_bar import Progress
from league.config.durations import check_duration, seconds
from league.config.schema import ConfigError
from league.config.sections import Storage
from league.queries.query import Open
from league.snapshots.retention import may_go
from league.state.liveness import leader, processes
from storage.database.urls import blobs_are_exclusive, blobs_location, database_url, display_location
from storage.maintenance.thinning import Removable, RetentionPolicy
from storage.store import Store

WORKING = 3600.0
"""Least age in seconds of removed data while a league runs: no worker takes so long from a blob to its row."""


@dataclass(frozen=True)
class ThinOptions:
    """The data to keep, and the store."""

    checkpoints: int | None = field(default=None, metadata={"low": 1})
    """Newest checkpoints to keep of each player (none: its league's storage.checkpoints)."""
    recordings: int | None = field(default=None, metadata={"low": 0})
    """Newest recordings to keep of each league (none: all); the matches stay in the log."""
    recordings_for: str | None = field(default=None, metadata={"valid": check_duration})
    """Remove recordings that are older, e.g. 30d (none: keep them at any age)."""
    snapshots: int | None = field(default=None, metadata={"low": 1})
    """Snapshots to keep of each player in every doubling of its iterations (none: all), besides those that are needed;
    the others keep their matches and ratings, and never play again."""
    age: str = field(default="1d", metadata={"valid": check_duration})
    """Nothing younger is removed."""
    dry_run: bool = False
    """Only list what would be removed."""
    alone: bool = False
    """No other store keeps its blobs in the same folder; to be said where the folder may be shared."""
    store: str = STORE
    """The store: a folder, or a URL such as sqlite:///runs/league.db or postgresql://host/league."""
    blobs: str | None = None
    """Place of the store's policies and recordings (none: ROBOT_LEAGUE_BLOBS if set, else beside a SQLite store)."""
    format: Literal["table", "json"] = "table"
    """table for people, json for programs."""


def thin(args: list[str]) -> int:
    """Remove data that is no longer needed."""
    what = (
        "Remove blobs that no row names, what killed processes left, old checkpoints and, if asked, old recordings and"
        " snapshots. Never what a row still needs. The league may run meanwhile."
    )
    options = parse(ThinOptions, args, "thin", what)
    progress, age = Progress("thinning"), seconds(options.age)
    with Store.open(options.store, blobs=options.blobs) as store:
        _require_alone(options)
        _require_rest(store, age)
        _require_no_others(store)
        removable = store.find_removable(_policy(store, options, age))
        rows = _rows(removable)
        if options.format == "table" and removable:
            print(render(rows, COLUMNS, title="What would go:" if options.dry_run else "What goes:"), flush=True)
        done = None if options.dry_run or not removable else store.thin(removable, progress.tell)
        progress.end()
    if options.format == "json":
        print(json.dumps({"store": store.where, "found": rows, "removed": done and asdict(done)}, indent=2))
    elif not removable:
        print(f"{store.where}: there is nothing to remove that is older than {options.age} (--age).")
    elif done is None:
        print("Nothing was removed: this was a dry run.")
    else:
        print(
            f"Removed {done.bytes:,} bytes: {done.blobs:,} blobs and {done.files:,} files of killed writers; forgot"
            f" {done.checkpoints:,} checkpoints, {done.recordings:,} recordings and {done.workers:,} processes; thinned"
            f" {done.snapshots:,} snapshots."
        )
    return 0


COLUMNS = (Column("what", no_wrap=True), Column("number", no_wrap=True), Column("bytes", no_wrap=True), "why")


def _rows(removable: Removable) -> list[dict[str, Any]]:
    """Return removable data as rows. Bytes are counted with the blobs, since several rows may name one blob."""
    found = [
        ("checkpoints", len(removable.checkpoints), None, "each player has as many newer ones as stay"),
        ("snapshots", len(removable.snapshots), None, "others near them stay; their matches stay, and count"),
        ("recordings", len(removable.recordings), None, "older than those that stay; the matches stay"),
        (
            "blobs",
            len(removable.blobs),
            sum(e.bytes for e in removable.blobs),
            "no row names them, or none will after that",
        ),
        ("files", len(removable.files), sum(e.bytes for e in removable.files), "writers that were killed left them"),
        ("processes", len(removable.workers), None, "they went without a word"),
    ]
    return [dict(zip(("what", "number", "bytes", "why"), row, strict=True)) for row in found if row[1]]


def _policy(store: Store, options: ThinOptions, age: float) -> RetentionPolicy:
    every = store.leagues()
    leagues = [league.name for league in every]
    keep = {
        name: options.checkpoints
        or max(1, Open(store, name).setting("storage", "checkpoints", otherwise=Storage().checkpoints))
        for name in leagues
    }
    span = None if options.recordings_for is None else seconds(options.recordings_for)
    chosen = {} if options.snapshots is None else {n: may_go(Open(store, n), options.snapshots, every) for n in leagues}
    return RetentionPolicy(age, keep, options.recordings, span, chosen)


def _require_rest(store: Store, age: float) -> None:
    """Raise ConfigError if a league runs and `age` is so low that data in use could be removed."""
    running = [x.name for x in store.leagues() if leader(store, x.name) or processes(store, x.name)]
    if running and age < WORKING:
        raise ConfigError(
            ("age",),
            f"--age is less than 1h and league {running[0]} runs: what is so young may be in use. Give --age 1h or"
            " more, or `league stop` it first",
        )


def _require_no_others(store: Store) -> None:
    """Raise ConfigError if other stores have left their marks among the blobs, whatever the options say."""
    if others := store.blobs.other_identities():
        place = store.blobs.kept.location
        raise ConfigError(
            ("alone",),
            f"another store keeps its blobs in {place} too (its mark {others[0]!r} is there), and they would be taken"
            " for orphans: give each a place of its own. The mark of a store that is no more can be removed by hand",
        )


def _require_alone(options: ThinOptions) -> None:
    """Raise ConfigError if another store may have blobs there, which would look like orphans of this store."""
    url = database_url(options.store)
    kept = blobs_location(options.blobs, url)
    if not (options.alone or blobs_are_exclusive(kept, url)):
        raise ConfigError(
            ("alone",),
            f"another store may keep its blobs in {display_location(kept)} too, and they would be taken for orphans:"
            " --alone says that none does",
        )
