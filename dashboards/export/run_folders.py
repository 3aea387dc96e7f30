"""Folders of TensorBoard's runs by league: leagues of one name in two stores never share a folder."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dashboards.errors import ViewerError

ENDING = ".robot-league"


def event_file(created: float, identity: str) -> str:
    """Return the name of a league's event files; `created` is its creation time, in seconds since the epoch."""
    return f"events.out.tfevents.{int(created)}.{identity}{ENDING}"


def find_event_file(folder: Path, created: float, identity: str) -> Path:
    """Return a player's event file in its folder: of the current name, or an earlier version's if only that exists."""
    path, earlier = folder / event_file(created, identity), folder / f"events.out.tfevents.{int(created)}{ENDING}"
    return earlier if earlier.exists() and not path.exists() else path


def league_folder(base: Path, league: str, created: float, identity: str) -> Path:
    """Return the folder below `base` of a league's runs.

    It has the league's name; where another league has that folder, also the identity.
    """
    plain, own = base / league, base / f"{league}-{identity}"
    mine = {event_file(created, identity), f"events.out.tfevents.{int(created)}{ENDING}"}
    there = {path.name for path in plain.glob(f"*/events.out.tfevents.*{ENDING}")}
    return own if own.exists() or there - mine else plain


@contextmanager
def locked_folder(base: Path) -> Iterator[None]:
    """Lock the folder `base`, made if needed, while folders below it are chosen and made. Raises ViewerError."""
    try:
        base.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(base, os.O_RDONLY)
    except OSError as error:
        raise ViewerError(f"{base} cannot be written: {error.strerror}; give another folder") from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
