"""The engines of a store's database: connections and transactions on SQLite and on PostgreSQL."""

import json
import os
import sqlite3
import time
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.exc import DisconnectionError, NoSuchModuleError

from storage.database import lock_wait, sessions
from storage.database.connection import BUSY_SECONDS
from storage.database.urls import several_hosts
from storage.errors import StorageError

# A server that vanishes silently (a pulled cable, a stopped machine) is noticed within about a minute, and releases
# this process's locks within about the same time. Settings in the user's URL take precedence.
_SERVER: dict[str, str] = {
    "connect_timeout": "10",
    "keepalives_idle": "20",
    "keepalives_interval": "10",
    "keepalives_count": "3",
    "tcp_user_timeout": "60000",  # ms
    "fallback_application_name": "league",  # in pg_stat_activity
}


def _to_json(value: object) -> str:
    try:
        return json.dumps(value, allow_nan=False)  # SQLite would store a NaN as text that no other program reads
    except (TypeError, ValueError) as error:
        raise StorageError(f"A value of a row is no JSON: {error}.") from error


def server_engine(url: sa.URL, where: str, read_only: bool = False) -> sa.Engine:
    """Return an engine of PostgreSQL, directly or through a pooler. Raises StorageError without a driver."""
    options = url.query.get("options", "")
    given = options if isinstance(options, str) else " ".join(options)
    roles = {"target_session_attrs": "primary"} if several_hosts(url) else {}  # the others are standbys
    url = url.set(query={**_SERVER, **roles, **url.query, "client_encoding": "UTF8"})  # overrides PGCLIENTENCODING
    try:
        # Pre-ping: a connection that was cut by a restart of the server is replaced before use.
        engine = sa.create_engine(url, pool_pre_ping=True, json_serializer=_to_json)
    except (ModuleNotFoundError, NoSuchModuleError) as error:
        raise StorageError(f"{where} needs a driver: pip install 'robot-league[postgres]' ({error}).") from error
    sessions.serve_clients(engine, where, f"{BUSY_SECONDS}s", given, read_only)
    lock_wait.SERVER_WATCH.attach(engine)
    return engine


def _write_ahead(connection: Any) -> None:
    """Switch the file to write-ahead logging, so that readers and a writer work in parallel. The file keeps the mode.

    The switch needs exclusive access, and SQLite does not wait for it: other processes may be making the same store.
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


def _begin_writing(connection: sa.Connection) -> None:
    """Take SQLite's write lock, with a message while another process holds it: a stopped process holds it in silence.

    The driver is called directly, since each call through SQLAlchemy costs more than SQLite needs for all of them.
    """
    driver, start, patience = _driver(connection), time.monotonic(), lock_wait.REPORT_SECONDS
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
                lock_wait.report_wait(f"other processes have kept the store locked for {waited:.0f} s")
                patience = waited
        connection.exec_driver_sql("BEGIN IMMEDIATE")  # raises SQLAlchemy's error
    finally:
        driver.execute(f"PRAGMA busy_timeout = {int(1000 * BUSY_SECONDS)}")


def _file_at(path: str) -> tuple[int, int] | None:
    """Return the file at a path, by device and inode number; None where there is none."""
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_dev, status.st_ino


def _driver(connection: sa.Connection) -> sqlite3.Connection:
    driver = connection.connection.driver_connection
    assert isinstance(driver, sqlite3.Connection)
    return driver


def is_locked(path: Path, seconds: float) -> bool:
    """Return whether another process blocks writing to a SQLite store for that long. Changes nothing."""
    with closing(sqlite3.connect(path, timeout=seconds, isolation_level=None)) as db:
        try:
            db.execute("BEGIN IMMEDIATE")
        except sqlite3.OperationalError as error:
            return error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY
        return False  # closing releases the lock


def sqlite_engine(url: sa.URL) -> sa.Engine:
    """Return an engine of a SQLite file, whose transactions lock it before they write."""
    engine = sa.create_engine(url, connect_args={"timeout": BUSY_SECONDS}, json_serializer=_to_json)
    path = unquote(urlsplit(url.database or "").path)

    @event.listens_for(engine, "checkout")
    def _checkout(_: Any, record: Any, __: Any) -> None:
        # SQLite would continue to write into a file that was deleted or replaced.
        if record.info.setdefault("file", now := _file_at(path)) != now or now is None:
            raise DisconnectionError(f"{path} is another file now, or gone")

    @event.listens_for(engine, "connect")
    def _connect(connection: Any, _: Any) -> None:
        connection.isolation_level = None  # no implicit transactions by the driver
        connection.execute("PRAGMA foreign_keys = ON")
        if url.query["mode"] == "rwc":
            _write_ahead(connection)

    @event.listens_for(engine, "begin")
    def _begin(connection: sa.Connection) -> None:
        asked = connection.get_execution_options()
        # A transaction that reads first and writes later can fail halfway when another writer commits in between.
        if asked.get("writes"):
            _driver(connection).execute(f"PRAGMA synchronous = {'FULL' if asked.get('durable', True) else 'NORMAL'}")
            _begin_writing(connection)
        else:
            connection.exec_driver_sql("BEGIN")

    return engine
