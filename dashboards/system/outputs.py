"""Output files for pictures, films and rerun: their kinds, and writing so that each appears whole or not at all."""

import os
from contextlib import AbstractContextManager
from pathlib import Path

from dashboards.errors import ViewerError
from storage.blobs.files import replacement_file, require_writable

PICTURES = (".png", ".jpg", ".jpeg", ".webp")
FILMS = (".mp4", ".webm", ".gif", ".webp")
RERUN = (".rrd",)
_CALLED = {PICTURES: "a picture", FILMS: "a film", RERUN: "a match for rerun"}


def require_kind(path: str | Path, kinds: tuple[str, ...]) -> Path:
    """Return the path. Raises ViewerError unless its name ends as one of PICTURES, FILMS or RERUN does."""
    path = Path(path)
    if path.suffix not in kinds:
        known = ", ".join("*" + kind for kind in kinds)
        raise ViewerError(f"{_CALLED[kinds]} is a file named {known}, not {path.name}")
    return path


def require_output(path: str | Path, kinds: tuple[str, ...]) -> None:
    """Raise the error that `new_output` would raise at its beginning."""
    require_writable(require_kind(path, kinds))


def new_output(path: str | Path, kinds: tuple[str, ...]) -> AbstractContextManager[Path]:
    """Return a context with the path of a file to write; the file replaces `path` at the end.

    The file is made at once, so that an unwritable location is reported before anything is drawn. Raises ViewerError
    for another kind of name, StorageError where it cannot be written.
    """
    return replacement_file(require_kind(path, kinds))


def write_durably(path: Path, data: bytes) -> None:
    """Write a file and flush it to the disk, so that a full disk is reported before the file is announced."""
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
