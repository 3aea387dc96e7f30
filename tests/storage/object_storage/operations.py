"""Blob operations by several processes while a fault is injected, repeated while the server is away, as workers do."""

import os
import random
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar

from storage.blobs.blobs import open_blobs
from storage.errors import DamagedBlob, StorageError, Unavailable

R = TypeVar("R")
SIZES = (0, 1_000, 30_000, 200_000)
AWAY = 0.5  # seconds between two attempts


class Client:
    """One process' operations, with their times and outcomes."""

    def __init__(self, url: str, seed: int):
        self._blobs, self._rng, self.counts = open_blobs(url), random.Random(seed), Counter[str]()
        self.longest, self.strange = 0.0, list[str]()

    def run(self, operations: int, known: list[str]) -> dict[str, Any]:
        """Do so many operations; `known` are digests that others have put before. Return counts and what was put."""
        put = list[str]()
        for _ in range(operations):
            read = (put or known) and self._rng.random() < 0.5
            if read:
                digest = self._rng.choice(put + known)
                self._insist(lambda digest=digest: self._blobs.get(digest))
            else:
                data = os.urandom(8) + self._rng.randbytes(self._rng.choice(SIZES))
                done = self._insist(lambda data=data: self._blobs.put(data))
                put += [done] if done is not None else []
            self.counts["reads" if read else "writes"] += 1
        return {"counts": self.counts, "longest": self.longest, "put": put, "strange": self.strange}

    def _insist(self, operation: Callable[[], R]) -> R | None:
        """Repeat an operation while the server is away; None after another error, which is counted."""
        while True:
            began = time.monotonic()
            try:
                return operation()
            except Unavailable:
                self.counts["repeated"] += 1
            except DamagedBlob as error:
                self.counts["called lost or corrupt"] += 1
                self.strange.append(str(error)[:300])
                return None
            except StorageError as error:
                self.counts["refused"] += 1
                self.strange.append(str(error)[:300])
                return None
            finally:
                self.longest = max(self.longest, time.monotonic() - began)
            time.sleep(AWAY)


def operate(url: str, seed: int, operations: int, known: list[str]) -> dict[str, Any]:
    """Run a client in this process."""
    import s3fs  # noqa: F401  (takes seconds, which no operation should be charged with)

    return Client(url, seed).run(operations, known)


def lost(url: str, digests: list[str]) -> list[str]:
    """Return what is wrong with these blobs, which were all put."""
    blobs, found = open_blobs(url), list[str]()
    for digest in digests:
        try:
            blobs.get(digest)
        except StorageError as error:
            found.append(str(error))
    return found
