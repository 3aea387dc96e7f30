"""Blobs as files `ab/cdef...` below a folder."""

import errno
import hashlib
import os
import re
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path

from storage.blobs.blobs import DIGEST, BlobEntry, is_identity, require_digest
from storage.errors import DamagedBlob, Unavailable, disk_error

_FOLDER = re.compile(r"[0-9a-f]{2}")
_PARTIAL = re.compile(r"\.[0-9a-f]{8}\.[0-9a-f]{16}")


class FolderBlobs:
    """Blobs as files `ab/cdef...` below a folder."""

    def __init__(self, folder: Path, make: bool = True):
        self.folder = Path(os.path.abspath(folder))
        self._make = make

    @property
    def location(self) -> str:
        """See BlobStore."""
        return str(self.folder)

    def add_identity(self, store: str) -> None:
        """See BlobStore."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            _write_whole(self.folder / store, b"")
        except OSError as error:
            raise disk_error(f"Cannot mark the blobs in {self.folder}", error) from error

    def remove_identity(self, store: str) -> None:
        """See BlobStore."""
        (self.folder / store).unlink(missing_ok=True)

    def has_identity(self, store: str) -> bool:
        """See BlobStore."""
        try:
            return (self.folder / store).is_file()
        except OSError as error:
            raise disk_error(f"Cannot look for the mark {store} in {self.folder}", error) from error

    def identities(self) -> list[str]:
        """See BlobStore."""
        try:
            return sorted(filter(is_identity, os.listdir(self.folder)))
        except (FileNotFoundError, NotADirectoryError):
            return []
        except OSError as error:
            raise disk_error(f"Cannot list {self.folder}", error) from error

    def put(self, data: bytes) -> str:
        """See Blobs. A damaged file of the same name is replaced. Raises StorageError where no file may be written."""
        digest = hashlib.sha256(data).hexdigest()
        path = self._path(digest)
        try:
            if not (path.is_file() and _read(path) == data and _refresh_time(path)):
                if self._make:
                    self.folder.mkdir(parents=True, exist_ok=True)
                _write_whole(path, data)
        except FileNotFoundError as error:
            self._require_folder()
            raise disk_error(f"Cannot write a blob of {len(data)} bytes to {path}", error) from error
        except OSError as error:
            raise disk_error(f"Cannot write a blob of {len(data)} bytes to {path}", error) from error
        return digest

    def get(self, digest: str) -> bytes:
        """See Blobs."""
        path = self._path(digest)
        try:
            if not path.exists():
                self._put_back(digest)
            data = _read(path)
        except FileNotFoundError:
            self._require_folder()
            raise DamagedBlob(digest, str(path), "missing") from None
        except OSError as error:
            if isinstance(away := disk_error(f"Cannot read blob {digest} at {path}", error), Unavailable):
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
                self._put_back(digest)
            return stat.S_ISREG(path.stat().st_mode)
        except (FileNotFoundError, NotADirectoryError):
            return False
        except OSError as error:
            raise disk_error(f"Cannot look for blob {digest} at {path}", error) from error

    def entries(self) -> Iterator[BlobEntry]:
        """See Blobs. Non-regular files and names that no blob has are skipped."""
        try:
            self._require_folder()
            for folder in sorted(path for path in self.folder.iterdir() if _FOLDER.fullmatch(path.name)):
                yield from _files(folder)
        except OSError as error:
            raise disk_error(f"Cannot list the blobs in {self.folder}", error) from error

    def remove(self, entry: BlobEntry, before: float) -> bool:
        """See Blobs."""
        path = self._path(entry.name) if entry.whole else Path(entry.name)
        # Moved aside, its time no longer changes: a later put of these bytes writes them again.
        aside = path.with_name(f".{path.name[:8]}.{secrets.token_hex(8)}") if entry.whole else path
        try:
            if entry.whole:
                os.rename(path, aside)
            elif aside.stat().st_mtime < before and self._put_back(_hash(aside)):
                return False  # it was a whole blob, and a row may name it
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

    def _put_back(self, digest: str) -> bool:
        """Restore a whole blob that a killed `remove` has moved aside; return whether there was one.

        A `remove` that is still running then finds nothing to delete.
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
            raise Unavailable(
                f"The folder of blobs is not there (another location, a disk not mounted?): {self.folder}"
            )

    def _path(self, digest: str) -> Path:
        require_digest(digest)
        return self.folder / digest[:2] / digest[2:]


def _files(folder: Path) -> Iterator[BlobEntry]:
    """Yield the blobs and the leftovers of killed writers in one of the folders."""
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        digest = folder.name + path.name
        partial = _PARTIAL.fullmatch(path.name) is not None
        if not (partial or DIGEST.fullmatch(digest)):
            continue
        try:
            status = path.stat()
        except FileNotFoundError:  # renamed or removed meanwhile
            continue
        if stat.S_ISREG(status.st_mode):
            yield BlobEntry(str(path) if partial else digest, status.st_size, status.st_mtime, not partial)


def _read(path: Path) -> bytes:
    """Return a file's bytes. Raises OSError for a non-regular file instead of blocking on a pipe without a writer."""
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


def _refresh_time(path: Path) -> bool:
    """Renew a blob's modification time, so that it is not removed before a row names it; False where it is gone."""
    try:
        os.utime(path)
    except FileNotFoundError:
        return False
    except PermissionError:  # only the file's owner may set its times
        return True
    return True


def _write_whole(path: Path, data: bytes) -> None:
    """Write beside, flush to the disk, then rename: `path` never holds anything but all of `data`.

    Of the folders above it only the nearest is made.
    """
    path.parent.mkdir(exist_ok=True)
    partial = path.with_name(f".{path.name[:8]}.{secrets.token_hex(8)}")
    try:
        with open(partial, "xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        try:
            os.replace(partial, path)
        except FileNotFoundError:  # a reader has taken it for a blob moved aside, and restored it
            if not path.exists():
                raise
    finally:
        partial.unlink(missing_ok=True)
    # The names must survive a power failure too: a database row that points here is written next.
    for folder in (path.parent, path.parent.parent):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
