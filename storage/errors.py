"""Errors of a store, each with a message of one line that a user can act on.

StorageError
├── Unavailable     the store or its disk cannot be reached, or is full or locked, now: wait and try again
├── NotAStore       nothing is there, or something other than a store
├── NoLeague        the store holds no league yet
├── OldStore        written by an earlier version whose stores this version does not read
├── OutdatedStore   written by an earlier version, and no migration was requested
├── NewerStore      written by a later version of this program
├── WrongBlobStore  the location given for blobs holds the blobs of another store
├── DamagedBlob     a blob is missing, or its bytes do not hash to its name
├── LeaseLost       a result came from a worker that no longer holds the job
│   └── Superseded  a result continues from a checkpoint that is no longer its player's newest
└── UnknownName     no league, player, job, ... has that name
"""

# ruff: noqa: N818  (names that read as sentences: "the lease was lost", "not a store")

import errno
import re
from collections.abc import Iterable
from difflib import get_close_matches

_WAIT = "; wait and try again."


class StorageError(Exception):
    """The store could not do what was asked; nothing was half done."""

    transient = False
    """True if the same call may succeed later without any action here."""


class Unavailable(StorageError):
    """The store, its server or its disk cannot serve now; the same call may succeed later.

    Nothing was done, unless a server was lost at the very moment of the commit. Repeating the same call then changes
    nothing more: ending a job is refused as LeaseLost, and rows that exist already are not added twice.
    """

    transient = True

    def __init__(self, message: str):
        super().__init__(f"{message.removesuffix(_WAIT).rstrip('.')}{_WAIT}")


class NotAStore(StorageError):
    """There is no league store at the location given. Anything found there was left untouched."""


class NoPermission(StorageError):
    """The user may not write the store, or its disk is read-only; the store itself may be whole."""


class NoLeague(StorageError):
    """The store holds no league yet."""


class OldStore(StorageError):
    """The store's schema is older than any schema that this program can migrate."""

    def __init__(self, where: str, found: int, first: int):
        super().__init__(
            f"{where} has schema {found}, from before the first that can be brought up to date ({first}); it was left "
            "untouched: give another place for a new store."
        )


class OutdatedStore(StorageError):
    """The schema of a store on a server is older than the current one, and no migration was requested."""

    def __init__(self, where: str, found: int, known: int):
        super().__init__(
            f"{where} has schema {found}, and this program's is {known}: stop what runs there, keep a copy (pg_dump),"
            " then `league migrate` brings it up to date."
        )


class NewerStore(StorageError):
    """The store's schema is newer than this program knows."""

    def __init__(self, where: str, found: int, known: int):
        super().__init__(f"{where} has schema {found}, but this program knows only up to {known}: update robot-league.")


class WrongBlobStore(StorageError):
    """The location given for a store's blobs holds the blobs of another store; nothing was written there."""


class DamagedBlob(StorageError):
    """A blob is missing, or its bytes do not hash to its name; `data` holds the bytes that were found."""

    def __init__(self, digest: str, place: str, fault: str, data: bytes | None = None):
        super().__init__(f"Blob {digest} is {fault}: {place}")
        self.digest, self.fault, self.data = digest, fault, data


class LeaseLost(StorageError):
    """The job was claimed by another worker, finished or taken back in the meantime; nothing was written."""


class Superseded(LeaseLost):
    """A player has continued from the checkpoint that the results start from; nothing was written."""


LISTED = 20
"""Most names that a message lists: a league may have thousands of snapshots."""


class UnknownName(StorageError):
    """The store has no such name; the message lists known names, LISTED at most, and suggests the closest one."""

    def __init__(self, kind: str, name: str, known: Iterable[str]):
        names = sorted(known, key=_natural)
        near = get_close_matches(name, names, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        listed = ", ".join(names[:LISTED]) or "none"
        more = f" and {len(names) - LISTED:,} more" if len(names) > LISTED else ""
        super().__init__(f"There is no {kind} {name!r} here; there is: {listed}{more}.{hint}")


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts blue@16 before blue@108: numbers within a name by their value."""
    return [(int(part) if part.isdecimal() else -1, part) for part in re.split(r"([0-9]+)", name)]


_TRANSIENT = {
    *(errno.ENOSPC, errno.EDQUOT, errno.ENFILE, errno.EMFILE, errno.ENOMEM, errno.EAGAIN, errno.EBUSY),
    *(errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN, errno.EHOSTDOWN, errno.EHOSTUNREACH, errno.ENODEV),
}


def disk_error(message: str, error: OSError) -> StorageError:
    """Return the error for a refused system call: Unavailable where it may pass (a full disk, a lost network)."""
    kind = Unavailable if error.errno in _TRANSIENT else StorageError
    return kind(f"{message}: {error.strerror or error}.")
