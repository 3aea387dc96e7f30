"""The base of all operations of a store: its database and its blobs."""

from collections.abc import Iterable

from storage.blobs.identity import IdentifiedBlobs
from storage.database.connection import Database
from storage.errors import StorageError


class StoreBase:
    """A store's database and blobs. Each part of `storage.store.Store` adds the operations of one subject."""

    def __init__(self, database: Database, blobs: IdentifiedBlobs):
        self.blobs = blobs
        self.where = database.where  # for messages: it contains no password
        self._db = database

    def _require_blobs(self, digests: Iterable[str]) -> None:
        for digest in digests:
            if not self.blobs.has(digest):
                raise StorageError(f"Blob {digest} is not in {self.where}: put it before the row that names it.")
