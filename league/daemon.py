"""The manager: keeps worker processes alive and asks the plan for their next jobs. It holds no state of its own.

Stop is kill, start is recovery: whatever is not in the store was not done yet.
"""

import multiprocessing
import os
import signal
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from typing import Literal

from league import config as configuration
from league import plan
from league.config import Config
from league.plan import Standing
from league.worker import BEAT, work
from storage.records import Lease, Worker
from storage.store import Store

TICK = 0.2  # seconds between two looks at the store
SILENT = 3 * BEAT  # seconds without a word after which a process that cannot be found is dead
GRACE = 60.0  # seconds that a worker has to finish its iteration
MAX_RESTARTS = 5  # in a row, each within RESTART_WINDOW: then something is wrong that a restart does not mend
RESTART_WINDOW = 30.0

Phase = Literal["training", "rating", "done", "stopped"]


class DaemonError(Exception):
    """The league cannot run, or cannot go on; the message is for the user."""


@dataclass
class _Slot:
    """A place for a worker process, refilled when the process dies."""

    kinds: tuple[str, ...]
    number: int
    process: BaseProcess | None = None
    started: float = 0.0
    deaths: int = 0


class Manager:
    """Runs a league until its budgets are spent or it is told to stop."""

    def __init__(self, store: Store, where: str, config: Config):
        self.store, self.where, self.config = store, where, config
        self.id = f"{socket.gethostname()}:{os.getpid()}:manager"
        self.stopping = False
        self.phase: Phase = "training"
        self._slots = [
            _Slot(kinds, number)
            for kinds, count in (((plan.TRAIN,), config.workers.train), ((plan.MATCH,), config.workers.match))
            for number in range(count)
        ]
        self._rating_since: float | None = None

    def run(self, tell: Callable[[Standing, Phase, list[Worker]], None]) -> Phase:
        """Manage until done or stopped; `tell` is called about once a second. Raises DaemonError if it cannot go on."""
        handlers = {s: signal.signal(s, self._on_signal) for s in (signal.SIGINT, signal.SIGTERM)}
        started, told = self.store.now(), 0.0
        standing: Standing | None = None
        self._requeue_failed()
        try:
            while True:
                self._keep_workers()
                standing = Standing.of(self.store, self.config.league, standing.matches if standing else ())
                self._check_failures(standing)
                self.phase = self._plan(standing)
                if self.stopping or self.store.stop_asked(self.config.league, started):
                    self.phase = "stopped"
                if time.monotonic() - told >= BEAT or self.phase in ("done", "stopped"):
                    told = time.monotonic()
                    self._release_orphans()
                    self.store.beat(self.id, self.config.league, "manager", os.getpid(), socket.gethostname(), {})
                    tell(standing, self.phase, self.store.workers(self.config.league, 10 * BEAT))
                if self.phase in ("done", "stopped"):
                    return self.phase
                time.sleep(TICK)
        finally:
            self._end_workers()
            self.store.leave(self.id)
            for number, handler in handlers.items():
                signal.signal(number, handler)

    def _plan(self, standing: Standing) -> Phase:
        """Queue what comes next and say where the league stands."""
        turn = plan.next_turn(self.config, standing)
        jobs = plan.next_matches(self.config, standing) if self.config.workers.match else []
        training = turn is not None or standing.is_open(plan.TRAIN)
        if not training and self._rating_since is None:
            self._rating_since = time.monotonic()
        late = self._rating_since is not None and (
            time.monotonic() - self._rating_since > self.config.budget.rate_seconds
        )
        self.store.queue([*([turn] if turn else []), *([] if late else jobs)])
        if training:
            return "training"
        return "rating" if not late and (jobs or standing.is_open(plan.MATCH)) else "done"

    def _keep_workers(self) -> None:
        """Start a process in every slot that has none."""
        context = multiprocessing.get_context("spawn")
        for slot in self._slots:
            if slot.process is not None and slot.process.is_alive():
                continue
            if slot.process is not None:
                quick = time.monotonic() - slot.started < RESTART_WINDOW
                slot.deaths = slot.deaths + 1 if quick else 1
                if slot.deaths > MAX_RESTARTS:
                    raise DaemonError(
                        f"a {'+'.join(slot.kinds)} worker died {slot.deaths} times in a row (exit code"
                        f" {slot.process.exitcode}): run `league run --debug` to see why; nothing is lost"
                    )
            text = configuration.dumps(self.config)
            slot.process = context.Process(target=work, args=(self.where, text, slot.kinds, slot.number))
            slot.process.start()
            slot.started = time.monotonic()

    def _end_workers(self) -> None:
        """Ask all to finish their iteration and commit; end those that do not."""
        alive = [slot.process for slot in self._slots if slot.process is not None and slot.process.is_alive()]
        for process in alive:
            process.terminate()
        deadline = time.monotonic() + GRACE
        for process in alive:
            process.join(max(0.0, deadline - time.monotonic()))
            if process.is_alive():
                process.kill()
                process.join()

    def _release_orphans(self) -> None:
        """Give back what dead processes of this host hold, rather than wait until their leases expire.

        A holder that was wrongly taken for dead, say on a host of the same name, loses work and nothing else: its token
        is old by then. So only those are taken for dead that have also been silent.
        """
        league, here = self.config.league, socket.gethostname()
        beating = {worker.id for worker in self.store.workers(league, SILENT)}
        for job in self.store.jobs(league, "leased"):
            host, pid, *_ = (job.holder or "").rsplit(":", 2)
            if host == here and job.holder not in beating and not _exists(int(pid)):
                self.store.release(Lease(job.id, str(job.holder), job.attempt))

    def _requeue_failed(self) -> None:
        """A person has started the league again, so what failed deserves another try."""
        for job in self.store.jobs(self.config.league, "failed"):
            self.store.requeue(job.id)

    def _check_failures(self, standing: Standing) -> None:
        failed = [job for job in standing.jobs if job.state == "failed"]
        if failed:
            job = failed[0]
            first = (job.error or "").strip().splitlines()[0]
            raise DaemonError(
                f"job {job.key} failed: {first} (`league status` shows it all; `league run` tries it again)"
            )

    def _on_signal(self, number: int, frame: object) -> None:
        if self.stopping:
            raise KeyboardInterrupt
        self.stopping = True


def running(store: Store, league: str) -> Worker | None:
    """The league's manager, if one is alive: it has beaten lately, and on this host its process exists."""
    for worker in store.workers(league, 10 * BEAT):
        if worker.kinds == "manager" and (worker.host != socket.gethostname() or _exists(worker.pid)):
            return worker
    return None


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
