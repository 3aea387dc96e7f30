"""The second thread of a worker: it reports the worker's status, renews its lease, and notices when to stop."""

import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any, TypeVar

from arenas.physics.kernels import progress as kernel_progress
from league.system import exit_codes
from storage.errors import StorageError

if TYPE_CHECKING:
    from league.runtime.worker import Worker

BEAT = 1.0  # seconds between two heartbeats

R = TypeVar("R")


class Heartbeat:
    """A thread that runs from `start` to `end`, also while a worker finishes its job after a stop.

    A store that is away for a moment does not end the thread; the expiry of the lease settles the rest.
    """

    def __init__(self, worker: "Worker"):
        self._worker = worker
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def end(self) -> None:
        """End the thread, and wait for its end for at most two beats."""
        self._ended.set()
        self._thread.join(timeout=2 * BEAT)

    def _run(self) -> None:
        worker, store, config = self._worker, self._worker.store, self._worker.config
        kinds, league = "+".join(worker.spec.kinds), config.league
        started: float | None = None
        renewed = time.monotonic()
        while not self._ended.wait(BEAT):
            if self._manager_is_gone():  # the current job is finished and committed
                worker.stopping.set()
            if started is None:
                started = none_on_error(store.now)
            none_on_error(store.heartbeat, worker.id, league, kinds, worker.pid, worker.host, self._status())
            if started is not None and none_on_error(store.stop_asked, league, started):
                worker.stopping.set()
            lease = worker.lease
            if worker.stopping.is_set() and worker.expendable and worker.spec.parent is not None:
                if lease is not None:
                    none_on_error(store.release, lease)
                none_on_error(store.remove_worker, worker.id)
                os._exit(exit_codes.DONE)
            if lease is not None and time.monotonic() - renewed > config.workers.lease / 4:
                renewed = time.monotonic()
                if none_on_error(store.renew, lease, config.workers.lease) is False:
                    worker.lease_lost = worker.lease == lease

    def _status(self) -> dict[str, Any]:
        """Return the worker's status, with the kernels left to compile or the share of a GPU that matches take."""
        status, remaining = dict(self._worker.status), kernel_progress.describe()
        if remaining:
            status["doing"] = f"{status['doing']}: {remaining}"
        elif self._worker.pace is not None and status["doing"] == "rating":
            share = self._worker.pace.recent()
            status |= {"doing": f"rating, {100 * share:.3g} % of the last 30 s", "share": share}
        return status

    def _manager_is_gone(self) -> bool:
        """Return whether the manager has ended; on another host, as far as the store can tell, if it answers."""
        worker = self._worker
        if worker.spec.parent is not None:
            return os.getppid() != worker.spec.parent
        with suppress(StorageError):
            return (worker.store.leader(worker.config.league) or ("",))[0] != worker.spec.leader
        return False


def none_on_error(operation: Callable[..., R], *args: Any) -> R | None:
    """Return the result of an operation of the store, or None if it raises StorageError."""
    try:
        return operation(*args)
    except StorageError:
        return None
