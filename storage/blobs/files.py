"""Files that appear whole or not at all, and opening of untrusted paths without blocking on them."""

import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from storage.errors import StorageError, disk_error

MAX_NAME_BYTES = 255
"""Maximum bytes of a file's name on all common file systems."""


@contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """Yield a new file to write, under a temporary name beside `path`; flush it to the disk and rename it at the end.

    If an exception is raised, nothing is left. Raises StorageError where `path` exists or cannot be written,
    Unavailable where the disk is full.
    """
    require_file_name(path)
    partial = path.with_name(f".{secrets.token_hex(8)}")
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
def replacement_file(path: Path) -> Iterator[Path]:
    """Yield the name of an empty file beside `path`, with its suffix, that replaces `path` at the end.

    If an exception is raised, `path` is unchanged. Raises StorageError where it cannot be written or is not a regular
    file, Unavailable where the disk is full.
    """
    require_file_name(path)
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
    """Raise the error that `replacement_file` would raise at its beginning."""
    require_file_name(path)
    try:
        _beside(path).unlink()
    except OSError as error:
        raise disk_error(f"Cannot write {path}", error) from error


def require_file_name(path: Path) -> None:
    """Raise StorageError unless a new file can have this path: not empty, not `.`, not too long."""
    text = str(path) if len(str(path)) <= 80 else f"{str(path)[:60]}...{str(path)[-10:]}"
    if path.name in ("", "..") or "\0" in str(path):
        raise StorageError(f"{text!r} is no name of a file: give one, such as x{path.suffix or '.out'}.")
    if (size := len(os.fsencode(path.name))) > MAX_NAME_BYTES:
        raise StorageError(f"{text!r} has a name of {size} bytes: files' names have at most {MAX_NAME_BYTES}.")


def _beside(path: Path) -> Path:
    """Create a new empty file beside a path that may be written or replaced."""
    if path.is_dir():
        raise StorageError(f"{path} is a folder: give the name of a file in it.")
    if path.exists() and not path.is_file():
        raise StorageError(f"{path} is no file.")
    partial = path.with_name(f".{secrets.token_hex(8)}{path.suffix}")
    partial.touch(exist_ok=False)
    return partial


def open_file(path: Path) -> BinaryIO:
    """Open a file to read. Raises StorageError for a non-regular file (a folder, a pipe) or one that cannot be read."""
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
