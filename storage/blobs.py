"""Content-addressed blobs: bytes named by their SHA-256, in a folder, or in a bucket (`storage.buckets`).

A blob appears whole or not at all and never changes, so any number of processes may put and get without locks. A
killed writer leaves at most a file whose name starts with a dot, which nothing reads.
"""

import errno
import hashlib
import os
import re
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, Protocol
from urllib.parse import unquote, urlsplit

from storage.errors import Away, DamagedBlob, StorageError, disk_error
from storage.places import looks_like_url, shown_text

_DIGEST = re.compile(r"[0-9a-f]{64}")
_FOLDER = re.compile(r"[0-9a-f]{2}")
_PARTIAL = re.compile(r"\.[0-9a-f]{8}\.[0-9a-f]{16}")


class Entry(NamedTuple):
    """A file among blobs."""

    name: str  # a blob's digest, or the path of what a writer left that was killed
    bytes: int
    put: float  # when it was put last, s since the epoch on the disk's clock
    whole: bool = True  # a blob, and not what was left


class Blobs(Protocol):
    """A blob's name is the SHA-256 of its bytes in hexadecimal."""

    def put(self, data: bytes) -> str:
        """Keep the bytes durably and return their digest. Put again, the same bytes are new once more, as files go.

        Raises Away when the disk is full or cannot be reached now.
        """
        ...

    def get(self, digest: str) -> bytes:
        """The bytes of that digest; raises DamagedBlob when they are missing or do not hash to it, Away as `put`."""
        ...

    def has(self, digest: str) -> bool:
        """Whether a blob of that name is here (its bytes are not checked)."""
        ...

    def entries(self) -> Iterator[Entry]:
        """All blobs, and what killed writers left, in no order. Raises Away where there is no folder, as `get`."""
        ...

    def remove(self, entry: Entry, before: float) -> bool:
        """Delete what was put last before that time, on the disk's clock; False where it is gone or was put again.

        Whoever puts the same bytes meanwhile has them there afterwards. Raises StorageError, Away as `put`.
        """
        ...


def open_blobs(url: str | os.PathLike[str]) -> Blobs:
    """Blobs at a folder path, `file:///` or `s3://bucket/prefix`; a folder is made by the first put, no bucket is."""
    text = os.fspath(url)
    if not looks_like_url(text):
        return FolderBlobs(Path(text))
    try:
        parts = urlsplit(text)
    except ValueError:  # such as brackets that are no IPv6 address
        parts = urlsplit("")
    if parts.scheme == "file" and parts.netloc in ("", "localhost") and parts.path.startswith("/"):
        return FolderBlobs(Path(unquote(parts.path)))
    if (
        parts.scheme == "s3"
        and re.fullmatch(r"[a-z0-9][a-z0-9.-]+", parts.netloc)
        and not (parts.query + parts.fragment)
    ):
        from storage.buckets import BucketBlobs

        return BucketBlobs(parts.netloc, parts.path)
    raise StorageError(
        f"Cannot keep blobs at {shown_text(text)!r}: a folder path, file:///path or s3://bucket/prefix is possible."
    )


class FolderBlobs:
    """Blobs as files `ab/cdef...` below a folder."""

    def __init__(self, folder: Path):
        self.folder = Path(os.path.abspath(folder))

    def put(self, data: bytes) -> str:
        """See Blobs. A damaged file of the same name is replaced; raises StorageError where no file may be written."""
        digest = hashlib.sha256(data).hexdigest()
        path = self._path(digest)
        try:
            if not (path.is_file() and _read(path) == data and _touch(path)):
                _write_whole(path, data)
        except OSError as error:
            raise disk_error(f"Cannot write a blob of {len(data)} bytes to {path}", error) from error
        return digest

    def get(self, digest: str) -> bytes:
        """See Blobs."""
        path = self._path(digest)
        try:
            if not path.exists():
                self._restore(digest)
            data = _read(path)
        except FileNotFoundError:
            self._require_folder()
            raise DamagedBlob(digest, str(path), "missing") from None
        except OSError as error:
            if isinstance(away := disk_error(f"Cannot read blob {digest} at {path}", error), Away):
                raise away from error
            raise DamagedBlob(digest, str(path), f"unreadable ({error.strerror})") from error
        if hashlib.sha256(data).hexdigest() != digest:
            raise DamagedBlob(digest, str(path), "damaged, its bytes do not hash to its name", data)
        return data

    def has(self, digest: str) -> bool:
        """See Blobs."""
        path = self._path(digest)
        try:
            if not path.exists():
                self._restore(digest)
            return stat.S_ISREG(path.stat().st_mode)
        except (FileNotFoundError, NotADirectoryError):
            return False
        except OSError as error:
            raise disk_error(f"Cannot look for blob {digest} at {path}", error) from error

    def entries(self) -> Iterator[Entry]:
        """See Blobs. What is no file, or has a name that no blob has, is passed over."""
        try:
            self._require_folder()
            for folder in sorted(path for path in self.folder.iterdir() if _FOLDER.fullmatch(path.name)):
                yield from _files(folder)
        except OSError as error:
            raise disk_error(f"Cannot list the blobs in {self.folder}", error) from error

    def remove(self, entry: Entry, before: float) -> bool:
        """See Blobs."""
        path = self._path(entry.name) if entry.whole else Path(entry.name)
        # Moved aside, its time no longer changes: who puts these bytes from here on writes them anew.
        aside = path.with_name(f".{path.name[:8]}.{secrets.token_hex(8)}") if entry.whole else path
        try:
            if entry.whole:
                os.rename(path, aside)
            elif aside.stat().st_mtime < before and self._restore(_hash(aside)):
                return False  # it was a whole blob, and may be named
            if aside.stat().st_mtime < before:
                aside.unlink()
                return True
            if entry.whole:
                os.replace(aside, path)
        except FileNotFoundError:
            pass
        except OSError as error:
            raise disk_error(f"Cannot remove {path}", error) from error
        return False

    def _restore(self, digest: str) -> bool:
        """Put back a whole blob that lies aside, for `remove` was killed meanwhile; whether there was one.

        A `remove` that is still at it finds nothing to delete then.
        """
        path = self._path(digest)
        try:
            beside = [each for each in path.parent.iterdir() if each.name.startswith(f".{path.name[:8]}.")]
            for aside in filter(lambda each: _PARTIAL.fullmatch(each.name), beside):
                if not path.exists() and _hash(aside) == digest:
                    os.replace(aside, path)
                    return True
        except (FileNotFoundError, NotADirectoryError):  # gone meanwhile, or no folder
            pass
        return False

    def _require_folder(self) -> None:
        if not self.folder.exists():
            raise Away(f"The folder of blobs is not there (another place, a disk not mounted?): {self.folder}")

    def _path(self, digest: str) -> Path:
        require_digest(digest)
        return self.folder / digest[:2] / digest[2:]


def require_digest(text: str) -> None:
    """Raise StorageError for what cannot be a blob's name."""
    if not _DIGEST.fullmatch(text):
        raise StorageError(f"{text!r} is not a blob's name, which is 64 hexadecimal digits (SHA-256).")


def _files(folder: Path) -> Iterator[Entry]:
    """The blobs in one of the folders, and what killed writers left there."""
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        digest = folder.name + path.name
        partial = _PARTIAL.fullmatch(path.name) is not None
        if not (partial or _DIGEST.fullmatch(digest)):
            continue
        try:
            about = path.stat()
        except FileNotFoundError:  # renamed or removed meanwhile
            continue
        if stat.S_ISREG(about.st_mode):
            yield Entry(str(path) if partial else digest, about.st_size, about.st_mtime, not partial)


def _read(path: Path) -> bytes:
    """A file's bytes; raises OSError for what is none, instead of waiting for a pipe that nobody fills."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "it is no file")
        with os.fdopen(descriptor, "rb", closefd=False) as file:
            return file.read()
    finally:
        os.close(descriptor)


def _hash(path: Path) -> str:
    return hashlib.sha256(_read(path)).hexdigest()


def _touch(path: Path) -> bool:
    """Say that a blob is wanted now, lest it is removed before a row names it; False where it is gone."""
    try:
        os.utime(path)
    except FileNotFoundError:
        return False
    except PermissionError:  # another user's, who alone may do that
        return True
    return True


def _write_whole(path: Path, data: bytes) -> None:
    """Write beside, flush to the disk, then rename: at no moment does `path` hold anything but all of `data`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name[:8]}.{secrets.token_hex(8)}")
    try:
        with open(partial, "xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        try:
            os.replace(partial, path)
        except FileNotFoundError:  # a reader took it for one that was left aside, and put it in its place
            if not path.exists():
                raise
    finally:
        partial.unlink(missing_ok=True)
    # The names must outlive a power cut too: a database row that points here is written next.
    for folder in (path.parent, path.parent.parent):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
