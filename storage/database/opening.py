"""Opening of a store's database: locate, create, migrate or refuse it."""

import os
import secrets
import sqlite3
import stat
from contextlib import closing
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.exc import DBAPIError

from storage.database import schema as t
from storage.database.connection import BUSY_SECONDS, translated_errors
from storage.database.engines import server_engine, sqlite_engine
from storage.database.urls import backup_path, display_url
from storage.errors import NewerStore, NotAStore, OldStore, OutdatedStore, StorageError, disk_error


def open_database(url: sa.URL, create: bool, migrate: bool = False) -> sa.Engine:
    """Connect to the store at `url`, creating it if `create` and nothing is there, and migrate its schema.

    A SQLite file of an older schema is first copied to a file such as `league.db.schema-3`. A store on a server is
    migrated only with `migrate`.

    Nothing is written to a store of the current schema, nor ever to a database of something else. Transactions of
    `engine.execution_options(writes=True)` take SQLite's write lock at once; the others read.

    Raises NotAStore, OldStore, OutdatedStore, NewerStore, Unavailable (no server now) or StorageError (no permission,
    no driver, no room for a copy).
    """
    where = display_url(url)
    if url.get_backend_name() == "sqlite":
        found = _schema_of_file_at(url, create)
        engine = sqlite_engine(_file_url(Path(where), "rwc" if found == 0 else "rw"))
    else:
        engine, found = server_engine(url, where), None
    try:
        with translated_errors(where):
            if found is None:
                found = _schema(engine, where)
            if found == 0 and not create:
                raise NotAStore(f"No league store at {where}: `league run` makes one.")
            if found == 0:
                _require_unicode(engine, where)
            if 0 < found < t.newest_schema() and url.get_backend_name() == "sqlite":
                _back_up(Path(where))
            elif 0 < found < t.newest_schema() and not migrate:
                raise OutdatedStore(where, found, t.newest_schema())
            if found < t.newest_schema():
                _migrate(engine)
    except BaseException:
        engine.dispose()
        raise
    if found == 0 and url.get_backend_name() == "sqlite":  # from here on a removed file is not created again
        engine.dispose()
        return sqlite_engine(_file_url(Path(where), "rw"))
    return engine


def open_unchanged(url: sa.URL) -> sa.Engine:
    """Connect to the database at `url`, whatever it contains, without any possibility to change it.

    Its schema is neither checked nor migrated. Text in SQLite need not be UTF-8: undecodable bytes become surrogates.

    Raises NotAStore where there is no file, StorageError (no driver).
    """
    where = display_url(url)
    if url.get_backend_name() != "sqlite":
        return server_engine(url, where, read_only=True)
    path = Path(where)
    try:
        _require_file(path, where)
        log = Path(f"{where}-wal")
        for beside in (log, Path(f"{where}-shm"), Path(f"{where}-journal")):
            if beside.exists() and not beside.is_file():
                raise StorageError(f"{beside} is no file, but SQLite keeps one there.")
        # With write access, SQLite moves the log of a crashed process into the file; read-only access needs the log.
        mode = "ro" if log.exists() and log.stat().st_size else "rw"
    except OSError as error:
        raise disk_error(f"Cannot open a store at {where}", error) from error
    engine = sqlite_engine(_file_url(path, mode))

    @event.listens_for(engine, "connect")
    def _connect(connection: Any, _: Any) -> None:
        connection.execute("PRAGMA query_only = ON")
        connection.text_factory = lambda data: data.decode(errors="surrogateescape")

    return engine


def _require_file(path: Path, where: str) -> None:
    """Raise NotAStore unless a regular file is there; checked first, because reading a pipe could block."""
    if not path.exists():
        raise NotAStore(f"No league store at {where}: `league run` makes one.")
    if path.is_dir():
        raise NotAStore(f"{where} is a folder, not a database file: give the folder itself or a file in it.")
    if not stat.S_ISREG(path.stat().st_mode):
        raise NotAStore(f"{where} is no file, so it is not a database.")


def _file_url(path: Path, mode: str) -> sa.URL:
    return sa.URL.create("sqlite", database=path.as_uri(), query={"mode": mode, "uri": "true"})


def _schema_of_file_at(url: sa.URL, create: bool) -> int:
    """Return the schema of the SQLite store at `url`, 0 if there is none yet and one may be made. No database is
    written.
    """
    where = display_url(url)
    path = Path(where)
    try:
        if create and not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            return 0
        _require_file(path, where)
    except OSError as error:
        raise disk_error(f"Cannot {'make' if create else 'open'} a store at {where}", error) from error
    # A file without a log is open nowhere. It is read as immutable, or SQLite would leave a log beside it.
    unused = not any(Path(f"{where}{end}").exists() for end in ("-wal", "-shm", "-journal"))
    try:
        return _schema_of_file(path, where, unused)
    except StorageError as error:
        if not unused or type(error) is not StorageError:
            raise
        return _schema_of_file(path, where, False)  # another process has opened it in the meantime


def _schema_of_file(path: Path, where: str, unused: bool) -> int:
    url = _file_url(path, "ro")
    engine = sqlite_engine(url.update_query_dict({"immutable": "1"}) if unused else url)
    try:
        with translated_errors(where):
            return _schema(engine, where)
    finally:
        engine.dispose()


_SCHEMA = sa.select(sa.func.max(t.changes.c.schema)).where(t.changes.c.schema != t.IDENTITY)


def _schema(engine: sa.Engine, where: str) -> int:
    """Return the schema of a store, 0 for an empty database. Raises NotAStore, OldStore or NewerStore for anything
    else.
    """
    found = None
    try:
        with engine.connect() as connection:
            names = sa.inspect(connection).get_table_names()
            if t.changes.name in names:
                found = connection.scalar(_SCHEMA)
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


def _back_up(path: Path) -> None:
    """Copy a SQLite store of an older schema to a file beside it, named for its schema; all of it, or nothing.

    Other processes may be migrating the store in the meantime: a copy with the current schema is discarded.
    """
    partial = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    try:
        with closing(sqlite3.connect(path, timeout=BUSY_SECONDS)) as db:
            db.execute("VACUUM INTO ?", (str(partial),))
        with closing(sqlite3.connect(partial)) as copy:
            (schema,) = copy.execute(f"SELECT max(schema) FROM {t.changes.name}").fetchone()
        if schema < t.newest_schema():
            os.replace(partial, backup_path(path, schema))
    except (sqlite3.Error, OSError) as error:
        raise StorageError(
            f"{path} could not be copied before it is brought up to date, and stays: {error}."
        ) from error
    finally:
        partial.unlink(missing_ok=True)


def _require_unicode(engine: sa.Engine, where: str) -> None:
    """Raise StorageError for a server's database that cannot hold every text; nothing has been written there yet."""
    if engine.dialect.name != "postgresql":
        return
    with engine.connect() as connection:
        encoding = connection.scalar(sa.text("SELECT pg_encoding_to_char(encoding) FROM pg_database"
                                             " WHERE datname = current_database()"))  # fmt: skip
    if encoding != "UTF8":
        raise StorageError(
            f"{where} has the encoding {encoding}, and a store needs UTF8; nothing was written. Make a database by"
            " `createdb --template template0 --encoding UTF8 NAME`."
        )


def _migrate(engine: sa.Engine) -> None:
    """Migrate the schema, each change in one transaction with its own record. Safe to run concurrently."""
    while True:
        with engine.execution_options(writes=True).begin() as connection:
            if connection.dialect.name == "postgresql":
                connection.execute(sa.text("SELECT pg_advisory_xact_lock(hashtext('robot_league'))"))
            has_record = sa.inspect(connection).has_table(t.changes.name)
            schema = connection.scalar(_SCHEMA) if has_record else None
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
