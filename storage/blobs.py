"""Content-addressed blobs: bytes named by their SHA-256, in a folder (object stores can follow behind `open_blobs`).

A blob appears whole or not at all and never changes, so any number of processes may put and get without locks. A
killed writer leaves at most a file whose name starts with a dot, which nothing reads.
"""

import hashlib
import os
import re
import secrets
import stat
from pathlib import Path
from typing import Protocol
from urllib.parse import unquote, urlsplit

from storage.errors import Away, DamagedBlob, StorageError, disk_error
from storage.places import looks_like_url, shown_text

_DIGEST = re.compile(r"[0-9a-f]{64}")


class Blobs(Protocol):
    """Three verbs; a blob's name is the SHA-256 of its bytes in hexadecimal."""

    def put(self, data: bytes) -> str:
        """Keep the bytes durably and return their digest. Putting the same bytes again changes nothing.

        Raises Away when the disk is full or cannot be reached now.
        """
        ...

    def get(self, digest: str) -> bytes:
        """The bytes of that digest; raises DamagedBlob when they are missing or do not hash to it, Away as `put`."""
        ...

    def has(self, digest: str) -> bool:
        """Whether a blob of that name is here (its bytes are not checked)."""
        ...


def open_blobs(url: str | os.PathLike[str]) -> Blobs:
    """Blobs at a folder path or `file:///` URL; the folder is made by the first put."""
    text = os.fspath(url)
    if not looks_like_url(text):
        return FolderBlobs(Path(text))
    parts = urlsplit(text)
    if parts.scheme == "file" and parts.netloc in ("", "localhost") and parts.path.startswith("/"):
        return FolderBlobs(Path(unquote(parts.path)))
    raise StorageError(f"Cannot keep blobs at {shown_text(text)!r}: a folder path or file:///path is possible.")


class FolderBlobs:
    """Blobs as files `ab/cdef...` below a folder."""

    def __init__(self, folder: Path):
        self.folder = Path(os.path.abspath(folder))

    def put(self, data: bytes) -> str:
        """See Blobs. A damaged file of the same name is replaced; raises StorageError where no file may be written."""
        digest = hashlib.sha256(data).hexdigest()
        path = self._path(digest)
        try:
            if not (path.is_file() and path.read_bytes() == data):
                _write_whole(path, data)
        except OSError as error:
            raise disk_error(f"Cannot write a blob of {len(data)} bytes to {path}", error) from error
        return digest

    def get(self, digest: str) -> bytes:
        """See Blobs."""
        path = self._path(digest)
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            if not self.folder.exists():
                raise Away(
                    f"The folder of blobs is not there (another place, a disk not mounted?): {self.folder}"
                ) from None
            raise DamagedBlob(digest, str(path), "missing") from None
        except OSError as error:
            if isinstance(away := disk_error(f"Cannot read blob {digest} at {path}", error), Away):
                raise away from error
            raise DamagedBlob(digest, str(path), f"unreadable ({error.strerror})") from error
        if hashlib.sha256(data).hexdigest() != digest:
            raise DamagedBlob(digest, str(path), "damaged, its bytes do not hash to its name")
        return data

    def has(self, digest: str) -> bool:
        """See Blobs."""
        path = self._path(digest)
        try:
            return stat.S_ISREG(path.stat().st_mode)
        except (FileNotFoundError, NotADirectoryError):
            return False
        except OSError as error:
            raise disk_error(f"Cannot look for blob {digest} at {path}", error) from error

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
