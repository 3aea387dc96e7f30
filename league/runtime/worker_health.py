"""Decision whether a worker is fit for its jobs, from its failed jobs and the presence of other workers."""

from contextlib import suppress

from storage.errors import StorageError
from storage.operations.leases import ALIVE_SECONDS, worker_of
from storage.store import Store


class WorkerHealth:
    """Number of jobs that have failed on a worker since its last success.

    If job after job fails and other workers are there to do them, the host is at fault, and the worker stops. A
    worker that is alone continues: nothing shows whether the host or the jobs are at fault, and the jobs are set aside.
    """

    def __init__(self, store: Store, league: str, worker: str, tries: int):
        self._store, self._league, self._worker, self._tries = store, league, worker, tries
        self._failures = 0

    def job_done(self) -> None:
        """Note that a job was done."""
        self._failures = 0

    def job_failed(self, kind: str, surely_here: bool) -> bool:
        """Note that a job of a kind failed, and return whether this worker is to stop.

        `surely_here`: this host is the cause, for instance because a package cannot be imported. Then one failure is
        enough.
        """
        self._failures += 1
        return (surely_here or self._failures >= self._tries) and self._others_take(kind)

    def _others_take(self, kind: str) -> bool:
        """Return whether another worker takes jobs of that kind now."""
        with suppress(StorageError):
            alive = self._store.workers(self._league, ALIVE_SECONDS)
            others = [w for w in alive if worker_of(w.id) not in (None, worker_of(self._worker))]
            return any(kind in w.kinds.split("+") for w in others)
        return False
