"""Files that appear whole or not at all, and files of strangers opened without being held up by them."""

import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from storage.errors import StorageError, disk_error


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write, made under a temporary name beside `path`, flushed to the disk and renamed at the end.

    Where something is raised, nothing is left. Raises StorageError where `path` exists or cannot be written, Away where
    the disk is full.
    """
    partial = path.with_name(f".{path.name[:80]}.{secrets.token_hex(8)}")
    try:
        if path.is_dir():
            raise StorageError(f"{path} is a folder: give the name of a file in it.")
        if path.exists() or path.is_symlink():
            raise StorageError(f"{path} exists already: move it away, or give another name.")
        try:
            with open(partial, "xb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)
        folder = os.open(path.absolute().parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        raise disk_error(f"Cannot write {path}", error) from error


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """The name of an empty file beside `path`, with its ending, that is renamed to it at the end, whatever was there.

    Where something is raised, `path` is as it was. Raises StorageError where it cannot be written or is no file, Away
    where the disk is full.
    """
    try:
        partial = _beside(path)
        try:
            yield partial
            partial.replace(path)
        finally:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
    except OSError as error:
        raise disk_error(f"Cannot write {path}", error) from error


def require_writable(path: Path) -> None:
    """Raise what `replaced` would raise at its beginning."""
    try:
        _beside(path).unlink()
    except OSError as error:
        raise disk_error(f"Cannot write {path}", error) from error


def _beside(path: Path) -> Path:
    """A new empty file beside where one may be written, or replaced."""
    if path.is_dir():
        raise StorageError(f"{path} is a folder: give the name of a file in it.")
    if path.exists() and not path.is_file():
        raise StorageError(f"{path} is no file.")
    partial = path.with_name(f".{secrets.token_hex(8)}.{path.name[-80:]}")
    partial.touch(exist_ok=False)
    return partial


def opened(path: Path) -> BinaryIO:
    """A file to read; raises StorageError for what is none (a folder, a pipe that nobody fills) or cannot be read."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise StorageError(f"{path} is no file.")
    except (OSError, ValueError) as error:
        if not isinstance(error, OSError):
            raise StorageError(f"{str(path)!r} is no name of a file.") from error
        raise disk_error(f"Cannot read {path}", error) from error
    return os.fdopen(descriptor, "rb")
