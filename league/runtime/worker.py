"""The lease loop of a worker: claim a job, do it, finish it. A worker that is killed at any moment loses only work.

Two things can go wrong. The store may be away for a while, and the worker waits. Or a job cannot be done here: the
worker reports that to the store, which has the job tried again and in the end sets it aside. `worker_process` starts
the process, `heartbeat` is its other thread, and `rating_jobs` plays matches.
"""

import os
import socket
import threading
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from league.config.experiment import Config
from league.runtime.heartbeat import BEAT, Heartbeat, none_on_error
from league.runtime.rating_jobs import RatingJobs
from league.runtime.worker_health import WorkerHealth
from league.scheduling.episode_lengths import averaged_iterations, longest_episode
from league.scheduling.turn_scheduler import continued_turn, next_turns
from league.state.jobs import RatingMatch, Task, TrainingTurn, decode
from league.state.league_state import LeagueState
from league.system.memory import TooLarge, is_short
from storage.database import lock_wait
from storage.errors import LeaseLost, StorageError, Unavailable, WrongBlobStore
from storage.records import Job, Lease
from storage.store import Store

if TYPE_CHECKING:
    from arenas.arena import Arena
    from league.runtime.worker_process import WorkerSpec
    from league.system.arena_build import Built
    from league.system.gpu_sharing import Pace
    from league.training.data_parallel.one_host import DataParallelTrainer
    from league.training.data_parallel.several_hosts import Ranks, RanksTrainer
    from league.training.trainer import Trainer

IDLE = 0.1  # seconds between two attempts to claim a job
AWAY = 1.0  # seconds between two attempts to reach a store that is away

R = TypeVar("R")


class Worker:
    """The loop of one process over leases. Arena, learners and compiled matches stay in memory between jobs.

    The heartbeat reads `status`, `lease`, `pace` and `expendable`, and sets `stopping` and `lease_lost`. `unfit` is the
    reason for which this worker cannot do jobs that others can do, as far as it is known.
    """

    def __init__(
        self, store: Store, config: Config, spec: "WorkerSpec", stopping: threading.Event,
        built: "Built | None" = None, ranks: "Ranks | None" = None,
    ):  # fmt: skip
        self.store, self.config, self.spec, self.stopping, self.built = store, config, spec, stopping, built
        self.ranks = ranks  # which others have started, and this process leads
        self.host, self.pid = socket.gethostname(), os.getpid()
        self.id = f"{self.host}:{self.pid}:{'+'.join(spec.kinds)}{spec.number}"
        self.status: dict[str, Any] = {"doing": "starting"}
        self.lease: Lease | None = None
        self.lease_lost = False
        self.unfit: str | None = None
        self.pace: Pace | None = None
        self.expendable = False  # while it compiles matches: a manager that wants to end it need not wait
        self._health = WorkerHealth(store, config.league, self.id, config.workers.max_attempts)
        self._patience = lock_wait.RetryReporter()
        self._rating = RatingJobs(self)
        self._loaded: dict[str, Any] = {}  # the trainer, as soon as it is needed
        self._league_state: LeagueState | None = None  # at the last look
        self._kept: dict[str, dict[str, str]] = {}  # group whose worlds are here -> its players' checkpoints
        self._preferred: str | None = None  # the turn to claim before older ones
        self._handlers: Mapping[type[Task], Callable[[Lease, Any], None]] = {
            TrainingTurn: self._train,
            RatingMatch: self._rating.play,
        }

    def run(self) -> None:
        """Claim jobs and do them until `stopping` is set."""
        heartbeat = Heartbeat(self)
        heartbeat.start()
        idle_since = time.monotonic()
        try:
            while not self.stopping.is_set():
                claimed = self.retry_while_away(self.claim)
                if claimed is not None:
                    self._run_job(*claimed)
                    idle_since = time.monotonic()
                elif not self.stopping.wait(IDLE):
                    self._rating.compile_early()
                    if time.monotonic() - idle_since > 2 * BEAT:
                        self.status = {"doing": "waiting"}
        finally:
            self.stopping.set()
            heartbeat.end()
            self._drop_trainer()
            none_on_error(self.store.remove_worker, self.id)

    def claim(self) -> tuple[Lease, Job] | None:
        """Claim the next job; None when there is nothing to do now."""
        config = self.config
        return self.store.claim(config.league, self.spec.kinds, self.id, config.workers.lease, prefer=self._preferred)

    def _run_job(self, lease: Lease, job: Job) -> None:
        """Do one job, to its end or to a clear failure. After a lost lease, another worker writes the result."""
        self.lease, self.lease_lost = lease, False
        try:
            task = decode(job)
            self._handlers[type(task)](lease, task)
            self._health.job_done()
        except LeaseLost:
            self.status = {"doing": "lost its lease"}
        except Unavailable as error:
            self._report_away(error)
            self.retry_while_away(lambda: self.store.release(lease))
            self.stopping.wait(AWAY)  # the store would be away for the next job as well
        except WrongBlobStore as error:
            self.retry_while_away(lambda: self.store.release(lease))
            self._stop_as_unfit(str(error))
        except StorageError as error:
            self._fail(lease, str(error))
        except TooLarge as error:
            self._fail(lease, str(error), tries=1)  # it would be too large again
            self._check_health(str(error), job.kind, surely_here=True)
        except Exception as error:
            import traceback

            reason = f"{type(error).__name__}: {error}"
            self._fail(lease, f"{reason}\n{traceback.format_exc()}")
            self._check_health(reason, job.kind, surely_here=isinstance(error, ImportError))
        finally:
            self.lease = None

    def _fail(self, lease: Lease, reason: str, tries: int | None = None) -> None:
        self.status = {"doing": f"failed: {reason.partition(chr(10))[0]}"}
        self.retry_while_away(lambda: self.store.fail(lease, reason, tries=tries or self.config.workers.max_attempts))

    def _check_health(self, reason: str, kind: str, surely_here: bool) -> None:
        if self._health.job_failed(kind, surely_here):
            self._stop_as_unfit(reason.partition("\n")[0])

    def _stop_as_unfit(self, reason: str) -> None:
        self.unfit = reason
        self.stopping.set()

    def _report_away(self, error: Unavailable) -> None:
        """Report that the store is away, on stderr and in the status."""
        self.status = {"doing": f"waiting: {error}"}
        self._patience.report(error)

    def retry_while_away(self, operation: Callable[[], R]) -> R | None:
        """Do an operation as soon as the store is there, without a time limit; None if the worker stops before."""
        while True:
            try:
                return operation()
            except Unavailable as error:
                self._report_away(error)
                if self.stopping.wait(AWAY):
                    return None

    # Training --------------------------------------------------------------------------------------------------------

    def _train(self, lease: Lease, turn: TrainingTurn) -> None:
        from league.training.setback import PlayerDiverged
        from league.training.trainer import Trainer

        trainer = self._trainer(turn)
        try:
            self._run_turn(trainer, turn)
            if self.lease_lost:
                raise LeaseLost(f"the lease of group {turn.group}'s turn")
            if self.config.deterministic and trainer.interrupted:
                self._drop_trainer()
                self.store.release(lease)  # a part of a turn would change all that follows
            else:
                self.retry_while_away(lambda: trainer.commit(self.store, lease, turn))
        except PlayerDiverged as error:
            self._drop_trainer()
            player, reason = error.player, str(error)
            self.status = {"doing": reason}
            self.retry_while_away(lambda: self.store.record_setback(lease, player, reason))
        except BaseException as error:
            self._drop_trainer()  # its state is unknown; that in the store is valid
            self._loaded.pop("programs", None)
            if is_short(error) and isinstance(trainer, Trainer):  # ranks have reported it themselves
                raise trainer.too_large() from error
            raise
        if not self.stopping.is_set():
            self._queue_next_turns(turn.group)

    def _queue_next_turns(self, group: str) -> None:
        """Queue the turns that follow that of a group, and choose which of those that wait to prefer.

        The manager queues them as well, but looks at the store only now and then. The plan is the same for both, and a
        job that both queue is queued once.
        """
        league, window = self.config.league, averaged_iterations(self.config)
        self._league_state = state = LeagueState.of(self.store, league, self._league_state, recent=window)
        following = next_turns(self.config, state)
        if "trainer" in self._loaded:  # else its worlds are gone
            self._kept[group] = {p.name: state.checkpoints[p.name].digest for p in state.groups[group]}
        self._preferred = continued_turn(self.config, state, following.jobs, self._kept, self._longest_episode())
        if following.jobs:
            self.store.queue(following.jobs, following.phases)

    def _longest_episode(self) -> int:
        """Return the decisions of the arena's longest episode; settings of an arena of your own need not tell them."""
        programs = self._loaded.get("programs")  # none where ranks have the arena
        return longest_episode(self.config) if programs is None else programs.arena.timing.decisions

    def _trainer(self, turn: TrainingTurn) -> "Trainer | DataParallelTrainer | RanksTrainer":
        if "trainer" not in self._loaded:
            self.status = {"doing": "compiling the training rollout", "learners": list(turn.learners)}
            self._loaded["trainer"] = self._new_trainer()
        return self._loaded["trainer"]

    def _new_trainer(self) -> "Trainer | DataParallelTrainer | RanksTrainer":
        if self.ranks is not None:
            from league.training.data_parallel.several_hosts import RanksTrainer

            return RanksTrainer(self.config, self.store, self.ranks)
        if self.config.training.devices > 1:
            from league.training.data_parallel.one_host import DataParallelTrainer

            return DataParallelTrainer(self.config, self.spec.run, self.spec.number)
        from league.system.arena_build import worlds as training_worlds
        from league.training.trainer import Trainer
        from league.training.training_programs import TrainingPrograms

        worlds = training_worlds(self.config)
        if "programs" not in self._loaded:
            self._loaded["programs"] = TrainingPrograms(self.config, self.arena(worlds))
        programs, players = self._loaded["programs"], self.store.players(self.config.league)
        return Trainer(self.config, programs.arena, players, worlds, programs=programs)

    def _drop_trainer(self) -> None:
        """Have the next turn make a new trainer; end the processes of this one."""
        trainer = self._loaded.pop("trainer", None)
        self._kept.clear()
        if trainer is not None and self.config.training.devices > 1:
            trainer.close()

    def _run_turn(self, trainer: "Trainer | DataParallelTrainer | RanksTrainer", turn: TrainingTurn) -> None:
        began = time.monotonic()
        for at in trainer.turn(self.store, turn, self._should_stop):
            began, before = time.monotonic(), began
            seconds, steps = at.trained
            self.status = {
                "doing": "training", "group": turn.group, "learners": list(turn.learners),
                "iteration": max(c.iteration for c in at.counters.values()), "steps": steps, "seconds": seconds,
                "steps_per_second": at.steps_per_second, "iteration_seconds": began - before,
            }  # fmt: skip

    def _should_stop(self) -> bool:
        return self.stopping.is_set() or self.lease_lost

    def arena(self, worlds: int) -> "Arena":
        """Return the league's arena for so many worlds; the present arena is reused if a new one would be equal."""
        from league.system.arena_build import build

        players = self.store.players(self.config.league)
        return (build if self.built is None else self.built.again)(self.config, worlds, players)
