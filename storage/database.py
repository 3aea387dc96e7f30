"""A store's database: its transactions, rows read as records, and its complaints told in one line."""

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

from storage.errors import Away, StorageError
from storage.rows import columns, record_from, touch

R = TypeVar("R")

BUSY_SECONDS = 60  # how long a transaction waits for its turn before giving up


class Database:
    """Transactions of one database. Threads may share one; a connection lost is opened anew by the next transaction."""

    def __init__(self, engine: sa.Engine, where: str):
        self.engine = engine
        self.where = where  # for messages
        self.is_server = engine.dialect.name == "postgresql"
        # On a server a transaction around a single statement would be two more messages to wait for.
        self._alone = engine.execution_options(isolation_level="AUTOCOMMIT") if self.is_server else engine

    @contextmanager
    def reading(self) -> Iterator[sa.Connection]:
        """A connection for a statement that reads. On a server each is a transaction of its own, and so could write."""
        with plain_errors(self.where), self._alone.connect() as db:
            yield db

    @contextmanager
    def unchanging(self) -> Iterator[sa.Connection]:
        """A transaction that reads, and sees one state of the database however many statements it has."""
        with plain_errors(self.where), self.engine.connect() as db:
            if self.is_server:  # by default each of its statements sees what is new
                db = db.execution_options(isolation_level="REPEATABLE READ")
            yield db

    def sound(self, rows: Iterator[R], table: str) -> Iterator[R]:
        """Yield the rows of a table; raises StorageError for a damaged one."""
        with _sound_rows(self.where, table):
            yield from rows

    @contextmanager
    def writing(self, lasting: bool = True) -> Iterator[sa.Connection]:
        """A transaction that is committed whole at its end, or not at all where something is raised.

        One that is not `lasting` is not waited for until the disk has it: a power cut may undo it, and all others like
        it since the last one that is. That serves for what says who works now: a claim that is undone is a job that
        waits, and its holder is refused.
        """
        with plain_errors(self.where), self.engine.execution_options(writes=True, lasting=lasting).begin() as db:
            if not lasting and self.is_server:
                db.exec_driver_sql("SET LOCAL synchronous_commit = off")
            yield db

    @contextmanager
    def changing(self, leagues: Iterable[str]) -> Iterator[sa.Connection]:
        """A transaction that changes what planning reads of these leagues; see `rows.touch`."""
        with self.writing() as db:
            touch(db, leagues)
            yield db

    def rows(self, query: Any, **values: Any) -> Sequence[Any]:
        """The rows of a query with these values of its parameters, in a transaction of its own."""
        with self.reading() as db, _sound_rows(self.where):
            return db.execute(query, values).all()

    def records(
        self, record: type[R], table: sa.Table, *where: Any, order: Sequence[Any], limit: int | None = None
    ) -> list[R]:
        """The rows of a table as records that have its columns' names; raises StorageError for a damaged row."""
        query = _all(record, table).where(*where).order_by(*order).limit(limit)
        with self.reading() as db, _sound_rows(self.where, table.name):
            return [record_from(record, row) for row in db.execute(query)]

    def newest(
        self, record: type[R], table: sa.Table, league: str, of_each: sa.Column[Any], order: tuple[Any, ...]
    ) -> list[R]:
        """Of a league's rows with each value of a column, the first by `order`, as records, by that value."""
        query = _first_of_each(record, table, of_each, order)
        with self.reading() as db, _sound_rows(self.where, table.name):
            return [record_from(record, row) for row in db.execute(query, {"league": league})]


# What a manager asks for again and again is built once: that takes longer than a database to answer it.


@lru_cache
def _all(record: type, table: sa.Table) -> sa.Select:
    return sa.select(*columns(record, table))


@lru_cache
def _first_of_each(record: type, table: sa.Table, of_each: sa.Column[Any], order: tuple[Any, ...]) -> sa.Select:
    place = sa.func.row_number().over(partition_by=of_each, order_by=order).label("place")
    mine = table.c.league == sa.bindparam("league")
    ranked = sa.select(*columns(record, table), place).where(mine).subquery()
    return sa.select(*ranked.c[:-1]).where(ranked.c.place == 1).order_by(ranked.c[of_each.name])


@contextmanager
def plain_errors(where: str) -> Iterator[None]:
    """Tell a database's complaints as one line: Away for those that pass, StorageError for all others."""
    try:
        yield
    except PoolTimeout as error:
        raise Away(f"{where}: too many threads of this process are at the store") from error
    except DBAPIError as error:
        raise _told(where, error) from error
    except (SQLAlchemyError, OverflowError, UnicodeError) as error:  # a value that no column can hold
        if isinstance(told := getattr(error, "orig", None), StorageError):
            raise told from error
        raise StorageError(f"{where}: {_first_line(error)}.") from error


@contextmanager
def _sound_rows(where: str, table: str | None = None) -> Iterator[None]:
    try:
        yield
    except (ValueError, TypeError, LookupError) as error:
        place = f"a row of table {table!r}" if table else "a row"
        raise StorageError(f"{where}: {place} is damaged: {_first_line(error)}.") from error


def _told(where: str, error: DBAPIError) -> StorageError:
    """A database's complaint in one line, and whether it may pass."""
    cause = _first_line(error.orig)
    if error.connection_invalidated or _passes(error, where):
        locked = "database is locked|lock timeout"
        told = f"another process kept it locked for {BUSY_SECONDS} s" if re.search(locked, cause) else cause
        if "unable to open" in cause:
            told = "its folder is not there (a disk not mounted?)"
        if re.search(r"database or disk is full|No space left", cause):
            told = "the disk is full; nothing was half written. Free some space"
        return Away(f"{where}: {told}")
    return StorageError(f"{where}: {next((plain for p, plain in _PLAIN if re.search(p, cause)), f'{cause}.')}")


_PLAIN = (
    (
        "readonly database|unable to open|permission denied",
        "no permission to write there (SQLite needs it even to read).",
    ),
    ("(?i)foreign key", "a row names a league, player or snapshot that is not there; nothing was written."),
)


def _passes(error: DBAPIError, where: str) -> bool:
    """Whether a database's complaint is about now (gone, restarting, locked, full) and not about what was asked."""
    if isinstance(error.orig, sqlite3.Error):
        code = getattr(error.orig, "sqlite_errorcode", 0) & 0xFF  # none where the driver itself complains
        if code == sqlite3.SQLITE_CANTOPEN:
            return not Path(where).parent.exists()  # a disk that is not mounted now
        return code in _SQLITE_PASSING
    state = getattr(error.orig, "sqlstate", None)
    if state is not None:
        return state.startswith(_POSTGRES_PASSING)
    return isinstance(error, OperationalError) and not re.search(_POSTGRES_REFUSED, str(error.orig))


_SQLITE_PASSING = (
    *(sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_PROTOCOL),  # another has the lock
    *(sqlite3.SQLITE_IOERR, sqlite3.SQLITE_FULL),
)
# Connection lost; out of disk, memory or connections; shut down or starting; lock timeout, deadlock, could not
# serialise, cancelled; idle too long; the server's own disk.
_POSTGRES_PASSING = ("08", "53", "57P01", "57P02", "57P03", "55P03", "40", "57014", "25P03", "58")
# A server that answered no connection has no code: what its words tell is final.
_POSTGRES_REFUSED = (
    "authentication failed|no password supplied|does not exist|pg_hba.conf|permission denied|invalid .*option"
    "|invalid (integer|sslmode|port|.*dsn)"
)


def _first_line(error: object) -> str:
    """The first line of a complaint that tells something: psycopg heads a list of failures with a line of its own."""
    lines = [line.strip(" -.\t") for line in str(error).splitlines()]
    return next((line for line in lines if line and not line.endswith(":")), type(error).__name__)
