"""What can go wrong with a store, each told in one line that a user can act on.

StorageError
├── NotAStore       nothing there, or something else is
├── NewerStore      written by a later version of this program
├── DamagedBlob     a blob is missing or its bytes are not those it is named by
├── LeaseLost       a result came from a worker that no longer holds the job
└── UnknownName     no league, job, ... of that name
"""

# ruff: noqa: N818  (a sentence reads better: "the lease was lost", "not a store")

from collections.abc import Iterable
from difflib import get_close_matches


class StorageError(Exception):
    """The store could not do what was asked; nothing was half done."""


class NotAStore(StorageError):
    """There is no league store at the place given. Whatever is there was left untouched."""


class NewerStore(StorageError):
    """The store's schema is newer than this program knows."""

    def __init__(self, where: str, found: int, known: int):
        super().__init__(f"{where} has schema {found}, but this program knows only up to {known}: update robot-league.")


class DamagedBlob(StorageError):
    """A blob is missing, or its bytes no longer hash to its name."""

    def __init__(self, digest: str, place: str, fault: str):
        super().__init__(f"Blob {digest} is {fault}: {place}")
        self.digest = digest


class LeaseLost(StorageError):
    """The job was claimed by another worker, finished or taken back meanwhile; nothing was written."""


class UnknownName(StorageError):
    """A name that the store does not have; the message lists those it has and the nearest one."""

    def __init__(self, kind: str, name: str, known: Iterable[str]):
        names = sorted(known)
        near = get_close_matches(name, names, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        super().__init__(f"There is no {kind} {name!r} here; there is: {', '.join(names) or 'none'}.{hint}")
