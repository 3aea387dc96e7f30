"""The tables of a store, their migrations, the database's clock, and how a database is opened.

Written once for SQLite (one host, a file) and PostgreSQL (many hosts, a server).
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.exc import DBAPIError, NoSuchModuleError
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.functions import FunctionElement

from storage.errors import NewerStore, NotAStore, StorageError
from storage.records import ArenaKey, Match, PairCounts

BUSY_SECONDS = 60  # how long a SQLite writer waits for its turn before giving up


class now(FunctionElement[float]):  # noqa: N801  (reads as SQL)
    """Seconds since the epoch on the database's clock, the only clock that all workers share."""

    type = sa.Double()
    inherit_cache = True


@compiles(now, "sqlite")
def _now_sqlite(*_: Any, **__: Any) -> str:
    return "((julianday('now') - 2440587.5) * 86400.0)"


@compiles(now, "postgresql")
def _now_postgresql(*_: Any, **__: Any) -> str:
    return "CAST(extract(epoch from clock_timestamp()) AS double precision)"


metadata = sa.MetaData()


def _league(**options: Any) -> sa.Column[str]:
    return sa.Column("league", sa.ForeignKey("leagues.name"), nullable=False, **options)


def _count(name: str) -> sa.Column[int]:
    return sa.Column(name, sa.BigInteger, nullable=False)


def _time(name: str) -> sa.Column[float]:
    return sa.Column(name, sa.Double, nullable=False, default=now())


def _text(name: str, **options: Any) -> sa.Column[str]:
    return sa.Column(name, sa.String, nullable=options.pop("nullable", False), **options)


# One row per schema change made to this database. The name is also the mark by which a store is known.
changes = sa.Table(
    "robot_league", metadata, sa.Column("schema", sa.Integer, primary_key=True), _text("change"), _time("made")
)

leagues = sa.Table(
    "leagues",
    metadata,
    _text("name", primary_key=True),
    *map(_text, ("arena", "config_hash", "engine", "config")),
    _time("created"),
    sa.Column("stop_asked", sa.Double),
)
runs = sa.Table(
    "runs",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    _league(),
    *map(_text, ("config", "host")),
    sa.Column("versions", sa.JSON, nullable=False),
    _time("started"),
)
players = sa.Table(
    "players",
    metadata,
    _league(primary_key=True),
    _text("name", primary_key=True),
    sa.Column("team", sa.Integer, nullable=False),
    *map(_text, ("role", "roster")),
)
checkpoints = sa.Table(
    "checkpoints",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    *map(_text, ("league", "player", "digest")),
    *map(_count, ("step", "iteration")),
    sa.Column("seconds", sa.Double, nullable=False),
    _time("created"),
    sa.ForeignKeyConstraint(["league", "player"], ["players.league", "players.name"]),
    sa.Index("checkpoints_of_player", "league", "player"),
)
snapshots = sa.Table(
    "snapshots",
    metadata,
    _league(primary_key=True),
    _text("digest", primary_key=True),
    *map(_text, ("name", "roster")),
    _text("player", nullable=True),
    _text("script", nullable=True),
    *map(_count, ("step", "iteration")),
    sa.Column("seconds", sa.Double, nullable=False),
    _time("created"),
    sa.UniqueConstraint("league", "name"),
    sa.ForeignKeyConstraint(["league", "player"], ["players.league", "players.name"]),
)
matches = sa.Table(
    "matches",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    *map(_text, ("league", "arena", "config_hash", "engine", "a", "b")),
    *map(_count, ("wins", "draws", "losses", "voids", "side_wins", "side_draws", "side_losses")),
    *map(_count, ("ll", "ld", "dd_wl", "dw", "ww")),
    *map(_count, ("seed", "steps")),
    _text("purpose"),
    _text("recording", nullable=True),
    _time("created"),
    sa.ForeignKeyConstraint(["league", "a"], ["snapshots.league", "snapshots.digest"]),
    sa.ForeignKeyConstraint(["league", "b"], ["snapshots.league", "snapshots.digest"]),
    sa.Index("matches_of_league", "league", "purpose"),
)
jobs = sa.Table(
    "jobs",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    _league(),
    *map(_text, ("kind", "key")),
    sa.Column("payload", sa.JSON, nullable=False),
    sa.Column("priority", sa.Integer, nullable=False),
    _text("state", default="queued"),
    sa.Column("attempt", sa.Integer, nullable=False, default=0),  # only grows, so no two leases are equal
    sa.Column("expiries", sa.Integer, nullable=False, default=0),  # claims that ended because nobody renewed them
    _text("holder", nullable=True),
    sa.Column("lease_until", sa.Double),
    _text("error", nullable=True),
    _time("created"),
    sa.UniqueConstraint("league", "key"),
    sa.Index("jobs_to_claim", "league", "state", "priority"),
)
workers = sa.Table(
    "workers",
    metadata,
    _text("id", primary_key=True),
    _league(),
    _text("kinds"),
    sa.Column("pid", sa.Integer, nullable=False),
    _text("host"),
    sa.Column("status", sa.JSON, nullable=False),
    _time("started"),
    _time("seen"),
)

# MIGRATIONS[i] takes a database from schema i + 1 to i + 2. A new store is made from the tables above, so whoever adds
# a migration changes the tables to match.
MIGRATIONS: list[Callable[[sa.Connection], None]] = []


def newest_schema() -> int:
    """The schema that the tables above describe."""
    return 1 + len(MIGRATIONS)


def insert_or(connection: sa.Connection, table: sa.Table) -> Any:
    """An INSERT that has `on_conflict_do_nothing` and `on_conflict_do_update`, in the connection's dialect."""
    if connection.dialect.name == "postgresql":
        from sqlalchemy.dialects.postgresql import insert as dialect_insert
    else:
        from sqlalchemy.dialects.sqlite import insert as dialect_insert
    return dialect_insert(table)


# A match, flat, in the order of Match's fields.
MATCH_COLUMNS = [
    matches.c[name]
    for name in (
        *("league", *ArenaKey._fields, "a", "b", "wins", "draws", "losses", "voids"),
        *("side_wins", "side_draws", "side_losses", *PairCounts._fields),
        *("seed", "steps", "purpose", "recording", "id", "created"),
    )
]


def match_row(match: Match) -> dict[str, Any]:
    """A match as the row to insert."""
    flat = without(match, "arena", "pairs", "id", "created")
    return {**flat, **match.arena._asdict(), **match.pairs._asdict()}


def match_from(row: Sequence[Any]) -> Match:
    """The match in a row of MATCH_COLUMNS."""
    values: tuple[Any, ...] = (row[0], ArenaKey._make(row[1:4]), *row[4:13], PairCounts._make(row[13:18]), *row[18:])
    return Match(*values)


def columns(record: type, table: sa.Table) -> list[sa.Column[Any]]:
    """The columns that a record is made of, in the order of its fields."""
    return [table.c[f.name] for f in fields(record)]


def without(record: Any, *names: str) -> dict[str, Any]:
    """A record's fields less those that the database gives."""
    return {name: value for name, value in vars(record).items() if name not in names}


def add(db: sa.Connection, table: sa.Table, rows: Iterable[Mapping[str, Any]], unique: list[str]) -> int:
    """Insert the rows that are not there by their `unique` columns; how many those were."""
    if not (given := [dict(row) for row in rows]):
        return 0
    statement = insert_or(db, table).on_conflict_do_nothing(index_elements=unique)
    return len(db.execute(statement.returning(table.c.league), given).all())


def place(url: sa.URL) -> str:
    """Where a database is, in a user's words: a file's path or a server's URL without its password."""
    if url.get_backend_name() == "sqlite":
        return str(Path(url.database or "").absolute())
    return url.render_as_string(hide_password=True)


def open_database(url: sa.URL, create: bool) -> sa.Engine:
    """Connect to the store at `url`, making it if `create` and nothing is there, and bring its schema up to date.

    Nothing is written to a store of today's schema, nor ever to a database that is something else. Transactions of
    `engine.execution_options(writes=True)` take SQLite's write lock at once, the others read.

    Raises NotAStore, NewerStore, or StorageError (no permission, no server, no driver).
    """
    where = place(url)
    if url.drivername == "postgresql":
        url = url.set(drivername="postgresql+psycopg")
    if url.get_backend_name() == "sqlite":
        found = _look_at_file(url, create)
        engine = _sqlite_engine(_file_url(Path(where), "rwc" if found == 0 else "rw"))
    elif url.get_backend_name() == "postgresql":
        engine, found = _server_engine(url, where), None
    else:
        raise StorageError(f"Cannot keep a store at {where}: a folder, sqlite:/// or postgresql:// is possible.")
    try:
        with plain_errors(where):
            if found is None:
                found = _schema(engine, where)
            if found == 0 and not create:
                raise NotAStore(f"No league store at {where}: `league run` makes one.")
            if found > newest_schema():
                raise NewerStore(where, found, newest_schema())
            if found < newest_schema():
                _migrate(engine)
    except BaseException:
        engine.dispose()
        raise
    return engine


@contextmanager
def plain_errors(where: str) -> Iterator[None]:
    """Tell a database's complaints as one line of StorageError."""
    try:
        yield
    except DBAPIError as error:
        cause = str(error.orig).strip().partition("\n")[0]
        told = next((plain for pattern, plain in _PLAIN if re.search(pattern, cause)), f"{cause}.")
        raise StorageError(f"{where}: {told}") from error


_PLAIN = (
    ("database or disk is full|No space left", "the disk is full; nothing was half written. Free some space, go on."),
    (
        "readonly database|unable to open|permission denied",
        "no permission to write there (SQLite needs it even to read).",
    ),
    ("(?i)foreign key", "a row names a league, player or snapshot that is not there; nothing was written."),
    ("database is locked", f"another process kept it locked for {BUSY_SECONDS} s; end that one or try again."),
)


def _file_url(path: Path, mode: str) -> sa.URL:
    return sa.URL.create("sqlite", database=path.as_uri(), query={"mode": mode, "uri": "true"})


def _look_at_file(url: sa.URL, create: bool) -> int:
    """The schema of the SQLite store at `url`, 0 if there is none yet and one may be made. Writes no database."""
    if not url.database or url.database == ":memory:" or url.database.startswith("file:"):
        raise StorageError("A store is shared by processes: give a file, as in sqlite:///runs/league.db.")
    where = place(url)
    path = Path(where)
    try:
        if not path.exists():
            if not create:
                raise NotAStore(f"No league store at {where}: `league run` makes one.")
            path.parent.mkdir(parents=True, exist_ok=True)
            return 0
        if path.is_dir():
            raise NotAStore(f"{where} is a folder, not a database file: give the folder itself or a file in it.")
    except OSError as error:
        raise StorageError(f"Cannot {'make' if create else 'open'} a store at {where}: {error.strerror}.") from error
    engine = _sqlite_engine(_file_url(path, "ro"))
    try:
        with plain_errors(where):
            return _schema(engine, where)
    finally:
        engine.dispose()


def _schema(engine: sa.Engine, where: str) -> int:
    """The schema of a store, 0 for an empty database; raises NotAStore for anything else."""
    try:
        with engine.connect() as connection:
            names = sa.inspect(connection).get_table_names()
            if changes.name in names:
                return connection.scalar(sa.select(sa.func.max(changes.c.schema))) or 0
    except DBAPIError as error:
        if "not a database" in str(error.orig):
            raise NotAStore(f"{where} is not a league store, nor any SQLite database; it was left untouched.") from None
        raise
    if names:
        raise NotAStore(f"{where} is a database of something else (it has {names[0]!r}); it was left untouched.")
    return 0


def _migrate(engine: sa.Engine) -> None:
    """Bring the schema up to date, each change in one transaction with its own record. Safe to race."""
    while True:
        with engine.execution_options(writes=True).begin() as connection:
            if connection.dialect.name == "postgresql":
                connection.execute(sa.text("SELECT pg_advisory_xact_lock(hashtext('robot_league'))"))
            has_record = sa.inspect(connection).has_table(changes.name)
            schema = connection.scalar(sa.select(sa.func.max(changes.c.schema))) if has_record else None
            if schema is None:
                metadata.create_all(connection)
                schema, change = newest_schema(), "created"
            elif schema < newest_schema():
                migration = MIGRATIONS[schema - 1]
                migration(connection)
                schema, change = schema + 1, migration.__name__
            else:
                return
            connection.execute(sa.insert(changes).values(schema=schema, change=change))


def _server_engine(url: sa.URL, where: str) -> sa.Engine:
    try:
        return sa.create_engine(url, pool_pre_ping=True)
    except (ModuleNotFoundError, NoSuchModuleError) as error:
        raise StorageError(f"{where} needs a driver: pip install 'robot-league[postgres]' ({error}).") from error


def _sqlite_engine(url: sa.URL) -> sa.Engine:
    engine = sa.create_engine(url, connect_args={"timeout": BUSY_SECONDS})

    @event.listens_for(engine, "connect")
    def _connect(connection: Any, _: Any) -> None:
        connection.isolation_level = None  # the driver shall not begin transactions behind our back
        connection.execute("PRAGMA foreign_keys = ON")
        if url.query["mode"] == "rwc":
            connection.execute("PRAGMA journal_mode = WAL")  # remembered by the file; readers and a writer side by side

    @event.listens_for(engine, "begin")
    def _begin(connection: sa.Connection) -> None:
        # A transaction that reads first and writes later can fail half-way when another writer slips in between.
        connection.exec_driver_sql("BEGIN IMMEDIATE" if connection.get_execution_options().get("writes") else "BEGIN")

    return engine
