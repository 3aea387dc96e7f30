"""The manager of a league: it keeps worker processes alive and queues the jobs that the schedulers plan.

It holds no state of its own. A stop may be a kill and a start is a recovery: work that is not in the store was not done
yet. Of several managers of one league one leads, by a lease like that of a job. Loads neither torch, jax nor mujoco.
"""

import multiprocessing
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from typing import Literal

from league.config.experiment import Config
from league.config.run_spec import RunSpec
from league.runtime.heartbeat import BEAT, LEASE
from league.runtime.warm_worker import WarmWorker
from league.runtime.worker_process import WorkerSpec, run_process
from league.scheduling.episode_lengths import averaged_iterations
from league.scheduling.planner import BEFORE_RATING, plan
from league.state.jobs import RatingMatch, TrainingTurn
from league.state.league_state import LeagueState
from league.state.liveness import GRACE, grace, process_named
from league.system import exit_codes
from storage.errors import Unavailable
from storage.records import Lease, Worker
from storage.store import Store

TICK = 0.2  # seconds between two reads of the store
SILENT = 3 * BEAT  # seconds without a heartbeat after which a process that cannot be found counts as dead
MAX_RESTARTS = 5  # in a row, each within RESTART_WINDOW: then a restart does not solve the problem
RESTART_WINDOW = 30.0
REST = 300.0  # seconds until an unfit worker, which could not do jobs that others can do, is started again

RunState = Literal["training", "rating", "ending", "done", "stopped"]  # ending: workers finish their jobs


class ManagerError(Exception):
    """Error that prevents a league from running or continuing; the message is for the user.

    `transient`: the same command may succeed later, although nobody changes anything.
    """

    def __init__(self, message: str, transient: bool = False):
        super().__init__(message)
        self.transient = transient


@dataclass
class _Slot:
    """A slot for a worker process, refilled when the process dies."""

    kinds: tuple[str, ...]
    number: int
    process: BaseProcess | WarmWorker | None = None
    started: float = 0.0
    deaths: int = 0
    rests_until: float = 0.0


class Manager:
    """The manager of one league, which runs until the budgets are spent or a stop is requested.

    `config` is the configuration that `spec` has as text; the manager applies the sizes of `spec` to it. A warm worker
    becomes the first train worker.
    """

    def __init__(self, store: Store, spec: RunSpec, config: Config, warm_worker: WarmWorker | None = None):
        self.store, self.spec, self.config = store, spec, spec.sized(config)
        self.host = socket.gethostname()
        self.id = f"{self.host}:{os.getpid()}:manager"
        self.stopping = self.hurried = False  # after the first and after the second signal
        self.state: RunState = "training"
        self._slots = [
            _Slot(kinds, number)
            for kinds, count in (
                ((TrainingTurn.kind,), config.workers.train),
                ((RatingMatch.kind,), config.workers.match),
            )
            for number in range(count)
        ]
        self._standby = warm_worker
        self._rating_time = BEFORE_RATING
        self._league_state: LeagueState | None = None
        self._seen = -1  # the store's revision that the plan has seen

    def run(self, report: Callable[[LeagueState, RunState, list[Worker]], None]) -> RunState:
        """Manage until done or stopped; `report` is called about once a second.

        Raises ManagerError if another manager leads the league, or if this manager cannot continue;
        KeyboardInterrupt after a second signal.
        """
        self._lead()
        handlers = {s: signal.signal(s, self._on_signal) for s in (signal.SIGINT, signal.SIGTERM)}
        reported = 0.0
        try:
            started = self.store.now()
            self.store.remove_silent_workers(self.config.league, self.config.storage.worker_retention_seconds)
            self._retry_failed()
            self._release_orphans()
            while True:
                try:
                    self._refill_slots()
                    self._plan_if_changed(started)
                    if self.stopping:
                        self.state = "stopped"
                    over = self.state in ("done", "stopped")
                    if time.monotonic() - reported >= BEAT or over:
                        reported = time.monotonic()
                        self._renew_lead()
                        assert self._league_state is not None
                        workers = self.store.workers(self.config.league, 10 * BEAT)
                        report(self._league_state, "ending" if over else self.state, workers)
                except Unavailable as error:
                    self._wait_for_store(error)
                if self.state in ("done", "stopped"):
                    return self._finish(report)
                time.sleep(TICK)
        finally:
            self._end_workers()
            self._stop_leading()
            for number, handler in handlers.items():
                signal.signal(number, handler)
            if self.hurried:
                raise KeyboardInterrupt

    def _finish(self, report: Callable[[LeagueState, RunState, list[Worker]], None]) -> RunState:
        """End the workers, and report the state that includes what they still finished, such as a rating batch."""
        self._end_workers()
        with suppress(Unavailable):
            window = averaged_iterations(self.config)
            self._league_state = LeagueState.of(self.store, self.config.league, self._league_state, recent=window)
        if self._league_state is not None:
            report(self._league_state, self.state, [])
        return self.state

    # Planning --------------------------------------------------------------------------------------------------------

    def _plan_if_changed(self, started: float) -> None:
        """Plan again if the league has changed since the last plan, or stop if a stop was requested since `started`."""
        revision = self.store.revision(self.config.league)
        if revision != self._seen:
            asked, recent = self.store.stop_asked(self.config.league, started), averaged_iterations(self.config)
            self._league_state = LeagueState.of(self.store, self.config.league, self._league_state, recent=recent)
            planned = self._plan(self._league_state)
            self.state, self._seen = "stopped" if asked else planned, revision
        elif self._rating_time.over():
            assert self._league_state is not None
            self.state = self._plan(self._league_state)

    def _plan(self, state: LeagueState) -> RunState:
        """Queue the next jobs and return the state of the run."""
        planned = plan(self.config, state, self._rating_time)
        if planned.jobs or planned.phases:
            self.store.queue(planned.jobs, planned.phases)
        self._rating_time = planned.rating_time  # only now: its phase is in the store
        return planned.activity

    # Processes -------------------------------------------------------------------------------------------------------

    def _refill_slots(self) -> None:
        """Start a process in every slot that has none. A job that a dead process held counts as failed once."""
        context = multiprocessing.get_context("spawn")
        for slot in self._slots:
            if slot.process is not None and slot.process.is_alive():
                continue
            if slot.process is not None:
                self._handle_exit(slot)
            if time.monotonic() < slot.rests_until:
                continue
            devices = self.config.training.devices if TrainingTurn.kind in slot.kinds else 1
            spec = WorkerSpec(self.spec, slot.kinds, slot.number, os.getpid(), devices)
            if self._standby is not None and slot.number == 0 and TrainingTurn.kind in slot.kinds:
                slot.process, self._standby = self._standby, None
                slot.process.assign(spec)
            else:
                slot.process = context.Process(target=run_process, args=(spec,))
                slot.process.start()
            slot.started = time.monotonic()

    def _handle_exit(self, slot: _Slot) -> None:
        process = slot.process
        assert process is not None
        for job in self.store.jobs(self.config.league, "leased"):
            if job.holder is not None and job.holder.startswith(f"{self.host}:{process.pid}:"):
                reason = f"the worker died over it (exit code {process.exitcode})"
                lease = Lease(job.id, job.holder, job.attempt)
                self.store.fail(lease, reason, tries=self.config.workers.max_attempts, wait=1.0)
        if process.exitcode == exit_codes.UNFIT:  # it has printed the reason; other workers do its jobs
            slot.process, slot.rests_until = None, time.monotonic() + REST
            return
        quick = time.monotonic() - slot.started < RESTART_WINDOW
        slot.deaths = slot.deaths + 1 if quick else 1
        if slot.deaths > MAX_RESTARTS:
            raise ManagerError(
                f"a {'+'.join(slot.kinds)} worker died {slot.deaths} times in a row (exit code {process.exitcode}):"
                " run `league run --debug` to see why; nothing is lost",
                transient=process.exitcode is not None
                and (process.exitcode < 0 or process.exitcode == exit_codes.PASSING),
            )
        slot.process = None

    def _end_workers(self) -> None:
        """Ask all workers to finish their iteration and commit; kill those that do not, and all at a second Ctrl-C."""
        alive = [slot.process for slot in self._slots if slot.process is not None and slot.process.is_alive()]
        for process in alive:
            process.terminate()
        deadline = time.monotonic() + self._grace()
        with suppress(KeyboardInterrupt):
            while not self.hurried and time.monotonic() < deadline and any(p.is_alive() for p in alive):
                time.sleep(0.05)
        for process in alive:
            process.kill()
            process.join()

    def _grace(self) -> float:
        """Return the seconds in which workers have to finish; GRACE if the store is away."""
        with suppress(Unavailable):
            return grace(self.store.workers(self.config.league, 10 * BEAT))
        return GRACE

    def _release_orphans(self) -> None:
        """Release the jobs that dead processes of this host hold, rather than wait until their leases expire.

        They died with an earlier manager, so their jobs do not count as failed. A holder that is wrongly taken for
        dead, say on another host of the same name, loses only work: its token is then out of date. For that reason a
        holder counts as dead only if it has also sent no heartbeat for SILENT seconds.
        """
        beating = {worker.id for worker in self.store.workers(self.config.league, SILENT)}
        for job in self.store.jobs(self.config.league, "leased"):
            if job.holder is not None and job.holder not in beating and process_named(job.holder).dead:
                self.store.release(Lease(job.id, job.holder, job.attempt))

    def _retry_failed(self) -> None:
        """Queue again the jobs that were set aside, and resume paused players: the league was started again."""
        for job in self.store.jobs(self.config.league, "failed"):
            self.store.requeue(job.id)
        for player in self.store.players(self.config.league):
            if player.paused is not None:
                self.store.set_paused(self.config.league, player.name, None)

    # Leading ---------------------------------------------------------------------------------------------------------

    def _lead(self) -> None:
        """Become the league's manager. A manager that died on this host is replaced at once.

        Raises ManagerError, which names the process that leads.
        """
        league = self.config.league
        if self.store.acquire_leadership(league, self.id, LEASE):
            return
        leader = self.store.leader(league)
        process = process_named(leader[0] if leader else "another:process:")
        if leader is not None and process.dead:
            self.store.release_leadership(league, leader[0])
            if self.store.acquire_leadership(league, self.id, LEASE):
                return
        raise ManagerError(
            f"league {league!r} is running already (process {process.pid} on {process.host}): see `league status`, or"
            " `league stop` first",
            transient=True,
        )

    def _renew_lead(self) -> None:
        """Renew the lease of the manager, send a heartbeat, and release the jobs that dead processes hold.

        Raises ManagerError if another manager leads by now.
        """
        if not self.store.acquire_leadership(self.config.league, self.id, LEASE):
            raise ManagerError(
                f"another manager has taken over league {self.config.league!r}; this one has ended", transient=True
            )
        self.store.heartbeat(self.id, self.config.league, "manager", os.getpid(), self.host, {"doing": self.state})
        self._release_orphans()

    def _stop_leading(self) -> None:
        try:
            self.store.release_leadership(self.config.league, self.id)
            self.store.remove_worker(self.id)
        except Unavailable:
            return  # the leases expire by themselves

    def _wait_for_store(self, error: Unavailable) -> None:
        """Report that the store is away, and wait a moment before the next try."""
        print(f"league: waiting: {error}", file=sys.stderr, flush=True)
        if self.stopping:
            self.state = "stopped"
        time.sleep(2 * BEAT)

    def _on_signal(self, number: int, frame: object) -> None:
        if self.stopping and not self.hurried:
            self.hurried = True
            raise KeyboardInterrupt
        self.stopping = True
