"""Rollback of a new store that could not be filled: a refused command leaves nothing behind."""

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from storage.blobs.blobs import open_blobs
from storage.blobs.folder import FolderBlobs
from storage.database.urls import blobs_location, database_url, display_url


@contextmanager
def rollback_new_store(where: str, blobs: str | None) -> Iterator[None]:
    """Remove the files and folders of a store that did not exist before the block, if the block raises an exception.

    A database in which another process has made a league in the meantime stays, with its blobs. Nothing on a server is
    removed.
    """
    url = database_url(where)
    if url.get_backend_name() != "sqlite":
        yield
        return
    file, kept = Path(display_url(url)), open_blobs(blobs_location(blobs, url))
    folder = kept.folder if isinstance(kept, FolderBlobs) else None
    places = [file, *([folder] if folder else [])]
    new = {path for place in places for path in (place, *place.parents) if not path.exists()}
    try:
        yield
    except BaseException:
        with suppress(OSError):
            if file in new and not _has_leagues(file):
                for path in (file, Path(f"{file}-wal"), Path(f"{file}-shm")):
                    path.unlink(missing_ok=True)
                if folder in new and folder is not None:
                    shutil.rmtree(folder, ignore_errors=True)
                for path in sorted(new - {file}, key=lambda path: len(path.parts), reverse=True):
                    with suppress(OSError):
                        path.rmdir()  # fails if another process has put something there
        raise


def _has_leagues(file: Path) -> bool:
    """Return whether a database holds a league; True if it cannot be read."""
    if not file.exists():
        return False
    try:
        with closing(sqlite3.connect(f"{file.as_uri()}?mode=ro", uri=True)) as db:
            return db.execute("SELECT count(*) FROM leagues").fetchone()[0] > 0
    except sqlite3.Error as error:
        return "no such table" not in str(error)
