"""What a store can do without: blobs that no row names, what killed processes left, and by policy old checkpoints,
recordings and the bytes of snapshots. What a row still needs is never removed, nor anything younger than an age.

A blob is put before the row that names it is written, so one that is young may be named in a moment. Putting bytes that
are there already makes them young again, and what is removed is moved aside first and looked at once more: whoever puts
the same bytes at any moment has them afterwards. Rows go before the blobs that they name, which are noted as dropped
with them; killed in between, the next thinning removes those.

A thinned snapshot keeps its row, with a mark: its matches count, and it never plays again. Never thinned are scripts,
imports, a player's first and newest, and what a job that is still to be done names; and no job is queued that names a
thinned one (`rows.without_thinned`).
"""

import re
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import sqlalchemy as sa

from storage import tables as t
from storage.blobs import Blobs, Entry
from storage.database import Database
from storage.errors import Away, StorageError
from storage.moving import BLOBS, TABLES, is_digest
from storage.rows import NEWEST_CHECKPOINT, drop, texts

Tell = Callable[[str, int, int | None], None]
"""Is told how it goes on: of what, how much, and of how much."""
_DIGEST = re.compile(r"\b[0-9a-f]{64}\b")
BATCH = 500  # rows changed at once: others want to write too


@dataclass(frozen=True)
class Policy:
    """What stays of what could go. Nothing younger than `age` goes."""

    age: float  # seconds
    checkpoints: Mapping[str, int]  # league -> of each of its players so many of the newest stay, 1 or more
    recordings: int | None = None  # so many of the newest of each league stay; None: all of them
    recorded_for: float | None = None  # recordings that are older, in seconds, go; None: none for their age
    snapshots: Mapping[str, Collection[str]] = field(default_factory=dict)  # league -> those whose bytes may go


@dataclass(frozen=True)
class Waste:
    """What can go, as it was found."""

    checkpoints: Sequence[tuple[int, str]]  # id, league
    recordings: Sequence[tuple[str, int, str]]  # league, match, digest
    workers: Sequence[str]
    blobs: Sequence[Entry]  # that no row names, or none will
    files: Sequence[Entry]  # of writers that were killed
    before: float  # on the disk's clock: what was put later stays
    age: float
    snapshots: Sequence[tuple[str, str]] = ()  # league, name

    def __bool__(self) -> bool:
        return any((self.checkpoints, self.recordings, self.workers, self.blobs, self.files, self.snapshots))


@dataclass(frozen=True)
class Done:
    """How much of it went."""

    checkpoints: int
    recordings: int
    workers: int
    blobs: int
    files: int
    bytes: int
    snapshots: int = 0


def find(database: Database, blobs: Blobs, policy: Policy) -> Waste:
    """What can go by that policy; changes nothing. Raises StorageError where rows are damaged: then nothing may go."""
    before = time.time() - policy.age
    try:
        old = [entry for entry in blobs.entries() if entry.put < before]
    except Away:  # nothing was ever put, or the disk is gone; either way there is nothing to remove
        old = []
    _require_sound(database)
    if (every := _named(database)) and not any(map(blobs.has, islice(every, 100))):
        raise StorageError(
            f"{database.where}: no blob that rows name is where blobs are sought: say where, by --blobs."
        )
    checkpoints, recordings = _checkpoints(database, policy), _recordings(database, policy)
    snapshots = _snapshots(database, policy)
    named = _named(database, {id for id, _ in checkpoints}, {(league, id) for league, id, _ in recordings}, snapshots)
    c = t.workers.c
    silent = database.rows(sa.select(c.id).where(c.seen < t.now() - policy.age).order_by(c.id))
    return Waste(
        checkpoints, recordings, [id for (id,) in silent], [e for e in old if e.whole and e.name not in named],
        [e for e in old if not e.whole], before, policy.age, snapshots,
    )  # fmt: skip


def remove(database: Database, blobs: Blobs, waste: Waste, tell: Tell = lambda *_: None) -> Done:
    """Remove what was found, less what has been put or named since. May be called again after a kill."""
    c = t.checkpoints.c
    checkpoints = recordings = workers = snapshots = 0
    for some in _batches(waste.snapshots):
        tell("snapshots", snapshots, len(waste.snapshots))
        for league in {league for league, _ in some}:
            with database.changing([league]) as db:
                snapshots += _mark(db, league, [name for of, name in some if of == league], waste.age)
    for some in _batches(waste.checkpoints):
        tell("checkpoints", checkpoints, len(waste.checkpoints))
        with database.changing(league for _, league in some) as db:
            gone = sa.delete(t.checkpoints).where(c.id.in_([id for id, _ in some]), c.id.not_in(_newest(1)))
            digests = db.scalars(gone.returning(c.digest)).all()
            drop(db, digests)
            checkpoints += len(digests)
    m = t.matches.c
    for some in _batches(waste.recordings):
        tell("recordings", recordings, len(waste.recordings))
        with database.writing() as db:
            for league, id, digest in some:
                forget = sa.update(t.matches).where(m.league == league, m.id == id, m.recording == digest)
                recordings += db.execute(forget.values(recording=None)).rowcount
            drop(db, (digest for _, _, digest in some))
    w = t.workers.c
    for some in _batches(waste.workers):
        with database.writing() as db:
            gone = sa.delete(t.workers).where(w.id.in_(some), w.seen < t.now() - waste.age)
            workers += db.execute(gone).rowcount
    named = _named(database)
    removed: list[Entry] = []
    entries = [*(e for e in waste.blobs if e.name not in named), *waste.files]
    for done, entry in enumerate(entries):
        tell("files", done, len(entries))
        if blobs.remove(entry, waste.before):
            removed.append(entry)
    for some in _batches([entry.name for entry in removed if entry.whole]):
        with database.writing() as db:
            db.execute(sa.delete(t.dropped).where(t.dropped.c.digest.in_(some)))
    whole = sum(entry.whole for entry in removed)
    size = sum(entry.bytes for entry in removed)
    return Done(checkpoints, recordings, workers, whole, len(removed) - whole, size, snapshots)


def _mark(db: sa.Connection, league: str, names: Sequence[str], age: float) -> int:
    """Mark snapshots as thinned, those of them that may be; how many. Their league has been touched."""
    able = sorted(_thinnable(db, league, age).intersection(names))
    c = t.snapshots.c
    marked = sa.update(t.snapshots).where(c.league == league, c.name.in_(able)).values(thinned=t.now())
    digests = db.scalars(marked.returning(c.digest)).all()
    drop(db, digests)
    return len(digests)


def _thinnable(db: sa.Connection, league: str, age: float) -> set[str]:
    """The snapshots of a league that are not thinned and may be: older than `age`, trained, neither their player's
    first nor its newest, and named by no job that is still to be done.
    """
    c, j = t.snapshots.c, t.jobs.c
    rank = sa.func.row_number().over(partition_by=c.player, order_by=(c.iteration.desc(), c.name.desc()))
    ranked = sa.select(c.name, c.player, c.initial, c.thinned, c.created, rank.label("rank")).where(c.league == league)
    r = ranked.subquery().c
    able = (r.rank > 1, r.player.is_not(None), r.initial.is_(False), r.thinned.is_(None), r.created < t.now() - age)
    names = set(db.scalars(sa.select(r.name).where(*able)))
    try:
        for payload in db.scalars(sa.select(j.payload).where(j.league == league, j.state != "done")) if names else ():
            names.difference_update(texts(payload))
    except (ValueError, TypeError) as error:
        raise StorageError(f"A job of league {league!r} is damaged, so nothing is removed: {error}.") from error
    return names


def _newest(keep: int, *where: Any) -> sa.Select[Any]:
    """The ids of the newest checkpoints of each player."""
    c = t.checkpoints.c
    rank = sa.func.row_number().over(partition_by=(c.league, c.player), order_by=NEWEST_CHECKPOINT)
    ranked = sa.select(c.id, rank.label("rank")).where(*where).subquery()
    return sa.select(ranked.c.id).where(ranked.c.rank <= keep)


def _checkpoints(database: Database, policy: Policy) -> list[tuple[int, str]]:
    c = t.checkpoints.c
    found: list[tuple[int, str]] = []
    for league, keep in policy.checkpoints.items():
        kept = _newest(max(1, keep), c.league == league)
        old = (c.league == league, c.created < t.now() - policy.age, c.id.not_in(kept))
        found += [(id, league) for (id,) in database.rows(sa.select(c.id).where(*old).order_by(c.id))]
    return found


def _snapshots(database: Database, policy: Policy) -> list[tuple[str, str]]:
    found: list[tuple[str, str]] = []
    for league, names in policy.snapshots.items():
        with database.unchanging() as db:
            able = _thinnable(db, league, policy.age).intersection(names)
        found += [(league, name) for name in sorted(able)]
    return found


def _recordings(database: Database, policy: Policy) -> list[tuple[str, int, str]]:
    if policy.recordings is None and policy.recorded_for is None:
        return []
    c = t.matches.c
    rank = sa.func.row_number().over(partition_by=c.league, order_by=c.id.desc()).label("rank")
    ranked = sa.select(c.league, c.id, c.recording, c.created, rank).where(c.recording.is_not(None)).subquery()
    r = ranked.c
    beyond = [r.rank > policy.recordings] if policy.recordings is not None else []
    span = policy.recorded_for
    beyond += [r.created < t.now() - span] if span is not None else []
    query = sa.select(r.league, r.id, r.recording).where(r.created < t.now() - policy.age, sa.or_(*beyond))
    return [tuple(row) for row in database.rows(query.order_by(r.league, r.id))]


def _named(
    database: Database, checkpoints: Iterable[int] = (), recordings: Iterable[tuple[str, int]] = (),
    snapshots: Iterable[tuple[str, str]] = (),
) -> set[str]:  # fmt: skip
    """The blobs that rows need, other than these rows; raises StorageError where a row's blob cannot be told."""
    less: Mapping[str, set[Any]] = {
        "checkpoints": set(checkpoints), "matches": set(recordings), "snapshots": set(snapshots),
    }  # fmt: skip
    keys = {"checkpoints": ("id",), "matches": ("league", "id"), "snapshots": ("league", "name")}
    named: set[str] = set()
    with database.unchanging() as db:
        for name, column in BLOBS.items():
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
        named.update(_awaited(db))
    return named


def _awaited(db: sa.Connection) -> Iterable[str]:
    """The blobs to which jobs point that are still to be done, such as the checkpoint that a player is to copy.

    Its row may have gone meanwhile. Whatever stands in a payload like a blob's name counts, whoever can read the rest.
    """
    c = t.jobs.c
    payload = sa.type_coerce(c.payload, sa.types.NullType())
    for (text,) in db.execute(sa.select(payload).where(c.state.in_(("queued", "leased")))):
        yield from _DIGEST.findall(str(text))


def _require_sound(database: Database) -> None:
    """Raise StorageError where SQLite's file is damaged: rows that cannot be seen may need what none seems to need."""
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
