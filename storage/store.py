"""The store of leagues: everything that a league knows, and the only channel between its processes.

Every operation is one transaction that takes and returns values of `storage.records`. No operation hands out a
connection or leaves a transaction open. Blobs are put before the rows that name them, so a crash leaves at most a blob
that no row names.

A unit of work is a leased row. One conditional write on (job, holder, attempt) settles its ownership, and the
database's clock decides whether its holder is alive. A worker that was killed, cut off or merely slow can therefore
never write a result twice.

Every operation raises Unavailable when the database or its disk cannot serve now. The same call may then be repeated.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import sqlalchemy as sa

from storage.blobs.blobs import open_blobs
from storage.blobs.identity import IdentifiedBlobs
from storage.database import engines, health
from storage.database import schema as t
from storage.database.connection import Database
from storage.database.opening import open_database
from storage.database.urls import blobs_location, database_url, display_url
from storage.maintenance import row_transfer, thinning
from storage.operations.leadership import Leadership
from storage.operations.players import Players
from storage.operations.queue import JobQueue
from storage.operations.results import Results


class Store(Leadership, Players, Results, JobQueue):
    """Leagues with their players, policies, matches and jobs. Threads may share a Store; each process opens its own."""

    @classmethod
    def open(
        cls,
        where: str | os.PathLike[str],
        create: bool = False,
        blobs: str | os.PathLike[str] | None = None,
        migrate: bool = False,
    ) -> Self:
        """Open the store in a folder, or at `sqlite:///path/to/league.db`, or at a `postgresql://` URL.

        A folder holds `league.db` and `blobs/`. Blobs are kept at `blobs`, otherwise at ROBOT_LEAGUE_BLOBS, otherwise
        beside a SQLite file. With `create`, an absent store is made. Opening a store of the current schema writes
        nothing. A store of an older schema is migrated: a SQLite file always, after a backup copy; a server only with
        `migrate`.

        Raises NotAStore, OldStore, OutdatedStore, NewerStore, Unavailable (no server now) or StorageError (no
        permission, no location for blobs, an unsupported kind of URL).
        """
        url = database_url(where)
        kept = open_blobs(blobs_location(blobs, url), make=False)
        database = Database(open_database(url, create, migrate), display_url(url))
        return cls(database, IdentifiedBlobs(kept, database))

    def close(self) -> None:
        """Close the connections. The store can still be used and then opens new connections."""
        self._db.engine.dispose()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def now(self) -> float:
        """Return the time on the database's clock, in seconds since the epoch."""
        return self._db.rows(sa.select(t.now()))[0][0]

    def made(self) -> float:
        """Return when the store was created, in seconds since the epoch on its database's clock."""
        return self._db.rows(sa.select(sa.func.min(t.changes.c.made)).where(t.changes.c.schema > 0))[0][0]

    def locked(self, seconds: float = 1.0) -> bool:
        """Return whether a process blocks all writers for at least `seconds`; always False for a server."""
        engine = self._db.engine
        return engine.dialect.name == "sqlite" and engines.is_locked(Path(self.where), seconds)

    def troubles(self) -> list[str]:
        """Return lines about transactions held open on a server and about its clock; none for SQLite."""
        return health.server_troubles(self._db)

    # Transfer between stores

    def dump(
        self,
        leagues: Sequence[str],
        write_table: Callable[[str, Iterator[dict[str, Any]]], None],
        newest: bool = False,
        recordings: bool = True,
    ) -> None:
        """Pass the transferable rows of leagues to `write_table`, table by table, as one consistent state.

        With `newest`, only the checkpoints that players resume from are included. Without `recordings`, no match names
        a recording.
        """
        with self._db.repeatable_read() as db:
            for name, table in row_transfer.TABLES.items():
                write_table(
                    name, self._db.checked(row_transfer.dump_rows(db, table, leagues, newest, recordings), name)
                )

    def restore(self, tables: Iterable[tuple[str, Iterable[Mapping[str, Any]]]]) -> None:
        """Add all rows that `dump` gave, or none. Their blobs must be present.

        Raises StorageError when a league of the same name exists already.
        """
        with self._db.writing() as db:
            for name, rows_of_it in tables:
                row_transfer.load_rows(db, row_transfer.TABLES[name], rows_of_it)

    # Thinning

    def find_removable(self, policy: thinning.RetentionPolicy) -> thinning.Removable:
        """Find what the policy allows to remove; change nothing. Raises StorageError where rows are damaged."""
        return thinning.find_removable(self._db, self.blobs, policy)

    def thin(
        self, removable: thinning.Removable, progress: thinning.ProgressCallback = lambda *_: None
    ) -> thinning.Removed:
        """Remove what was found, except what has been put or named since. Rows are removed before blobs. Return the
        counts.
        """
        return thinning.remove(self._db, self.blobs, removable, progress)
