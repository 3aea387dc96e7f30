"""Opening a store's database: finding, making, migrating and refusing it."""

import json
import os
import secrets
import sqlite3
import stat
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.exc import DBAPIError, NoSuchModuleError

from storage import tables as t
from storage import waiting
from storage.database import BUSY_SECONDS, plain_errors
from storage.errors import NewerStore, NotAStore, OldStore, OutdatedStore, StorageError, disk_error
from storage.places import copied, shown


def open_database(url: sa.URL, create: bool, migrate: bool = False) -> sa.Engine:
    """Connect to the store at `url`, making it if `create` and nothing is there, and bring its schema up to date.

    A SQLite file of an older schema is copied before, to `league.db.schema-3` or so; what is on a server is brought up
    to date where `migrate` asks for it.

    Nothing is written to a store of today's schema, nor ever to a database that is something else. Transactions of
    `engine.execution_options(writes=True)` take SQLite's write lock at once, the others read.

    Raises NotAStore, OldStore, OutdatedStore, NewerStore, Away (no server now) or StorageError (no permission, no
    driver, no room for a copy).
    """
    where = shown(url)
    if url.get_backend_name() == "sqlite":
        found = _look_at_file(url, create)
        engine = _sqlite_engine(_file_url(Path(where), "rwc" if found == 0 else "rw"))
    else:
        engine, found = _server_engine(url, where), None
    try:
        with plain_errors(where):
            if found is None:
                found = _schema(engine, where)
            if found == 0 and not create:
                raise NotAStore(f"No league store at {where}: `league run` makes one.")
            if 0 < found < t.newest_schema() and url.get_backend_name() == "sqlite":
                _keep_copy(Path(where))
            elif 0 < found < t.newest_schema() and not migrate:
                raise OutdatedStore(where, found, t.newest_schema())
            if found < t.newest_schema():
                _migrate(engine)
    except BaseException:
        engine.dispose()
        raise
    return engine


def open_unchanged(url: sa.URL) -> sa.Engine:
    """Connect to the database at `url`, whatever is in it, in a way by which nothing there can change.

    Its schema is not looked at, nor brought up to date. Text in SQLite need not be UTF-8: odd bytes come as surrogates.

    Raises NotAStore where there is no file, StorageError (no driver).
    """
    where = shown(url)
    if url.get_backend_name() != "sqlite":
        options = url.query.get("options", "")
        given = options if isinstance(options, str) else " ".join(options)
        only = f"{given} -c default_transaction_read_only=on".strip()
        return _server_engine(url.update_query_dict({"options": only}), where)
    path = Path(where)
    try:
        _require_file(path, where)
        log = Path(f"{where}-wal")
        for beside in (log, Path(f"{where}-shm"), Path(f"{where}-journal")):
            if beside.exists() and not beside.is_file():
                raise StorageError(f"{beside} is no file, but SQLite keeps one there.")
        # Who may write puts what a crash left in the log into the file, and removes the log; who may not needs one.
        mode = "ro" if log.exists() and log.stat().st_size else "rw"
    except OSError as error:
        raise disk_error(f"Cannot open a store at {where}", error) from error
    engine = _sqlite_engine(_file_url(path, mode))

    @event.listens_for(engine, "connect")
    def _connect(connection: Any, _: Any) -> None:
        connection.execute("PRAGMA query_only = ON")
        connection.text_factory = lambda data: data.decode(errors="surrogateescape")

    return engine


def _require_file(path: Path, where: str) -> None:
    """Raise NotAStore unless a file is there, before anything waits for a pipe that nobody fills."""
    if not path.exists():
        raise NotAStore(f"No league store at {where}: `league run` makes one.")
    if path.is_dir():
        raise NotAStore(f"{where} is a folder, not a database file: give the folder itself or a file in it.")
    if not stat.S_ISREG(path.stat().st_mode):
        raise NotAStore(f"{where} is no file, and so no database.")


def _file_url(path: Path, mode: str) -> sa.URL:
    return sa.URL.create("sqlite", database=path.as_uri(), query={"mode": mode, "uri": "true"})


def _look_at_file(url: sa.URL, create: bool) -> int:
    """The schema of the SQLite store at `url`, 0 if there is none yet and one may be made. Writes no database."""
    where = shown(url)
    path = Path(where)
    try:
        if create and not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            return 0
        _require_file(path, where)
    except OSError as error:
        raise disk_error(f"Cannot {'make' if create else 'open'} a store at {where}", error) from error
    engine = _sqlite_engine(_file_url(path, "ro"))
    try:
        with plain_errors(where):
            return _schema(engine, where)
    finally:
        engine.dispose()


def _schema(engine: sa.Engine, where: str) -> int:
    """The schema of a store, 0 for an empty database; raises NotAStore, OldStore or NewerStore for anything else."""
    found = None
    try:
        with engine.connect() as connection:
            names = sa.inspect(connection).get_table_names()
            if t.changes.name in names:
                found = connection.scalar(sa.select(sa.func.max(t.changes.c.schema)))
    except DBAPIError as error:
        if "not a database" in str(error.orig):
            raise NotAStore(f"{where} is not a league store, nor any SQLite database; it was left untouched.") from None
        raise
    if names and t.changes.name not in names:
        raise NotAStore(f"{where} is a database of something else (it has {names[0]!r}); it was left untouched.")
    if found is None:
        return 0
    if found < t.FIRST_SCHEMA:
        raise OldStore(where, found, t.FIRST_SCHEMA)
    if found > t.newest_schema():
        raise NewerStore(where, found, t.newest_schema())
    return found


def _keep_copy(path: Path) -> None:
    """Copy a SQLite store of an older schema to a file beside it, by whose name it tells which; all of it, or nothing.

    Others may be bringing the store up to date meanwhile: what is copied of today's schema is thrown away.
    """
    partial = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    try:
        with closing(sqlite3.connect(path, timeout=BUSY_SECONDS)) as db:
            db.execute("VACUUM INTO ?", (str(partial),))
        with closing(sqlite3.connect(partial)) as copy:
            (schema,) = copy.execute(f"SELECT max(schema) FROM {t.changes.name}").fetchone()
        if schema < t.newest_schema():
            os.replace(partial, copied(path, schema))
    except (sqlite3.Error, OSError) as error:
        raise StorageError(
            f"{path} could not be copied before it is brought up to date, and stays: {error}."
        ) from error
    finally:
        partial.unlink(missing_ok=True)


def _migrate(engine: sa.Engine) -> None:
    """Bring the schema up to date, each change in one transaction with its own record. Safe to race."""
    while True:
        with engine.execution_options(writes=True).begin() as connection:
            if connection.dialect.name == "postgresql":
                connection.execute(sa.text("SELECT pg_advisory_xact_lock(hashtext('robot_league'))"))
            has_record = sa.inspect(connection).has_table(t.changes.name)
            schema = connection.scalar(sa.select(sa.func.max(t.changes.c.schema))) if has_record else None
            if schema is None:
                t.metadata.create_all(connection)
                schema, change = t.newest_schema(), "created"
            elif schema < t.newest_schema():
                migration = t.MIGRATIONS[schema - t.FIRST_SCHEMA]
                migration(connection)
                schema, change = schema + 1, migration.__name__
            else:
                return
            connection.execute(sa.insert(t.changes).values(schema=schema, change=change))


# A server that vanishes without a word (a pulled cable, a stopped machine) is noticed within about a minute, and lets
# go of what this process held within about as long; what a user gives in the URL wins.
_SERVER: dict[str, str] = {
    "connect_timeout": "10",
    "keepalives_idle": "20",
    "keepalives_interval": "10",
    "keepalives_count": "3",
    "tcp_user_timeout": "60000",  # ms
}
_SESSION = f"-c lock_timeout={BUSY_SECONDS}s -c idle_in_transaction_session_timeout={BUSY_SECONDS}s"


def _to_json(value: object) -> str:
    try:
        return json.dumps(value, allow_nan=False)  # SQLite would keep a NaN as text that nobody else reads
    except (TypeError, ValueError) as error:
        raise StorageError(f"What a row shall hold is no JSON: {error}.") from error


def _server_engine(url: sa.URL, where: str) -> sa.Engine:
    given = url.query.get("options", "")
    options = given if isinstance(given, str) else " ".join(given)
    url = url.set(query={**_SERVER, **url.query, "options": f"{_SESSION} {options}".strip()})
    try:
        # Pre-ping: a connection that a restart of the server has cut is replaced before it is used.
        engine = sa.create_engine(url, pool_pre_ping=True, json_serializer=_to_json)
    except (ModuleNotFoundError, NoSuchModuleError) as error:
        raise StorageError(f"{where} needs a driver: pip install 'robot-league[postgres]' ({error}).") from error
    waiting.SERVERS.over(engine)
    return engine


def _write_ahead(connection: Any) -> None:
    """Let readers and a writer work side by side, which the file remembers.

    The switch needs the file alone, and for that SQLite does not wait by itself: others may be making the same store.
    """
    until = time.monotonic() + BUSY_SECONDS
    while True:
        try:
            connection.execute("PRAGMA journal_mode = WAL")
            return
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY or time.monotonic() > until:
                raise
            time.sleep(0.02)


def _begin_to_write(connection: sa.Connection) -> None:
    """Take SQLite's write lock, and say so while another process keeps it: one that was stopped keeps it in silence.

    The driver is spoken to itself, since each word through SQLAlchemy costs more than SQLite takes for all of them.
    """
    driver, start, patience = _driver(connection), time.monotonic(), waiting.SAY_SECONDS
    try:
        while (left := BUSY_SECONDS - (time.monotonic() - start)) > 0:
            driver.execute(f"PRAGMA busy_timeout = {int(1000 * min(patience, left))}")
            try:
                driver.execute("BEGIN IMMEDIATE")
                return
            except sqlite3.Error as error:
                waited = time.monotonic() - start
                if getattr(error, "sqlite_errorcode", 0) & 0xFF != sqlite3.SQLITE_BUSY or waited >= BUSY_SECONDS:
                    break
                waiting.say(f"other processes have kept the store locked for {waited:.0f} s")
                patience = waited
        connection.exec_driver_sql("BEGIN IMMEDIATE")  # whose complaint is SQLAlchemy's
    finally:
        driver.execute(f"PRAGMA busy_timeout = {int(1000 * BUSY_SECONDS)}")


def _driver(connection: sa.Connection) -> sqlite3.Connection:
    driver = connection.connection.driver_connection
    assert isinstance(driver, sqlite3.Connection)
    return driver


def is_locked(path: Path, seconds: float) -> bool:
    """Whether another process keeps a SQLite store from being written to for that long. Changes nothing."""
    with closing(sqlite3.connect(path, timeout=seconds, isolation_level=None)) as db:
        try:
            db.execute("BEGIN IMMEDIATE")
        except sqlite3.OperationalError as error:
            return error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY
        return False  # closing lets go of it


def _sqlite_engine(url: sa.URL) -> sa.Engine:
    engine = sa.create_engine(url, connect_args={"timeout": BUSY_SECONDS}, json_serializer=_to_json)

    @event.listens_for(engine, "connect")
    def _connect(connection: Any, _: Any) -> None:
        connection.isolation_level = None  # the driver shall not begin transactions behind our back
        connection.execute("PRAGMA foreign_keys = ON")
        if url.query["mode"] == "rwc":
            _write_ahead(connection)

    @event.listens_for(engine, "begin")
    def _begin(connection: sa.Connection) -> None:
        asked = connection.get_execution_options()
        # A transaction that reads first and writes later can fail half-way when another writer slips in between.
        if asked.get("writes"):
            _driver(connection).execute(f"PRAGMA synchronous = {'FULL' if asked.get('lasting', True) else 'NORMAL'}")
            _begin_to_write(connection)
        else:
            connection.exec_driver_sql("BEGIN")

    return engine
