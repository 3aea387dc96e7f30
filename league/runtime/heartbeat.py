"""The second thread of a worker: it reports the worker's status, renews its lease, and notices when to stop."""

import os
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

from arenas.physics.kernels import progress as kernel_progress
from league.system import exit_codes
from storage.errors import StorageError
from storage.store import Store

if TYPE_CHECKING:
    from league.runtime.worker import Worker

BEAT = 1.0  # seconds between two heartbeats
LEASE = 15.0  # seconds for which a manager leads without renewing its lease

R = TypeVar("R")


class Heartbeat:
    """A thread that runs from `start` to `end`, also while a worker finishes its job after a stop.

    A store that is away for a moment does not end the thread; the expiry of the lease settles the rest.
    """

    def __init__(self, worker: "Worker"):
        self._worker = worker
        self._manager = ManagerWatch(worker.store, worker.config.league, worker.spec.leader)
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
        parent = self._worker.spec.parent
        return self._manager.is_gone() if parent is None else os.getppid() != parent


class ManagerWatch:
    """Watch over a manager on another host, by its lease alone.

    A manager cannot renew its lease while the store is away, and goes on afterwards. So one whose lease has ended has
    the time of another lease to return. One that has given up, or has a successor, is gone at once.
    """

    def __init__(self, store: Store, league: str, manager: str, clock: Callable[[], float] = time.monotonic):
        self._store, self._league, self._manager, self._clock = store, league, manager, clock
        self._silent_since: float | None = None

    def is_gone(self) -> bool:
        """Return whether the manager has ended; False if the store is away."""
        try:
            leader, leads = self._store.last_leader(self._league) or ("", False)
        except StorageError:
            return False
        now = self._clock()
        if leads:
            self._silent_since = None
        elif self._silent_since is None:
            self._silent_since = now
        return leader != self._manager or (self._silent_since is not None and now - self._silent_since > LEASE)


def none_on_error(operation: Callable[..., R], *args: Any) -> R | None:
    """Return the result of an operation of the store, or None if it raises StorageError."""
    try:
        return operation(*args)
    except StorageError:
        return None
