"""What all verbs of a store stand on: its database and its blobs."""

from collections.abc import Iterable

from storage.blobs import Blobs
from storage.database import Database
from storage.errors import StorageError


class Verbs:
    """A store's database and blobs; each part of `storage.store.Store` adds the verbs of one subject."""

    def __init__(self, database: Database, blobs: Blobs):
        self.blobs = blobs
        self.where = database.where  # for messages: no password is in it
        self._db = database

    def _require_blobs(self, digests: Iterable[str]) -> None:
        for digest in digests:
            if not self.blobs.has(digest):
                raise StorageError(f"Blob {digest} is not in {self.where}: put it before the row that names it.")
