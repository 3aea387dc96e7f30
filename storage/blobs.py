"""Content-addressed blobs: bytes named by their SHA-256, in a folder (object stores can follow behind `open_blobs`).

A blob appears whole or not at all and never changes, so any number of processes may put and get without locks. A
killed writer leaves at most a file whose name starts with a dot, which nothing reads.
"""

import hashlib
import os
import re
import secrets
from pathlib import Path
from typing import Protocol
from urllib.parse import unquote, urlsplit

from storage.errors import DamagedBlob, StorageError

_DIGEST = re.compile(r"[0-9a-f]{64}")


class Blobs(Protocol):
    """Three verbs; a blob's name is the SHA-256 of its bytes in hexadecimal."""

    def put(self, data: bytes) -> str:
        """Keep the bytes durably and return their digest. Putting the same bytes again changes nothing."""
        ...

    def get(self, digest: str) -> bytes:
        """The bytes of that digest; raises DamagedBlob when they are missing or do not hash to it."""
        ...

    def has(self, digest: str) -> bool:
        """Whether a blob of that name is here (its bytes are not checked)."""
        ...


def open_blobs(url: str | os.PathLike[str]) -> Blobs:
    """Blobs at a folder path or `file:///` URL; the folder is made by the first put."""
    text = os.fspath(url)
    if "://" not in text:
        return FolderBlobs(Path(text))
    parts = urlsplit(text)
    if parts.scheme == "file" and parts.netloc in ("", "localhost"):
        return FolderBlobs(Path(unquote(parts.path)))
    raise StorageError(f"Cannot keep blobs at {text!r}: a folder path or file:///path is possible.")


class FolderBlobs:
    """Blobs as files `ab/cdef...` below a folder."""

    def __init__(self, folder: Path):
        self.folder = Path(os.path.abspath(folder))

    def put(self, data: bytes) -> str:
        """See Blobs. A damaged file of the same name is replaced; raises StorageError when the disk refuses."""
        digest = hashlib.sha256(data).hexdigest()
        path = self._path(digest)
        try:
            if not (path.is_file() and path.read_bytes() == data):
                _write_whole(path, data)
        except OSError as error:
            raise StorageError(f"Cannot write a blob of {len(data)} bytes to {path}: {error.strerror}.") from error
        return digest

    def get(self, digest: str) -> bytes:
        """See Blobs."""
        path = self._path(digest)
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            raise DamagedBlob(digest, str(path), "missing") from None
        except OSError as error:
            raise DamagedBlob(digest, str(path), f"unreadable ({error.strerror})") from error
        if hashlib.sha256(data).hexdigest() != digest:
            raise DamagedBlob(digest, str(path), "damaged, its bytes do not hash to its name")
        return data

    def has(self, digest: str) -> bool:
        """See Blobs."""
        return os.path.isfile(self._path(digest))

    def _path(self, digest: str) -> Path:
        if not _DIGEST.fullmatch(digest):
            raise StorageError(f"{digest!r} is not a blob's name, which is 64 hexadecimal digits (SHA-256).")
        return self.folder / digest[:2] / digest[2:]


def _write_whole(path: Path, data: bytes) -> None:
    """Write beside, flush to the disk, then rename: at no moment does `path` hold anything but all of `data`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name[:8]}.{secrets.token_hex(8)}")
    try:
        with open(partial, "xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    # The names must outlive a power cut too: a database row that points here is written next.
    for folder in (path.parent, path.parent.parent):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
