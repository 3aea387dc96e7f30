"""Content-addressed blobs: bytes named by their SHA-256, in a folder (`folder.py`) or in a bucket (`s3.py`).

A blob appears whole or not at all and never changes, so any number of processes may put and get without locks. A killed
writer leaves at most a file whose name starts with a dot, which is never read.
"""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, Protocol
from urllib.parse import unquote, urlsplit

from storage.database.urls import looks_like_url, redacted
from storage.errors import StorageError

DIGEST = re.compile(r"[0-9a-f]{64}")
_MARK = re.compile(r"store-[0-9a-f]{16}")


class BlobEntry(NamedTuple):
    """A file among the blobs."""

    name: str  # a blob's digest, or the path of a killed writer's leftover
    bytes: int
    put: float  # time of the last put, s since the epoch on the disk's clock
    whole: bool = True  # a blob, not a leftover


class Blobs(Protocol):
    """Storage of blobs. A blob's name is the SHA-256 of its bytes in hexadecimal."""

    def put(self, data: bytes) -> str:
        """Store the bytes durably and return their digest. Putting the same bytes again renews their modification time.

        Raises Unavailable when the disk is full or cannot be reached now.
        """
        ...

    def get(self, digest: str) -> bytes:
        """Return the bytes of that digest. Raises DamagedBlob when they are missing or do not hash to it, Unavailable
        as `put`.
        """
        ...

    def has(self, digest: str) -> bool:
        """Return whether a blob of that name exists; its bytes are not checked."""
        ...

    def entries(self) -> Iterator[BlobEntry]:
        """Yield all blobs and all leftovers of killed writers, in no order. Raises Unavailable where there is no
        folder.
        """
        ...

    def remove(self, entry: BlobEntry, before: float) -> bool:
        """Delete an entry that was last put before that time, on the disk's clock; False where it is gone or newer.

        A process that puts the same bytes in the meantime finds them present afterwards. Raises StorageError, and
        Unavailable as `put`.
        """
        ...


class BlobStore(Blobs, Protocol):
    """Blobs with the identities of the stores that they belong to: see `storage.blobs.identity`."""

    @property
    def location(self) -> str:
        """The location of the blobs, for messages, without a password."""
        ...

    def add_identity(self, store: str) -> None:
        """Add the identity of a store, and make an absent folder. Raises StorageError, and Unavailable as `put`."""
        ...

    def remove_identity(self, store: str) -> None:
        """Remove the identity of a store."""
        ...

    def has_identity(self, store: str) -> bool:
        """Return whether the location carries a store's identity. Raises Unavailable where this cannot be checked."""
        ...

    def identities(self) -> list[str]:
        """Return the identities of all stores, sorted; empty where the location does not exist."""
        ...


def is_identity(name: str) -> bool:
    """Return whether a file's name is that of a store's identity."""
    return _MARK.fullmatch(name) is not None


def open_blobs(url: str | os.PathLike[str], make: bool = True) -> BlobStore:
    """Open the blobs at a folder path, `file:///` or `s3://bucket/prefix`.

    A folder is made when an identity is added and, with `make`, by the first put. A bucket is never made.
    """
    from storage.blobs.folder import FolderBlobs

    text = os.fspath(url)
    if not looks_like_url(text):
        return FolderBlobs(Path(text), make)
    try:
        parts = urlsplit(text)
    except ValueError:  # e.g. brackets without an IPv6 address
        parts = urlsplit("")
    if parts.scheme == "file" and parts.netloc in ("", "localhost") and parts.path.startswith("/"):
        return FolderBlobs(Path(unquote(parts.path)), make)
    if (
        parts.scheme == "s3"
        and re.fullmatch(r"[a-z0-9][a-z0-9.-]+", parts.netloc)
        and not (parts.query + parts.fragment)
    ):
        from storage.blobs.s3 import BucketBlobs

        return BucketBlobs(parts.netloc, parts.path)
    raise StorageError(
        f"Cannot keep blobs at {redacted(text)!r}: a folder path, file:///path or s3://bucket/prefix is possible."
    )


def require_digest(text: str) -> None:
    """Raise StorageError for a text that is not a blob's name."""
    if not DIGEST.fullmatch(text):
        raise StorageError(f"{text!r} is not a blob's name, which is 64 hexadecimal digits (SHA-256).")
