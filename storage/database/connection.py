"""A store's database: its transactions, rows read as records, and its errors translated to one line."""

import re
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import sqlalchemy as sa
from sqlalchemy.exc import DBAPIError, OperationalError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeout

from storage.database.garbage_collection import paused_garbage_collection
from storage.database.rows import bump_revisions, columns, record_from
from storage.errors import NoPermission, StorageError, Unavailable

R = TypeVar("R")

BUSY_SECONDS = 60  # a transaction waits so long for a lock before it gives up


class Database:
    """Transactions of one database. Threads may share a Database; the next transaction reopens a lost connection."""

    def __init__(self, engine: sa.Engine, where: str):
        self.engine = engine
        self.where = where  # for messages
        self.is_server = engine.dialect.name == "postgresql"
        # On a server a transaction around a single statement would cost two more round trips.
        self._alone = engine.execution_options(isolation_level="AUTOCOMMIT") if self.is_server else engine

    @contextmanager
    def reading(self) -> Iterator[sa.Connection]:
        """Yield a connection for statements that read. On a server each is a transaction of its own, and so could
        write.
        """
        with translated_errors(self.where), self._alone.connect() as db:
            yield db

    @contextmanager
    def repeatable_read(self) -> Iterator[sa.Connection]:
        """Yield a transaction that reads and sees one state of the database in all of its statements."""
        with translated_errors(self.where), self.engine.connect() as db:
            if self.is_server:  # by default each of its statements sees what is new
                db = db.execution_options(isolation_level="REPEATABLE READ")
            yield db

    def checked(self, rows: Iterator[R], table: str) -> Iterator[R]:
        """Yield the rows of a table. Raises StorageError for a damaged row."""
        with _checked_rows(self.where, table):
            yield from rows

    @contextmanager
    def writing(self, durable: bool = True) -> Iterator[sa.Connection]:
        """Yield a transaction that is committed whole at its end, or not at all where an exception is raised.

        With `durable` false, the commit does not wait for the disk: a power failure may undo it, together with all
        non-durable commits since the last durable one. This serves for the leases of running workers. If a claim is
        undone, the job returns to the queue and the holder's result is refused.
        """
        with translated_errors(self.where), self.engine.execution_options(writes=True, durable=durable).begin() as db:
            if not durable and self.is_server:
                db.exec_driver_sql("SET LOCAL synchronous_commit = off")
            yield db
        if not (self.is_server or Path(self.where).exists()):  # written to a file that was removed in the meantime
            raise Unavailable(f"{self.where}: it is not there any more (a disk not mounted, a file moved away?)")

    @contextmanager
    def writing_alone(self) -> Iterator[sa.Connection]:
        """Yield a connection to a server for statements that are transactions of their own, and write.

        Through a pooler it gets a transaction, which has the limits of waiting for a lock (`sessions.py`).
        """
        with translated_errors(self.where), self._alone.connect() as db:
            if not db.info.get("pooled"):
                yield db
                return
        with self.writing() as db:
            yield db

    @contextmanager
    def changing(self, leagues: Iterable[str]) -> Iterator[sa.Connection]:
        """Yield a transaction that changes what planning reads of these leagues; see `rows.bump_revisions`."""
        with self.writing() as db:
            bump_revisions(db, leagues)
            yield db

    def rows(self, query: Any, **values: Any) -> Sequence[Any]:
        """Return the rows of a query with these parameter values, in a transaction of its own."""
        with self.reading() as db, _checked_rows(self.where):
            return db.execute(query, values).all()

    def records(
        self, record: type[R], table: sa.Table, *where: Any, order: Sequence[Any], limit: int | None = None,
        omit: tuple[str, ...] = (),
    ) -> list[R]:  # fmt: skip
        """Return the rows of a table as records with its columns' names. Raises StorageError for a damaged row.

        Text columns named by `omit` are not read, and are empty.
        """
        query = _all(record, table, omit).where(*where).order_by(*order).limit(limit)
        with self.reading() as db, _checked_rows(self.where, table.name), paused_garbage_collection():
            return [record_from(record, row) for row in db.execute(query)]

    def records_in(
        self, db: sa.Connection, record: type[R], table: sa.Table, *where: Any, order: Sequence[Any],
        limit: int | None = None,
    ) -> list[R]:  # fmt: skip
        """Return records as `records` does, as a step of the caller's transaction."""
        query = _all(record, table).where(*where).order_by(*order).limit(limit)
        with _checked_rows(self.where, table.name), paused_garbage_collection():
            return [record_from(record, row) for row in db.execute(query)]

    def newest(
        self, record: type[R], table: sa.Table, league: str, of_each: sa.Column[Any], order: tuple[Any, ...]
    ) -> list[R]:
        """Return, for each value of a column, the first of a league's rows by `order`, as records, by that value."""
        query = _first_of_each(record, table, of_each, order)
        with self.reading() as db, _checked_rows(self.where, table.name):
            return [record_from(record, row) for row in db.execute(query, {"league": league})]


# A manager sends these queries often. They are built once: building takes longer than the database's answer.


@lru_cache
def _all(record: type, table: sa.Table, omit: tuple[str, ...] = ()) -> sa.Select:
    return sa.select(*(sa.literal("").label(c.name) if c.name in omit else c for c in columns(record, table)))


@lru_cache
def _first_of_each(record: type, table: sa.Table, of_each: sa.Column[Any], order: tuple[Any, ...]) -> sa.Select:
    place = sa.func.row_number().over(partition_by=of_each, order_by=order).label("place")
    mine = table.c.league == sa.bindparam("league")
    ranked = sa.select(*columns(record, table), place).where(mine).subquery()
    return sa.select(*ranked.c[:-1]).where(ranked.c.place == 1).order_by(ranked.c[of_each.name])


@contextmanager
def translated_errors(where: str) -> Iterator[None]:
    """Translate a database's errors to one line: Unavailable for transient errors, StorageError for all others."""
    try:
        yield
    except PoolTimeout as error:
        raise Unavailable(f"{where}: too many threads of this process use the store") from error
    except DBAPIError as error:
        raise _translated(where, error) from error
    except (SQLAlchemyError, OverflowError, UnicodeError) as error:  # a value that a column cannot hold
        if isinstance(cause := getattr(error, "orig", None), StorageError):
            raise cause from error
        raise StorageError(f"{where}: {_first_line(error)}.") from error


@contextmanager
def _checked_rows(where: str, table: str | None = None) -> Iterator[None]:
    try:
        yield
    except (ValueError, TypeError, LookupError) as error:
        place = f"a row of table {table!r}" if table else "a row"
        raise StorageError(f"{where}: {place} is damaged: {_first_line(error)}.") from error


def _translated(where: str, error: DBAPIError) -> StorageError:
    """Return a database's error in one line, as Unavailable if it is transient."""
    cause = _first_line(error.orig)
    if error.connection_invalidated or _is_transient(error, where):
        locked = "database is locked|lock timeout"
        text = f"another process kept it locked for {BUSY_SECONDS} s" if re.search(locked, cause) else cause
        if "unable to open" in cause:
            text = "it is not there any more (a disk not mounted, a file moved away?)"
        if getattr(error.orig, "sqlstate", None) == _READ_ONLY:
            text = "it takes no writes now: is it a standby, which nobody has promoted yet?"
        if re.search(r"database or disk is full|No space left", cause):
            text = "the disk is full; nothing was half written. Free some space"
        return Unavailable(f"{where}: {text}")
    if re.search("readonly database|unable to open|permission denied", cause):
        return NoPermission(f"{where}: no permission to write there (SQLite needs it even to read).")
    if re.search("(?i)foreign key", cause):
        cause = "a row names a league, player or snapshot that is not there; nothing was written"
    return StorageError(f"{where}: {cause}.")


def _is_transient(error: DBAPIError, where: str) -> bool:
    """Return whether an error concerns the database's state (gone, restarting, locked, full), not the request."""
    if isinstance(error.orig, sqlite3.Error):
        code = getattr(error.orig, "sqlite_errorcode", 0) & 0xFF  # absent for errors of the driver itself
        if code == sqlite3.SQLITE_CANTOPEN:
            return not Path(where).exists()  # the disk is not mounted now, or the file was moved
        return code in _SQLITE_TRANSIENT
    state = getattr(error.orig, "sqlstate", None)
    if state is not None:
        return state.startswith(_POSTGRES_TRANSIENT)
    return isinstance(error, OperationalError) and not re.search(_POSTGRES_REFUSED, str(error.orig))


_SQLITE_TRANSIENT = (
    *(sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_PROTOCOL),  # another process holds the lock
    *(sqlite3.SQLITE_IOERR, sqlite3.SQLITE_FULL),
)
_READ_ONLY = "25006"  # from a standby, as during a failover
# Connection lost; out of disk, memory or connections; shut down or starting; lock timeout, deadlock, serialisation
# failure, cancelled; idle too long; the server's own disk.
_POSTGRES_TRANSIENT = ("08", "53", "57P01", "57P02", "57P03", "55P03", "40", "57014", "25P03", "58", _READ_ONLY)
# A refused connection has no code; these texts mean that the refusal is permanent.
_POSTGRES_REFUSED = (
    "authentication failed|no password supplied|does not exist|pg_hba.conf|permission denied|invalid .*option"
    "|invalid (integer|sslmode|port|target_session_attrs|.*dsn)|no such (user|database)"
)


def _first_line(error: object) -> str:
    """Return the first informative line of an error: psycopg puts a heading before a list of failures."""
    lines = [line.strip(" -.\t") for line in str(error).splitlines()]
    return next((line for line in lines if line and not line.endswith(":")), type(error).__name__)
