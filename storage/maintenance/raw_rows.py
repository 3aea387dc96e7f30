"""The rows of a store, read and checked as untrusted data, whatever the database's condition.

Values are read untyped, as the database stores them. Data that cannot be read is a finding, and the rest is still read.
"""

import json
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

import sqlalchemy as sa

from storage.database import schema as t
from storage.database.connection import Database, translated_errors
from storage.database.rows import strings_in
from storage.errors import NewerStore, NoPermission, NotAStore, OldStore, StorageError, Unavailable
from storage.maintenance import row_transfer
from storage.maintenance.findings import (
    BlobReference,
    JobReferences,
    Kind,
    ProgressCallback,
    VerificationReport,
    single_line,
)
from storage.maintenance.row_checks import check_row
from storage.records import Job

MAX_SQLITE_MESSAGES = 100  # SQLite's messages about its file that are reported at most


class RawRows:
    """The rows of a store, checked as untrusted data."""

    def __init__(
        self,
        database: Database,
        report: VerificationReport,
        progress: ProgressCallback,
        has_blobs: bool,
        job_references: JobReferences,
    ):
        self._database, self._report, self._progress, self._has_blobs = database, report, progress, has_blobs
        self._job_references = job_references
        self._check = row_transfer.RowChecker((), ())
        self._named: dict[str, BlobReference] = {}
        self.dropped: set[object] = set()  # blobs that rows once named
        self._counted: dict[str, object] = {}  # league -> number of matches that its row states
        self._there = Counter[object]()  # league -> number of its match rows

    def read(self) -> Mapping[str, BlobReference]:
        """Read all tables; return the rows that name blobs, by digest. Raises StorageError where there is no store."""
        with self._database.repeatable_read() as db:
            columns = self._tables(db)
            if columns is None:
                return self._named
            if db.dialect.name == "sqlite":
                self._attempt(db, "database", lambda: self._check_file(db))
            for table in (*row_transfer.TABLES.values(), t.workers):
                if (there := columns.get(table.name)) is None:
                    self._report_unread("missing", f"table {table.name}", "the database has no such table")
                else:
                    self._attempt(
                        db, f"table {table.name}", lambda table=table, there=there: self._read(db, table, there)
                    )
            if t.dropped.name in columns:
                self._attempt(db, f"table {t.dropped.name}", lambda: self._read_dropped(db))
            else:
                self._report_unread("missing", f"table {t.dropped.name}", "the database has no such table")
        for league, counted in self._counted.items():
            if self._report.references_known and counted != self._there[league]:
                problem = f"it counts {counted} matches, and the rows of {self._there[league]} are there"
                self._report.add("corrupt", f"leagues {league}", problem)
        return self._named

    def _read_dropped(self, db: sa.Connection) -> None:
        digest = sa.type_coerce(t.dropped.c.digest, sa.types.NullType())
        self.dropped.update(db.scalars(sa.select(digest)))

    def _report_unread(self, kind: Kind, place: str, problem: object) -> None:
        """Add a finding because of which some rows were not read."""
        self._report.add(kind, place, problem)
        self._report.references_known = False

    def _attempt(self, db: sa.Connection, place: str, read: Callable[[], None]) -> None:
        """Call `read`, or report why it failed."""
        try:
            with translated_errors(self._report.where):
                read()
        except StorageError as error:
            _raise_unless_of_the_store(error, db)
            self._report_unread("corrupt", place, f"cannot be read: {_cause(error, self._report.where)}")
            db.rollback()

    def _tables(self, db: sa.Connection) -> dict[str, set[str]] | None:
        """Return the columns of each table; None if nothing of the database can be read."""
        try:
            with translated_errors(self._report.where):
                columns = _columns(db)
                schema = _schema(db) if t.changes.name in columns else None
        except StorageError as error:
            _raise_unless_of_the_store(error, db)
            cause = _cause(error, self._report.where)
            if "not a database" in cause and not self._has_blobs:
                raise NotAStore(f"{self._report.where} is not a league store, nor any SQLite database.") from None
            self._report_unread("corrupt", "database", f"cannot be read: {cause}")
            return None
        known = columns.keys() & t.metadata.tables.keys()
        if len(known) < 3:  # any database may have one or two such names
            if columns and not self._has_blobs:
                other = min(columns)
                raise NotAStore(f"{self._report.where} is a database of something else (it has {other!r}).")
            if not self._has_blobs:
                raise NotAStore(f"No league store at {self._report.where}: `league run` makes one.")
            self._report_unread("missing", "database", "it is empty, but blobs are there")
            return None
        self._check_schema(columns, schema)
        return columns

    def _check_schema(self, columns: Mapping[str, set[str]], schema: object) -> None:
        if t.changes.name not in columns:
            self._report.add("missing", f"table {t.changes.name}", "the database has no such table")
        elif not isinstance(schema, int) or schema < 1:
            self._report.add("corrupt", f"table {t.changes.name}", f"{schema!r} is no number of a schema")
        elif schema > t.newest_schema():
            raise NewerStore(self._report.where, schema, t.newest_schema())
        elif schema < t.FIRST_SCHEMA:
            raise OldStore(self._report.where, schema, t.FIRST_SCHEMA)
        elif schema < t.newest_schema():
            raise StorageError(
                f"{self._report.where} has schema {schema}, and today's is {t.newest_schema()}: `league migrate` brings"
                " it up to date; verification changes nothing."
            )

    def _check_file(self, db: sa.Connection) -> None:
        """Run SQLite's own check of its file: pages, cells, indexes."""
        ticks = 0

        def tick() -> None:
            nonlocal ticks
            ticks += 1
            self._progress("SQLite's integrity check, million steps", ticks, None)

        raw: Any = db.connection.dbapi_connection
        raw.set_progress_handler(tick, 1_000_000)
        try:
            for (line,) in db.exec_driver_sql(f"PRAGMA integrity_check({MAX_SQLITE_MESSAGES})"):
                if line != "ok":
                    self._report_unread("corrupt", "database", line)
        finally:
            raw.set_progress_handler(None, 0)

    def _read(self, db: sa.Connection, table: sa.Table, there: set[str]) -> None:
        """Check the rows of a table that has these columns."""
        chosen = [column for column in table.columns if column.name in there]
        for column in table.columns:
            if column.name not in there:
                self._report.add("missing", f"table {table.name}", f"it has no column {column.name!r}")
                self._report.references_known &= column.name != row_transfer.BLOB_COLUMNS.get(table.name)
        whole = len(chosen) == len(table.columns)
        # Untyped, so that the values come unconverted.
        query = sa.select(*(sa.type_coerce(column, sa.types.NullType()).label(column.name) for column in chosen))
        if whole and table.name in row_transfer.ORDER:
            query = query.order_by(*row_transfer.ORDER[table.name])
        found = db.execute(query, execution_options={"yield_per": row_transfer.BATCH}).mappings()
        for done, row in enumerate(found, start=1):
            self._progress(table.name, done, None)
            self._report.rows += 1
            self._check_row(table, dict(row), whole, db.dialect.name)

    def _check_row(self, table: sa.Table, row: dict[str, Any], whole: bool, dialect: str) -> None:
        place = _place(table.name, row)
        self._note_blob(table.name, row, place)
        if table is t.leagues:
            self._check.leagues.add(row.get("name", ""))
            if isinstance(row.get("name"), str) and "matches" in row:
                self._counted[row["name"]] = row["matches"]
        if table in row_transfer.MATCHES:
            self._there[row.get("league")] += 1
        try:
            if not whole:
                raise ValueError
            self._require_valid(table, {c.name: _value(c, row[c.name], dialect) for c in table.columns})
        except (ValueError, TypeError, LookupError, RecursionError, OverflowError) as error:
            if whole:
                self._report.add("corrupt", place, error)
            self._check.accept_damaged(table.name, row)

    def _require_valid(self, table: sa.Table, row: dict[str, Any]) -> None:
        """Raise ValueError, with the reason, for a row that cannot be one of a store."""
        leased = table is t.jobs and row["state"] == "leased"
        if leased and (row["holder"] is None or row["lease_until"] is None):
            raise ValueError("it is leased without a holder or without an end")
        row |= {"state": "queued"} if leased else {}  # as in a transfer
        for column in table.columns:
            try:
                row_transfer.check_value(column, row[column.name], table.name)
            except ValueError as error:
                raise ValueError(f"{column.name} {error}") from None
        check_row(table.name, row)
        if table is not t.leagues and row["league"] not in self._check.leagues:
            raise ValueError(f"league {row['league']!r} is not there")
        if table is t.jobs and row["state"] in ("queued", "failed"):
            self._require_references(row)
        if table is not t.workers:
            self._check.examine(table.name, {c.name: row[c.name] for c in row_transfer.columns(table)})

    def _require_references(self, row: Mapping[str, Any]) -> None:
        """Raise ValueError if an unfinished job refers to a missing row."""
        job = Job(**{f.name: row[f.name] for f in fields(Job) if f.name in row})
        try:
            pointed = list(self._job_references(job))
        except StorageError as error:
            raise ValueError(str(error)) from None
        for name, key in pointed:
            if not self._check.has(name, job.league, key):
                raise ValueError(f"it needs {key!r}, which is none of the {name} of league {job.league!r}")

    def _note_blob(self, table: str, row: Mapping[str, Any], place: str) -> None:
        """Note the blob that a row names. An invalid name is reported as the row's fault."""
        column = row_transfer.BLOB_COLUMNS.get(table)
        if column is None or (column == "recording" and row.get(column) is None):
            return
        if row.get("thinned") is not None:
            return
        digest = row.get(column)
        if not (isinstance(digest, str) and row_transfer.is_digest(digest)):
            self._report.references_known = False  # the blob's name is lost
            return
        self._check.blobs.add(digest)
        sides = frozenset(str(row.get(side)) for side in ("a", "b") if row.get(side) is not None)
        sides |= frozenset(strings_in(_listed(row.get("snapshots"))))
        self._named.setdefault(
            digest, BlobReference(table, place, sides, row.get("script"), row.get("purpose") == "training")
        )


def _raise_unless_of_the_store(error: StorageError, db: sa.Connection) -> None:
    """Raise an error that is no fault of the store: a lost server, or a store that this user may not use."""
    if isinstance(error, NoPermission) or (isinstance(error, Unavailable) and db.dialect.name != "sqlite"):
        raise error


def _columns(db: sa.Connection) -> dict[str, set[str]]:
    """Return the names of a database's columns by table, reading no more of its schema."""
    if db.dialect.name != "sqlite":
        inspector = sa.inspect(db)
        return {name: {c["name"] for c in inspector.get_columns(name)} for name in inspector.get_table_names()}
    names = [name for (name,) in db.exec_driver_sql("SELECT name FROM sqlite_master WHERE type = 'table'")]
    return {name: {row[1] for row in db.exec_driver_sql(f"PRAGMA table_info({_quoted(name)})")} for name in names}


def _schema(db: sa.Connection) -> object:
    return db.execute(sa.text(f"SELECT max(schema) FROM {t.changes.name} WHERE schema <> {t.IDENTITY}")).scalar()


def _quoted(name: object) -> str:
    return '"' + str(name).replace('"', '""') + '"'


def _value(column: sa.Column[Any], value: Any, dialect: str) -> Any:
    """Return a value as SQLAlchemy would give it. Raises ValueError for invalid JSON."""
    if dialect != "sqlite" or value is None:
        return value
    if isinstance(column.type, sa.JSON) and isinstance(value, str):
        try:
            return json.loads(value, parse_constant=_no_constant)
        except ValueError as error:
            raise ValueError(f"{column.name} is no JSON: {error}") from None
    if isinstance(column.type, sa.Boolean) and value in (0, 1):
        return bool(value)
    return value


def _listed(value: object) -> object:
    """Return a JSON list as any database gives it untyped; an empty list for a damaged one."""
    try:
        return json.loads(value) if isinstance(value, str) else value
    except (ValueError, RecursionError):
        return []


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no figure")


def _place(table: str, row: Mapping[str, Any]) -> str:
    """Return the description of a row: its table and its key."""
    of_player = {"checkpoints": ("league", "player", "iteration"), "meetings": ("league", "player", "id")}
    names = row_transfer.KEYS.get(table) or of_player.get(table) or ("league", "id")
    return f"{table} {'/'.join(single_line(row.get(name, '?')) for name in names)}"


def _cause(error: StorageError, where: str) -> str:
    """Return an error's message without the location, which the report names, and without the advice to wait."""
    return str(error).removeprefix(f"{where}: ").removesuffix("; wait and try again.").rstrip(".")
