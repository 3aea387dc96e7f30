"""The identity file that a store leaves among its blobs, which reveals an unmounted disk or a wrong location.

A store's database holds a random identity, and the location of its blobs holds an empty file of that name. Without the
file the location is not the store's: the folder below a mount point looks like any other, and blobs written there are
lost when the disk is back. Several stores may keep their blobs in one location; each has an identity file of its own.
"""

import secrets
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress

import sqlalchemy as sa

from storage.blobs.blobs import BlobEntry, BlobStore
from storage.database import rows
from storage.database import schema as t
from storage.database.connection import Database
from storage.errors import DamagedBlob, StorageError, Unavailable, WrongBlobStore

SAMPLE = 3
"""Number of a store's oldest and of its newest blobs that identify a location without an identity file."""


class IdentifiedBlobs:
    """The blobs of one store, in a location that carries the store's identity.

    The first `put` adds the identity, also for a store made by an earlier version. Every operation raises Unavailable
    where the identity file is missing, and WrongBlobStore where the location carries only the identities of other
    stores.
    """

    def __init__(self, kept: BlobStore, database: Database):
        self.kept = kept
        self._db = database
        self._known: str | None = None

    def put(self, data: bytes) -> str:
        """See Blobs."""
        self._require(self._identity() or self._add_identity())
        digest = self.kept.put(data)
        self._require(self._identity())  # an unmounted disk would leave the bytes below its mount point
        return digest

    def get(self, digest: str) -> bytes:
        """See Blobs."""
        try:
            return self.kept.get(digest)
        except DamagedBlob as error:
            if error.fault == "missing":
                self._require(self._identity())
            raise

    def has(self, digest: str) -> bool:
        """See Blobs."""
        if self.kept.has(digest):
            return True
        self._require(self._identity())
        return False

    def entries(self) -> Iterator[BlobEntry]:
        """See Blobs."""
        self._require(self._identity())
        yield from self.kept.entries()

    def remove(self, entry: BlobEntry, before: float) -> bool:
        """See Blobs."""
        self._require(self._identity())
        return self.kept.remove(entry, before)

    def other_identities(self) -> list[str]:
        """Return the identities of other stores in this location."""
        return [store for store in self.kept.identities() if store != self._identity()]

    def _identity(self) -> str | None:
        """Return the store's identity; None if it has put no blob since identities exist."""
        if self._known is None:
            self._known = store_identity(self._db)
        return self._known

    def _require(self, store: str | None) -> None:
        """Raise Unavailable or WrongBlobStore unless the location carries the store's identity, or surely is the
        store's.
        """
        if store is None or self.kept.has_identity(store):
            return
        named = _sample_of_named_blobs(self._db)
        if all(map(self.kept.has, named)):  # a copy without the identity file, or nothing can be lost yet
            with suppress(StorageError):  # a reader may not write there
                self.kept.add_identity(store)
        elif others := self.kept.identities():
            raise WrongBlobStore(
                f"The blobs in {self.kept.location} are of another store (they carry {others[0]!r}, and"
                f" {self._db.where} needs {store!r}): give the place of its own by --blobs."
            )
        else:
            raise Unavailable(
                f"{self.kept.location} has no mark {store!r} of the store {self._db.where}, and its blobs are not there"
                " (a disk not mounted, a folder moved away? For another location, say where, by --blobs)"
            )

    def _add_identity(self) -> str | None:
        """Add an identity to the location of a store that has none yet; return the store's identity.

        Raises Unavailable where rows name blobs of which none is found: the location is not mounted now.
        """
        named = _sample_of_named_blobs(self._db)
        if named and not any(map(self.kept.has, named)):
            raise Unavailable(
                f"{self.kept.location} has none of the blobs that {self._db.where} names (a disk not mounted?)"
            )
        new = f"store-{secrets.token_hex(8)}"
        self.kept.add_identity(new)
        with self._db.writing() as db:
            row = {"schema": t.IDENTITY, "change": new}
            db.execute(
                rows.insert_statement(db, t.changes).values(row).on_conflict_do_nothing(index_elements=["schema"])
            )
        if (kept := self._identity()) != new:  # another process was first
            self.kept.remove_identity(new)
        return kept


def store_identity(database: Database) -> str | None:
    """Return the identity of a store; None if it has put no blob since identities exist."""
    c = t.changes.c
    found = database.rows(sa.select(c.change).where(c.schema == t.IDENTITY))
    return found[0][0] if found else None


def _sample_of_named_blobs(database: Database) -> Sequence[str]:
    """Return some blobs that rows need: those of the oldest and of the newest snapshots."""
    c = t.snapshots.c
    there = sa.select(c.digest).where(c.thinned.is_(None))
    orders: Iterable = ((c.created, c.name), (c.created.desc(), c.name))
    found = [row[0] for order in orders for row in database.rows(there.order_by(*order).limit(SAMPLE))]
    return list(dict.fromkeys(found))
