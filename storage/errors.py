"""What can go wrong with a store, each told in one line that a user can act on.

StorageError
├── Away            the store or its disk cannot be reached, or is full or locked, now: wait and try again
├── NotAStore       nothing there, or something else is
├── OldStore        written by an earlier version whose stores this one does not read
├── OutdatedStore   written by an earlier version, and nobody has asked to bring it up to date
├── NewerStore      written by a later version of this program
├── DamagedBlob     a blob is missing or its bytes are not those it is named by
├── LeaseLost       a result came from a worker that no longer holds the job
│   └── Superseded  a result goes on from a checkpoint that is no longer its player's newest
└── UnknownName     no league, player, job, ... of that name
"""

# ruff: noqa: N818  (a sentence reads better: "the lease was lost", "not a store")

import errno
from collections.abc import Iterable
from difflib import get_close_matches


class StorageError(Exception):
    """The store could not do what was asked; nothing was half done."""


class Away(StorageError):
    """The store, its server or its disk cannot serve now; the same call may succeed later.

    Nothing was done, unless a server was lost at the very moment of the commit; then the same call, made again, changes
    nothing more: a job's end is refused as LeaseLost, and what is there already is not added twice.
    """

    def __init__(self, message: str):
        super().__init__(f"{message.rstrip('.')}; wait and try again.")


class NotAStore(StorageError):
    """There is no league store at the place given. Whatever is there was left untouched."""


class OldStore(StorageError):
    """The store's schema is older than any that this program can bring up to date."""

    def __init__(self, where: str, found: int, first: int):
        super().__init__(
            f"{where} has schema {found}, from before the first that can be brought up to date ({first}); it was left "
            "untouched: give another place for a new store."
        )


class OutdatedStore(StorageError):
    """The schema of a store on a server is older than today's, and nobody has asked to bring it up to date."""

    def __init__(self, where: str, found: int, known: int):
        super().__init__(
            f"{where} has schema {found}, and this program's is {known}: stop what runs there, keep a copy (pg_dump),"
            " then `league migrate` brings it up to date."
        )


class NewerStore(StorageError):
    """The store's schema is newer than this program knows."""

    def __init__(self, where: str, found: int, known: int):
        super().__init__(f"{where} has schema {found}, but this program knows only up to {known}: update robot-league.")


class DamagedBlob(StorageError):
    """A blob is missing, or its bytes no longer hash to its name; `data` are those that are there."""

    def __init__(self, digest: str, place: str, fault: str, data: bytes | None = None):
        super().__init__(f"Blob {digest} is {fault}: {place}")
        self.digest, self.fault, self.data = digest, fault, data


class LeaseLost(StorageError):
    """The job was claimed by another worker, finished or taken back meanwhile; nothing was written."""


class Superseded(LeaseLost):
    """A player has gone on from the checkpoint that the results start from; nothing was written."""


class UnknownName(StorageError):
    """A name that the store does not have; the message lists those it has and the nearest one."""

    def __init__(self, kind: str, name: str, known: Iterable[str]):
        names = sorted(known)
        near = get_close_matches(name, names, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        super().__init__(f"There is no {kind} {name!r} here; there is: {', '.join(names) or 'none'}.{hint}")


_PASSING = {
    *(errno.ENOSPC, errno.EDQUOT, errno.ENFILE, errno.EMFILE, errno.ENOMEM, errno.EAGAIN, errno.EBUSY),
    *(errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN, errno.EHOSTDOWN, errno.EHOSTUNREACH, errno.ENODEV),
}


def disk_error(message: str, error: OSError) -> StorageError:
    """What to raise when the system refuses: Away where that may pass (a full disk, a network that is down)."""
    kind = Away if error.errno in _PASSING else StorageError
    return kind(f"{message}: {error.strerror or error}.")
