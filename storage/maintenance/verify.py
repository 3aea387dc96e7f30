"""Verification of a whole store for missing, orphaned and corrupt data. Nothing in the store is changed.

The blobs are listed first, and the rows are read afterwards as one consistent state. A row that names a blob which was
put in the meantime is therefore no finding. An old blob that no row names is an orphan, unless the store has noted that
it was dropped. If some rows cannot be read, the blobs they name are unknown, and nothing is called orphaned.
"""

import json
import time
from collections.abc import Mapping

from storage.blobs import arrays, programs
from storage.blobs.blobs import BlobEntry, Blobs, open_blobs
from storage.blobs.folder import FolderBlobs
from storage.blobs.identity import store_identity
from storage.database.connection import Database
from storage.database.opening import open_unchanged
from storage.database.urls import blobs_location, database_url, display_url
from storage.errors import DamagedBlob, StorageError, Unavailable
from storage.maintenance.findings import BlobReference, JobReferences, ProgressCallback, VerificationReport
from storage.maintenance.raw_rows import RawRows
from storage.recordings import recording

MIN_ORPHAN_AGE = 3600.0
"""Seconds. A younger blob may still be named by a row that is about to be written."""


def verify(
    where: str,
    blobs: str | None = None,
    age: float = MIN_ORPHAN_AGE,
    progress: ProgressCallback = lambda *_: None,
    job_references: JobReferences = lambda _: (),
) -> VerificationReport:
    """Verify the store at `where`. Every fault is a finding in the report, and raises nothing.

    An unnamed blob is orphaned if it is older than `age` seconds. `job_references` returns what a job's payload refers
    to.

    Raises NotAStore, OldStore, NewerStore, Unavailable (database or blobs do not answer now) or StorageError where
    there is no store to verify.
    """
    url = database_url(where)
    kept = open_blobs(blobs_location(blobs, url))
    report, now = VerificationReport(display_url(url)), time.time()
    try:
        listed: list[BlobEntry] | None = list(kept.entries())
    except Unavailable:
        if not isinstance(kept, FolderBlobs) or kept.folder.exists():
            raise  # a server or a disk that does not answer says nothing about the blobs
        listed = None
    engine = open_unchanged(url)
    try:
        database = Database(engine, report.where)
        rows = RawRows(database, report, progress, bool(listed), job_references)
        named = rows.read()
        store = _identity(database)
    finally:
        engine.dispose()
    if listed is None and named:
        report.add("missing", "blobs", f"their folder is not there (a disk not mounted?); rows name {len(named):,}")
    elif listed is not None:
        _check_blobs(kept, named, report, progress)
        if report.damaged and store is not None and not kept.has_identity(store):
            report.add("missing", f"file {store}", "the store's identity is not among its blobs (a disk not mounted?)")
        _orphans([entry for entry in listed if entry.put < now - age], named, rows.dropped, report)
    return report


def _check_blobs(
    kept: Blobs, named: Mapping[str, BlobReference], report: VerificationReport, progress: ProgressCallback
) -> None:
    """Read every blob that a row names, and check that its content fits the row.

    Raises StorageError where the blobs cannot be read now, as from a server that does not answer.
    """
    for done, (digest, reference) in enumerate(named.items()):
        progress("blobs", done, len(named))
        report.blobs += 1
        report.recordings += reference.is_match
        try:
            data = kept.get(digest)
        except DamagedBlob as error:
            kind = "missing" if error.fault == "missing" else "corrupt"
            report.add(kind, f"blob {digest}", f"it is {error.fault}; {reference.place} names it")
            continue
        try:
            _require_content(data, reference)
        except (StorageError, ValueError, RecursionError) as error:
            report.add("corrupt", f"blob {digest}", f"{error}; {reference.place} names it")


def _identity(database: Database) -> str | None:
    """Return the store's identity; None if it has none, or if it cannot be read."""
    try:
        return store_identity(database)
    except StorageError:
        return None


def _player(snapshot: str) -> str:
    return snapshot.partition("@")[0]


def _require_content(data: bytes, reference: BlobReference) -> None:
    """Raise ValueError or StorageError for intact bytes that are not what the row says."""
    if reference.is_match:
        header = recording.from_bytes(data).header
        who = _player if reference.training else str
        if reference.sides and {who(name) for name in header.sides} != {who(name) for name in reference.sides}:
            sides = " against ".join(map(repr, header.sides))
            raise ValueError(f"it is a recording of {sides}, not of this match")
    elif reference.table == "snapshots" and programs.is_program(data):
        programs.from_bytes(data)
    elif reference.script is None:
        arrays.from_bytes(data)
    elif not isinstance(script := json.loads(data), dict) or script.get("script") != reference.script:
        raise ValueError(f"it does not name the script {reference.script!r}")


def _orphans(
    old: list[BlobEntry], named: Mapping[str, BlobReference], dropped: set[object], report: VerificationReport
) -> None:
    for entry in old:
        if not entry.whole:
            report.add("orphaned", f"file {entry.name}", "a writer that was killed left it", entry.bytes)
        elif entry.name in dropped and entry.name not in named:
            report.dropped += 1
            report.dropped_bytes += entry.bytes
        elif report.references_known and entry.name not in named:
            report.add("orphaned", f"blob {entry.name}", "no row names it", entry.bytes)
