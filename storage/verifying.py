"""A whole store looked through for what is missing, orphaned or corrupt. Nothing in it is changed, however it fares.

First the blobs are listed and then the rows read, all as they are at one moment: so a row that names a blob which was
put meanwhile makes no finding, and what nobody names although it is old is an orphan, but where the store itself has
noted that no row names it any more. Where rows cannot be read, what they name is not known, and nothing is called
orphaned.
"""

import json
import time
from collections.abc import Mapping

from storage import arrays, recording
from storage.blobs import Blobs, Entry, open_blobs
from storage.database import Database
from storage.errors import Away, DamagedBlob, StorageError
from storage.examined import Rows
from storage.findings import Refer, Report, Tell, Use
from storage.opening import open_unchanged
from storage.places import blobs_place, database_url, shown

AGE = 3600.0
"""Seconds: what was put later than that may yet be named by a row."""


def verify(
    where: str, blobs: str | None = None, age: float = AGE, tell: Tell = lambda *_: None, refer: Refer = lambda _: (),
) -> Report:  # fmt: skip
    """Look through the store at `where`. Whatever is wrong with it is a finding, and raises nothing.

    What no row names is orphaned if it is older than `age` seconds. `refer` knows to what jobs point.

    Raises NotAStore, OldStore, NewerStore, Away (no server now) or StorageError where there is no store to look at.
    """
    url = database_url(where)
    kept = open_blobs(blobs_place(blobs, url))
    report, now = Report(shown(url)), time.time()
    try:
        listed: list[Entry] | None = list(kept.entries())
    except Away:
        listed = None
    engine = open_unchanged(url)
    try:
        rows = Rows(Database(engine, report.where), report, tell, bool(listed), refer)
        named = rows.read()
    finally:
        engine.dispose()
    if listed is None and named:
        report.add("missing", "blobs", f"their folder is not there (a disk not mounted?); rows name {len(named):,}")
    elif listed is not None:
        _examine(kept, named, report, tell)
        _orphans([entry for entry in listed if entry.put < now - age], named, rows.dropped, report)
    return report


def _examine(kept: Blobs, named: Mapping[str, Use], report: Report, tell: Tell) -> None:
    """Read every blob that a row names, and see that it is what the row takes it for."""
    for done, (digest, use) in enumerate(named.items()):
        tell("blobs", done, len(named))
        report.blobs += 1
        report.recordings += use.table == "matches"
        try:
            _content(kept.get(digest), use)
        except DamagedBlob as error:
            kind = "missing" if error.fault == "missing" else "corrupt"
            report.add(kind, f"blob {digest}", f"it is {error.fault}; {use.place} names it")
        except (StorageError, ValueError, RecursionError) as error:
            report.add("corrupt", f"blob {digest}", f"{error}; {use.place} names it")


def _player(snapshot: str) -> str:
    return snapshot.partition("@")[0]


def _content(data: bytes, use: Use) -> None:
    """Raise ValueError or StorageError where bytes that are as they were put are not what the row says."""
    if use.table == "matches":
        header = recording.from_bytes(data).header
        who = _player if use.training else str
        if use.sides and {who(name) for name in header.sides} != {who(name) for name in use.sides}:
            told = " against ".join(map(repr, header.sides))
            raise ValueError(f"it is a recording of {told}, not of this match")
    elif use.script is None:
        arrays.from_bytes(data)
    elif not isinstance(script := json.loads(data), dict) or script.get("script") != use.script:
        raise ValueError(f"it does not name the script {use.script!r}")


def _orphans(old: list[Entry], named: Mapping[str, Use], dropped: set[object], report: Report) -> None:
    for entry in old:
        if not entry.whole:
            report.add("orphaned", f"file {entry.name}", "a writer that was killed left it", entry.bytes)
        elif entry.name in dropped and entry.name not in named:
            report.dropped += 1
            report.dropped_bytes += entry.bytes
        elif report.told and entry.name not in named:
            report.add("orphaned", f"blob {entry.name}", "no row names it", entry.bytes)
