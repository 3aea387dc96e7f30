"""The store: what a league knows, and the only channel between its processes.

Every verb is one transaction that takes and returns values of `storage.records`; none hands out a connection or leaves
a transaction open. Blobs are put first and rows written last, so a crash leaves at most a blob that nobody names.

A unit of work is a leased row. Ownership is settled by one conditional write on (job, holder, attempt) and liveness by
the database's clock, so a worker that was killed, cut off or merely slow can never write a result twice.

Every verb raises Away when the database or its disk cannot serve now; it may then be called again as it was.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import sqlalchemy as sa

from storage import moving, opening, thinning
from storage import tables as t
from storage.blobs import open_blobs
from storage.database import Database
from storage.leading import Leading
from storage.log import Log
from storage.opening import open_database
from storage.places import blobs_place, database_url, shown
from storage.players import Players
from storage.queue import Queue


class Store(Leading, Players, Log, Queue):
    """Leagues with their players, policies, matches and jobs. Threads may share one; each process opens its own."""

    @classmethod
    def open(
        cls,
        where: str | os.PathLike[str],
        create: bool = False,
        blobs: str | os.PathLike[str] | None = None,
        migrate: bool = False,
    ) -> Self:
        """Open the store in a folder, or at `sqlite:///path/to/league.db`, or at a `postgresql://` URL.

        A folder holds `league.db` and `blobs/`. Blobs are kept at `blobs`, else where ROBOT_LEAGUE_BLOBS says, else
        beside a SQLite file. With `create`, a store is made where nothing is. Opening a store of today's schema writes
        nothing. One of an older schema is brought up to date: a SQLite file after a copy of it, a server's where
        `migrate` asks for it.

        Raises NotAStore, OldStore, OutdatedStore, NewerStore, Away (no server now) or StorageError (no permission, no
        place for blobs, no such kind of URL).
        """
        url = database_url(where)
        kept = open_blobs(blobs_place(blobs, url))
        return cls(Database(open_database(url, create, migrate), shown(url)), kept)

    def close(self) -> None:
        """Close the connections; the store can still be used and then opens new ones."""
        self._db.engine.dispose()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def now(self) -> float:
        """Seconds since the epoch on the database's clock."""
        return self._db.rows(sa.select(t.now()))[0][0]

    def locked(self, seconds: float = 1.0) -> bool:
        """Whether some process keeps all others from writing, for so long at least; a server's locks are of its own."""
        engine = self._db.engine
        return engine.dialect.name == "sqlite" and opening.is_locked(Path(self.where), seconds)

    # Moving

    def dump(
        self,
        leagues: Sequence[str],
        take: Callable[[str, Iterator[dict[str, Any]]], None],
        newest: bool = False,
        recordings: bool = True,
    ) -> None:
        """Hand the rows of leagues, as they travel, to `take`, table after table, as they all are at one moment.

        `newest`: of the checkpoints only those that players go on from; without `recordings` no match names one.
        """
        with self._db.unchanging() as db:
            for name, table in moving.TABLES.items():
                take(name, self._db.sound(moving.dumped(db, table, leagues, newest, recordings), name))

    def restore(self, tables: Iterable[tuple[str, Iterable[Mapping[str, Any]]]]) -> None:
        """Add rows that `dump` gave, whose blobs are there: all of them, or none.

        Raises StorageError when a league of that name is there already.
        """
        with self._db.writing() as db:
            for name, rows_of_it in tables:
                moving.load(db, moving.TABLES[name], rows_of_it)

    # Thinning

    def waste(self, policy: thinning.Policy) -> thinning.Waste:
        """What can go by that policy; changes nothing. Raises StorageError where rows are damaged."""
        return thinning.find(self._db, self.blobs, policy)

    def thin(self, waste: thinning.Waste, tell: thinning.Tell = lambda *_: None) -> thinning.Done:
        """Remove what was found, less what has been put or named since; how much that was. Rows go before blobs."""
        return thinning.remove(self._db, self.blobs, waste, tell)
