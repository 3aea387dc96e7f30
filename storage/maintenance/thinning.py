"""Thinning: removal of blobs that no row names, leftovers of killed processes, and, by policy, of old checkpoints,
recordings and the bytes of snapshots. Data that a row still needs is never removed, nor anything younger than an age.

A blob is put before the row that names it is written, so a row may soon name a young blob. Putting existing bytes again
makes them young, and a blob is moved aside and checked once more before it is deleted: a process that puts the same
bytes at any moment finds them present afterwards. Rows are removed before the blobs that they name, which are noted as
dropped in the same transaction. If thinning is killed in between, the next thinning removes these blobs.

A thinned snapshot keeps its row, with a mark: its matches count, and it never plays again. Never thinned are scripts,
imports, a player's first and newest snapshot, and snapshots named by unfinished jobs. No job is queued that names a
thinned snapshot (`rows.without_thinned`).
"""

import re
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import sqlalchemy as sa

from storage.blobs.blobs import BlobEntry, Blobs
from storage.database import schema as t
from storage.database.connection import Database
from storage.database.rows import NEWEST_CHECKPOINT, note_dropped, strings_in
from storage.errors import StorageError, Unavailable
from storage.maintenance.row_transfer import BLOB_COLUMNS, KEYS, MATCHES, TABLES, is_digest

ProgressCallback = Callable[[str, int, int | None], None]
"""Callback with the kind of work, the amount done, and the total."""
_DIGEST = re.compile(r"\b[0-9a-f]{64}\b")
BATCH = 500  # rows changed in one transaction, so that other processes can write in between


@dataclass(frozen=True)
class RetentionPolicy:
    """Limits on the data to keep. Nothing younger than `age` is removed."""

    age: float  # seconds
    checkpoints: Mapping[str, int]  # league -> number of newest checkpoints kept of each player, 1 or more
    recordings: int | None = None  # number of newest recordings kept of each league; None: all
    recorded_for: float | None = None  # older recordings, in seconds, are removed; None: no limit
    snapshots: Mapping[str, Collection[str]] = field(default_factory=dict)  # league -> snapshots that may be thinned


@dataclass(frozen=True)
class Removable:
    """The data found to be removable."""

    checkpoints: Sequence[tuple[int, str]]  # id, league
    recordings: Sequence[tuple[str, int, str]]  # league, match, digest
    workers: Sequence[str]
    blobs: Sequence[BlobEntry]  # blobs that no row names, or will name after the removal
    files: Sequence[BlobEntry]  # leftovers of killed writers
    before: float  # time on the disk's clock: blobs put later stay
    age: float
    snapshots: Sequence[tuple[str, str]] = ()  # league, name

    def __bool__(self) -> bool:
        return any((self.checkpoints, self.recordings, self.workers, self.blobs, self.files, self.snapshots))


@dataclass(frozen=True)
class Removed:
    """The numbers of removed items."""

    checkpoints: int
    recordings: int
    workers: int
    blobs: int
    files: int
    bytes: int
    snapshots: int = 0


def find_removable(database: Database, blobs: Blobs, policy: RetentionPolicy) -> Removable:
    """Find what the policy allows to remove, without changing anything.

    Raises StorageError where rows are damaged: then nothing may be removed.
    """
    before = time.time() - policy.age
    try:
        old = [entry for entry in blobs.entries() if entry.put < before]
    except Unavailable:  # nothing was ever put, or the disk is unmounted; either way there is nothing to remove
        old = []
    _require_undamaged(database)
    if (every := _needed_blobs(database)) and not any(map(blobs.has, islice(every, 100))):
        raise StorageError(
            f"{database.where}: no blob that rows name is where blobs are sought: say where, by --blobs."
        )
    checkpoints, recordings = _checkpoints(database, policy), _recordings(database, policy)
    snapshots = _snapshots(database, policy)
    named = _needed_blobs(
        database, {id for id, _ in checkpoints}, {(league, id) for league, id, _ in recordings}, snapshots
    )
    c = t.workers.c
    silent = database.rows(sa.select(c.id).where(c.seen < t.now() - policy.age).order_by(c.id))
    return Removable(
        checkpoints, recordings, [id for (id,) in silent], [e for e in old if e.whole and e.name not in named],
        [e for e in old if not e.whole], before, policy.age, snapshots,
    )  # fmt: skip


def remove(
    database: Database, blobs: Blobs, removable: Removable, progress: ProgressCallback = lambda *_: None
) -> Removed:
    """Remove what was found, except what has been put or named since. May be called again after a kill."""
    c = t.checkpoints.c
    checkpoints = recordings = workers = snapshots = 0
    for some in _batches(removable.snapshots):
        progress("snapshots", snapshots, len(removable.snapshots))
        for league in {league for league, _ in some}:
            with database.changing([league]) as db:
                snapshots += _mark_thinned(db, league, [name for of, name in some if of == league], removable.age)
    for some in _batches(removable.checkpoints):
        progress("checkpoints", checkpoints, len(removable.checkpoints))
        with database.changing(league for _, league in some) as db:
            # Rows that the end of a turn removes at this moment are left out: it may wait for the league's row.
            free = sa.select(c.id).where(c.id.in_([id for id, _ in some])).with_for_update(skip_locked=True)
            gone = sa.delete(t.checkpoints).where(c.id.in_(free), c.id.not_in(_newest(1)))
            digests = db.scalars(gone.returning(c.digest)).all()
            note_dropped(db, digests)
            checkpoints += len(digests)
    for some in _batches(removable.recordings):
        progress("recordings", recordings, len(removable.recordings))
        with database.writing() as db:
            for league, id, digest in some:
                for table in MATCHES:
                    m = table.c
                    forget = sa.update(table).where(m.league == league, m.id == id, m.recording == digest)
                    recordings += db.execute(forget.values(recording=None)).rowcount
            note_dropped(db, (digest for _, _, digest in some))
    w = t.workers.c
    for some in _batches(removable.workers):
        with database.writing() as db:
            gone = sa.delete(t.workers).where(w.id.in_(some), w.seen < t.now() - removable.age)
            workers += db.execute(gone).rowcount
    named = _needed_blobs(database)
    removed: list[BlobEntry] = []
    entries = [*(e for e in removable.blobs if e.name not in named), *removable.files]
    for done, entry in enumerate(entries):
        progress("files", done, len(entries))
        if blobs.remove(entry, removable.before):
            removed.append(entry)
    for some in _batches([entry.name for entry in removed if entry.whole]):
        with database.writing() as db:
            db.execute(sa.delete(t.dropped).where(t.dropped.c.digest.in_(some)))
    whole = sum(entry.whole for entry in removed)
    size = sum(entry.bytes for entry in removed)
    return Removed(checkpoints, recordings, workers, whole, len(removed) - whole, size, snapshots)


def _mark_thinned(db: sa.Connection, league: str, names: Sequence[str], age: float) -> int:
    """Mark these snapshots as thinned if allowed; return how many. Their league's row is locked."""
    able = sorted(_thinnable(db, league, age).intersection(names))
    c = t.snapshots.c
    marked = sa.update(t.snapshots).where(c.league == league, c.name.in_(able)).values(thinned=t.now())
    digests = db.scalars(marked.returning(c.digest)).all()
    note_dropped(db, digests)
    return len(digests)


def _thinnable(db: sa.Connection, league: str, age: float) -> set[str]:
    """Return the snapshots of a league that may be thinned and are not yet: older than `age`, trained, neither their
    player's first nor its newest, and not named by an unfinished job.
    """
    c, j = t.snapshots.c, t.jobs.c
    rank = sa.func.row_number().over(partition_by=c.player, order_by=(c.iteration.desc(), c.name.desc()))
    ranked = sa.select(c.name, c.player, c.initial, c.thinned, c.created, rank.label("rank")).where(c.league == league)
    r = ranked.subquery().c
    able = (r.rank > 1, r.player.is_not(None), r.initial.is_(False), r.thinned.is_(None), r.created < t.now() - age)
    names = set(db.scalars(sa.select(r.name).where(*able)))
    try:
        for payload in db.scalars(sa.select(j.payload).where(j.league == league, j.state != "done")) if names else ():
            names.difference_update(strings_in(payload))
    except (ValueError, TypeError) as error:
        raise StorageError(f"A job of league {league!r} is damaged, so nothing is removed: {error}.") from error
    return names


def _newest(keep: int, *where: Any) -> sa.Select[Any]:
    """Select the ids of the newest `keep` checkpoints of each player."""
    c = t.checkpoints.c
    rank = sa.func.row_number().over(partition_by=(c.league, c.player), order_by=NEWEST_CHECKPOINT)
    ranked = sa.select(c.id, rank.label("rank")).where(*where).subquery()
    return sa.select(ranked.c.id).where(ranked.c.rank <= keep)


def _checkpoints(database: Database, policy: RetentionPolicy) -> list[tuple[int, str]]:
    c = t.checkpoints.c
    found: list[tuple[int, str]] = []
    for league, keep in policy.checkpoints.items():
        kept = _newest(max(1, keep), c.league == league)
        old = (c.league == league, c.created < t.now() - policy.age, c.id.not_in(kept))
        found += [(id, league) for (id,) in database.rows(sa.select(c.id).where(*old).order_by(c.id))]
    return found


def _snapshots(database: Database, policy: RetentionPolicy) -> list[tuple[str, str]]:
    found: list[tuple[str, str]] = []
    for league, names in policy.snapshots.items():
        with database.repeatable_read() as db:
            able = _thinnable(db, league, policy.age).intersection(names)
        found += [(league, name) for name in sorted(able)]
    return found


def _recordings(database: Database, policy: RetentionPolicy) -> list[tuple[str, int, str]]:
    if policy.recordings is None and policy.recorded_for is None:
        return []
    each = [(table.c.league, table.c.id, table.c.recording, table.c.created) for table in MATCHES]
    c = sa.union_all(*(sa.select(*columns).where(columns[2].is_not(None)) for columns in each)).subquery().c
    rank = sa.func.row_number().over(partition_by=c.league, order_by=c.id.desc()).label("rank")
    ranked = sa.select(c.league, c.id, c.recording, c.created, rank).subquery()
    r = ranked.c
    beyond = [r.rank > policy.recordings] if policy.recordings is not None else []
    span = policy.recorded_for
    beyond += [r.created < t.now() - span] if span is not None else []
    query = sa.select(r.league, r.id, r.recording).where(r.created < t.now() - policy.age, sa.or_(*beyond))
    return [tuple(row) for row in database.rows(query.order_by(r.league, r.id))]


def _needed_blobs(
    database: Database, checkpoints: Iterable[int] = (), recordings: Iterable[tuple[str, int]] = (),
    snapshots: Iterable[tuple[str, str]] = (),
) -> set[str]:  # fmt: skip
    """Return the blobs that rows other than these need. Raises StorageError if a row's blob name is invalid."""
    less: Mapping[str, set[Any]] = {
        "checkpoints": set(checkpoints), "snapshots": set(snapshots),
        **{table.name: set(recordings) for table in MATCHES},
    }  # fmt: skip
    keys = {"checkpoints": ("id",), **{name: KEYS[name] for name in BLOB_COLUMNS if name in KEYS}}
    named: set[str] = set()
    with database.repeatable_read() as db:
        for name, column in BLOB_COLUMNS.items():
            table = TABLES[name]
            digest = sa.type_coerce(table.c[column], sa.types.NullType())
            query = sa.select(digest, *(table.c[key] for key in keys[name])).where(table.c[column].is_not(None))
            if table is t.snapshots:
                query = query.where(table.c.thinned.is_(None))
            for found, *key in db.execute(query, execution_options={"yield_per": 1000}):
                if not (isinstance(found, str) and is_digest(found)):
                    raise _damaged(database, f"a row of {name} names no blob")
                if (key[0] if len(key) == 1 else tuple(key)) not in less[name]:
                    named.add(found)
        named.update(_blobs_of_open_jobs(db))
    return named


def _blobs_of_open_jobs(db: sa.Connection) -> Iterable[str]:
    """Yield the blobs that unfinished jobs refer to, e.g. the checkpoint that a player is to copy.

    The blob's row may have been removed in the meantime. Every text in a payload that looks like a blob's name counts,
    even if the rest of the payload is unreadable.
    """
    c = t.jobs.c
    payload = sa.type_coerce(c.payload, sa.types.NullType())
    for (text,) in db.execute(sa.select(payload).where(c.state.in_(("queued", "leased")))):
        yield from _DIGEST.findall(str(text))


def _require_undamaged(database: Database) -> None:
    """Raise StorageError if SQLite's file is damaged: rows that cannot be seen may need blobs that seem unnamed."""
    with database.reading() as db:
        if db.dialect.name == "sqlite":
            for (line,) in db.exec_driver_sql("PRAGMA quick_check(1)"):
                if line != "ok":
                    raise _damaged(database, str(line).splitlines()[-1])


def _damaged(database: Database, what: str) -> StorageError:
    return StorageError(f"{database.where} is damaged ({what[:200]}): nothing is removed; `league verify` tells more.")


def _batches(found: Sequence[Any]) -> Iterable[list[Any]]:
    left = iter(found)
    while some := list(islice(left, BATCH)):
        yield some
