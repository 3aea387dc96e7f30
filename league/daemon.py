"""The manager: keeps worker processes alive and asks the plan for their next jobs. It holds no state of its own.

Stop is kill, start is recovery: whatever is not in the store was not done yet. Of several managers on one store one
leads, by a lease like that of any job; loads neither torch, jax nor mujoco.
"""

import math
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

from league import matches, plan
from league.config import experiment as configuration
from league.config.durations import seconds
from league.config.experiment import Config
from league.handover import Standby
from league.jobs import RatingMatch, TrainingTurn
from league.liveness import is_dead, place
from league.standing import Standing
from league.worker import BEAT, Post, work
from storage.errors import Away
from storage.records import Lease, Worker
from storage.store import Store

TICK = 0.2  # seconds between two looks at the store
LEASE = 15.0  # seconds for which a manager leads without a word
SILENT = 3 * BEAT  # seconds without a word after which a process that cannot be found is dead
GRACE = 60.0  # seconds that a worker has to finish its iteration
MAX_RESTARTS = 5  # in a row, each within RESTART_WINDOW: then something is wrong that a restart does not mend
RESTART_WINDOW = 30.0

Stage = Literal["training", "rating", "done", "stopped"]


class DaemonError(Exception):
    """The league cannot run, or cannot go on; the message is for the user."""


@dataclass
class _Slot:
    """A place for a worker process, refilled when the process dies."""

    kinds: tuple[str, ...]
    number: int
    process: BaseProcess | Standby | None = None
    started: float = 0.0
    deaths: int = 0


class Manager:
    """Runs a league until its budgets are spent or it is told to stop.

    Who stands by becomes the first train worker.
    """

    def __init__(self, store: Store, where: str, config: Config, standby: Standby | None = None):
        self.store, self.where, self.config = store, where, config
        self.host = socket.gethostname()
        self.id = f"{self.host}:{os.getpid()}:manager"
        self.stopping = self.hurried = False
        self.stage: Stage = "training"
        self._slots = [
            _Slot(kinds, number)
            for kinds, count in (
                ((TrainingTurn.kind,), config.workers.train),
                ((RatingMatch.kind,), config.workers.match),
            )
            for number in range(count)
        ]
        self._standby = standby
        self._rating_until = math.inf  # on the monotonic clock; infinite before training is over
        self._standing: Standing | None = None
        self._seen = -1  # the store's revision that the plan has seen

    def run(self, tell: Callable[[Standing, Stage, list[Worker]], None]) -> Stage:
        """Manage until done or stopped; `tell` is called about once a second.

        Raises DaemonError where another manager leads the league, or where this one cannot go on.
        """
        self._lead()
        handlers = {s: signal.signal(s, self._on_signal) for s in (signal.SIGINT, signal.SIGTERM)}
        told = 0.0
        try:
            started = self.store.now()
            self.store.trim_workers(self.config.league, seconds(self.config.storage.workers))
            self._requeue_failed()
            self._release_orphans()
            while True:
                try:
                    self._keep_workers()
                    self._look(started)
                    if self.stopping:
                        self.stage = "stopped"
                    if time.monotonic() - told >= BEAT or self.stage in ("done", "stopped"):
                        told = time.monotonic()
                        self._hold()
                        assert self._standing is not None
                        tell(self._standing, self.stage, self.store.workers(self.config.league, 10 * BEAT))
                except Away as error:
                    self._wait(error)
                if self.stage in ("done", "stopped"):
                    return self.stage
                time.sleep(TICK)
        finally:
            self._end_workers()
            self._leave()
            for number, handler in handlers.items():
                signal.signal(number, handler)
            if self.hurried:
                raise KeyboardInterrupt

    # What comes next -------------------------------------------------------------------------------------------------

    def _look(self, started: float) -> None:
        """Plan anew if anything has happened since the last look, or stop if that is what was asked for."""
        revision = self.store.revision(self.config.league)
        if revision != self._seen:
            asked, recent = self.store.stop_asked(self.config.league, started), self.config.budget.window
            self._standing = Standing.of(self.store, self.config.league, self._standing, recent=recent)
            planned = self._plan(self._standing)
            self.stage, self._seen = "stopped" if asked else planned, revision
        elif self._late():
            assert self._standing is not None
            self.stage = self._plan(self._standing)

    def _plan(self, standing: Standing) -> Stage:
        """Queue what comes next and say where the league stands."""
        turns = plan.next_turns(self.config, standing)
        training = bool(turns.jobs) or plan.is_training(standing)
        if training:
            self._rating_until = math.inf
        elif self._rating_until == math.inf:
            phase = matches.rating_phase(self.config, standing)
            self.store.queue((), [phase])
            left = phase.until["seconds"]
            self._rating_until = sys.float_info.max if left is None else time.monotonic() + left
        late = self._late()
        wanted = matches.next_matches(self.config, standing) if self.config.workers.match and not late else plan.Plan()
        if turns.jobs or wanted.jobs:
            self.store.queue([*turns.jobs, *wanted.jobs], turns.phases)
        if training:
            return "training"
        if late:
            self.store.queue((), [matches.rating_over(self.config, standing)])
        return "rating" if not late and (wanted.jobs or matches.is_rating(standing)) else "done"

    def _late(self) -> bool:
        """Whether the time for rating after training is over."""
        return time.monotonic() > self._rating_until

    # Processes -------------------------------------------------------------------------------------------------------

    def _keep_workers(self) -> None:
        """Start a process in every slot that has none. What a dead one held is a failure of that job."""
        context = multiprocessing.get_context("spawn")
        for slot in self._slots:
            if slot.process is not None and slot.process.is_alive():
                continue
            if slot.process is not None:
                self._bury(slot)
            text = configuration.dumps(self.config)
            spread = self.config.training.devices if TrainingTurn.kind in slot.kinds else 1
            post = Post(self.where, self.config.storage.blobs, text, slot.kinds, slot.number, os.getpid(), spread)
            if self._standby is not None and slot.number == 0 and TrainingTurn.kind in slot.kinds:
                slot.process, self._standby = self._standby, None
                slot.process.hire(post)
            else:
                slot.process = context.Process(target=work, args=(post,))
                slot.process.start()
            slot.started = time.monotonic()

    def _bury(self, slot: _Slot) -> None:
        process = slot.process
        assert process is not None
        for job in self.store.jobs(self.config.league, "leased"):
            if job.holder is not None and job.holder.startswith(f"{self.host}:{process.pid}:"):
                reason = f"the worker died over it (exit code {process.exitcode})"
                lease = Lease(job.id, job.holder, job.attempt)
                self.store.fail(lease, reason, tries=self.config.workers.tries, wait=1.0)
        quick = time.monotonic() - slot.started < RESTART_WINDOW
        slot.deaths = slot.deaths + 1 if quick else 1
        if slot.deaths > MAX_RESTARTS:
            raise DaemonError(
                f"a {'+'.join(slot.kinds)} worker died {slot.deaths} times in a row (exit code {process.exitcode}):"
                " run `league run --debug` to see why; nothing is lost"
            )
        slot.process = None

    def _end_workers(self) -> None:
        """Ask all to finish their iteration and commit; end those that do not, and all at a second Ctrl-C."""
        alive = [slot.process for slot in self._slots if slot.process is not None and slot.process.is_alive()]
        for process in alive:
            process.terminate()
        deadline = time.monotonic() + GRACE
        with suppress(KeyboardInterrupt):
            while not self.hurried and time.monotonic() < deadline and any(p.is_alive() for p in alive):
                time.sleep(0.05)
        for process in alive:
            process.kill()
            process.join()

    def _release_orphans(self) -> None:
        """Give back what dead processes of this host hold, rather than wait until their leases expire.

        They died with an earlier manager, so nothing is held against their jobs. A holder that was wrongly taken for
        dead, say on a host of the same name, loses work and nothing else: its token is old by then. So only those are
        taken for dead that have also been silent.
        """
        beating = {worker.id for worker in self.store.workers(self.config.league, SILENT)}
        for job in self.store.jobs(self.config.league, "leased"):
            if job.holder is not None and job.holder not in beating and is_dead(job.holder):
                self.store.release(Lease(job.id, job.holder, job.attempt))

    def _requeue_failed(self) -> None:
        """A person has started the league again, so what was set aside deserves another try."""
        for job in self.store.jobs(self.config.league, "failed"):
            self.store.requeue(job.id)

    # Leading ---------------------------------------------------------------------------------------------------------

    def _lead(self) -> None:
        """Become the league's manager, or say who is. One that died on this host is not waited for."""
        league = self.config.league
        if self.store.lead(league, self.id, LEASE):
            return
        leader = self.store.leader(league)
        if leader is not None and is_dead(leader[0]):
            self.store.unlead(league, leader[0])
            if self.store.lead(league, self.id, LEASE):
                return
        host, pid = place(leader[0] if leader else "another:process:")
        raise DaemonError(
            f"league {league!r} is running already (process {pid} on {host}): see `league status`, or `league stop`"
            " first"
        )

    def _hold(self) -> None:
        """Go on leading, and say so; release what dead processes hold."""
        if not self.store.lead(self.config.league, self.id, LEASE):
            raise DaemonError(f"another manager has taken over league {self.config.league!r}; this one has ended")
        self.store.beat(self.id, self.config.league, "manager", os.getpid(), self.host, {"doing": self.stage})
        self._release_orphans()

    def _leave(self) -> None:
        try:
            self.store.unlead(self.config.league, self.id)
            self.store.leave(self.id)
        except Away:
            return  # the leases expire by themselves

    def _wait(self, error: Away) -> None:
        """The store is away: say so, and try again."""
        print(f"league: waiting: {error}", file=sys.stderr, flush=True)
        if self.stopping:
            self.stage = "stopped"
        time.sleep(2 * BEAT)

    def _on_signal(self, number: int, frame: object) -> None:
        if self.stopping and not self.hurried:
            self.hurried = True
            raise KeyboardInterrupt
        self.stopping = True
