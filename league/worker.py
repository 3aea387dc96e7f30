"""A worker process: claim a job, do it, finish it, and say so all the while. Killed at any moment, it loses only work.

Nothing heavy is imported above: `work` first sets what jax, XLA and Warp read from the environment. What goes wrong is
one of two kinds: the store is away for a while, which is waited for; or this job cannot be done here, which is told to
the store, so that it is tried again and then set aside.
"""

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

from arenas.cores import cores
from league import devices, environment
from league.config import experiment as configuration
from league.jobs import RatingMatch, Task, TrainingTurn, decode
from league.memory import TooLarge, is_short
from league.plan import next_turns
from league.standing import Standing
from storage.errors import Away, LeaseLost, StorageError
from storage.records import Job, Lease
from storage.store import Store

if TYPE_CHECKING:
    from arenas.arena import Arena
    from league.evaluate import Referee
    from league.examine import Built
    from league.ranks import Ranks
    from league.train import Trainer

BEAT = 1.0  # seconds between two words of life
IDLE = 0.1  # seconds between two looks for work
AWAY = 1.0  # seconds between two tries of a store that is away

R = TypeVar("R")


@dataclass(frozen=True)
class Post:
    """Where a worker works: everything that its process is told."""

    store: str
    blobs: str | None
    config: str  # TOML
    kinds: tuple[str, ...]  # of jobs that it takes
    number: int  # among the workers of these kinds
    parent: int | None  # process id of its manager: it ends when that one is gone
    devices: int = 1  # that its jobs use; where they are several, processes of its own take them
    leader: str = ""  # without a parent: who leads the league; it ends when that one does so no longer


def work(post: Post, built: "Built | None" = None) -> None:
    """Work on the jobs of these kinds until told to stop: by SIGTERM, by `league stop`, or by its manager's end.

    A worker with a parent leaves Ctrl-C to that one; of one without, the first is a SIGTERM and the second its end.
    """
    stopping = threading.Event()

    def interrupted(number: int, frame: object) -> None:
        if stopping.is_set():
            os._exit(130)
        stopping.set()

    signal.signal(signal.SIGTERM, lambda *_: stopping.set())
    signal.signal(signal.SIGINT, interrupted if post.parent is None else signal.SIG_IGN)
    if post.devices == 1:
        devices.take(post.number)
    environment.prepare()
    config = configuration.loads(post.config)
    if post.kinds == (RatingMatch.kind,):  # it lives on what the learner leaves idle
        os.nice(config.workers.nice)
    import torch

    # Learning takes turns with physics, whose threads it would wake and wait for: on two cores an update takes 0.39 s
    # with one thread and 0.47 s with two, and the rollout after it 1.5 s instead of 1.9 s.
    torch.set_num_threads(max(1, cores() // 2))
    try:
        with Store.open(post.store, blobs=post.blobs) as store:
            Worker(store, config, post, stopping, built).run()
    except StorageError as error:  # the manager starts another one; a person needs the reason, not a traceback
        print(f"league: {'+'.join(post.kinds)} worker: {error}", file=sys.stderr, flush=True)
        sys.exit(2)


class Worker:
    """One process's loop over leases. Arena, learners and compiled matches stay in memory between jobs."""

    def __init__(
        self, store: Store, config: configuration.Config, post: Post, stopping: threading.Event,
        built: "Built | None" = None,
    ):  # fmt: skip
        self.store, self.config, self.post, self.stopping, self.built = store, config, post, stopping, built
        self.host, self.pid = socket.gethostname(), os.getpid()
        self.id = f"{self.host}:{self.pid}:{'+'.join(post.kinds)}{post.number}"
        self.status: dict[str, Any] = {"doing": "starting"}
        self.lease: Lease | None = None
        self._lost = False
        self._ended = threading.Event()
        self._heavy: dict[str, Any] = {}
        self._standing: Standing | None = None  # when it was looked at last
        self._handlers: Mapping[type[Task], Callable[[Lease, Any], None]] = {
            TrainingTurn: self._train,
            RatingMatch: self._match,
        }

    def run(self) -> None:
        """Claim and work until told to stop."""
        beating = threading.Thread(target=self._beat, name="heartbeat", daemon=True)
        beating.start()
        idle_since = time.monotonic()
        league, seconds = self.config.league, self.config.workers.lease
        try:
            while not self.stopping.is_set():
                claimed = self._patiently(lambda: self.store.claim(league, self.post.kinds, self.id, seconds))
                if claimed is not None:
                    self._do(*claimed)
                    idle_since = time.monotonic()
                elif not self.stopping.wait(IDLE) and time.monotonic() - idle_since > 2 * BEAT:
                    self.status = {"doing": "waiting"}
        finally:
            self.stopping.set()
            self._ended.set()
            beating.join(timeout=2 * BEAT)
            self._drop_trainer()
            _quietly(self.store.leave, self.id)

    def _do(self, lease: Lease, job: Job) -> None:
        """One job, to its end or to a clear failure; a lost lease means that the result is somebody else's to write."""
        self.lease, self._lost = lease, False
        try:
            task = decode(job)
            self._handlers[type(task)](lease, task)
        except LeaseLost:
            self.status = {"doing": "lost its lease"}
        except Away as error:
            self.status = {"doing": f"waiting: {error}"}
            self._patiently(lambda: self.store.release(lease))
        except StorageError as error:
            self._fail(lease, str(error))
        except TooLarge as error:
            self._fail(lease, str(error), tries=1)  # it would be too large again
        except Exception as error:
            import traceback

            self._fail(lease, f"{type(error).__name__}: {error}\n{traceback.format_exc()}")
        finally:
            self.lease = None

    def _fail(self, lease: Lease, reason: str, tries: int | None = None) -> None:
        self.status = {"doing": f"failed: {reason.partition(chr(10))[0]}"}
        self._patiently(lambda: self.store.fail(lease, reason, tries=tries or self.config.workers.tries))

    def _patiently(self, verb: Callable[[], R]) -> R | None:
        """Do it as soon as the store is there, however long that takes; None if it is time to stop before."""
        while True:
            try:
                return verb()
            except Away as error:
                self.status = {"doing": f"waiting: {error}"}
                if self.stopping.wait(AWAY):
                    return None

    # Training --------------------------------------------------------------------------------------------------------

    def _train(self, lease: Lease, turn: TrainingTurn) -> None:
        from league.train import PlayerDiverged, Trainer

        trainer = self._trainer(turn)
        try:
            self._learn(trainer, turn)
            if self._lost:
                raise LeaseLost(f"the lease of group {turn.group}'s turn")
            if self.config.deterministic and trainer.interrupted:
                self._drop_trainer()
                self.store.release(lease)  # a part of a turn would change all that follows
            else:
                self._patiently(lambda: trainer.commit(self.store, lease, turn))
        except PlayerDiverged as error:
            self._drop_trainer()
            player, reason = error.player, str(error)
            self.status = {"doing": reason}
            self._patiently(lambda: self.store.setback(lease, player, reason))
        except BaseException as error:
            self._drop_trainer()  # it may stand anywhere; the store knows better
            if is_short(error) and isinstance(trainer, Trainer):  # ranks have said so themselves
                raise trainer.too_large() from error
            raise
        if not self.stopping.is_set():
            self._ask_on()

    def _ask_on(self) -> None:
        """Ask the plan what follows a turn, as the manager does: that one looks at the store only now and then.

        The plan says the same to both, and what both of them queue is queued once.
        """
        league, window = self.config.league, self.config.budget.window
        self._standing = Standing.of(self.store, league, self._standing, recent=window)
        following = next_turns(self.config, self._standing)
        if following.jobs:
            self.store.queue(following.jobs, following.phases)

    def _trainer(self, turn: TrainingTurn) -> "Trainer | Ranks":
        if "trainer" not in self._heavy:
            self.status = {"doing": "compiling the training rollout", "learners": list(turn.learners)}
            self._heavy["trainer"] = self._new_trainer()
        return self._heavy["trainer"]

    def _new_trainer(self) -> "Trainer | Ranks":
        if self.config.training.devices > 1:
            from league.ranks import Ranks

            return Ranks(self.config, self.post.store, self.post.number)
        from league.examine import worlds as training_worlds
        from league.train import Trainer

        worlds = training_worlds(self.config)
        return Trainer(self.config, self._arena(worlds), self.store.players(self.config.league), worlds)

    def _drop_trainer(self) -> None:
        """The next turn has a new one; processes behind it end."""
        trainer = self._heavy.pop("trainer", None)
        if trainer is not None and self.config.training.devices > 1:
            trainer.close()

    def _learn(self, trainer: "Trainer | Ranks", turn: TrainingTurn) -> None:
        for at in trainer.turn(self.store, turn, self._halt):
            furthest = max(at.counters.values(), key=lambda c: c.iteration)
            self.status = {
                "doing": "training", "group": turn.group, "learners": list(turn.learners),
                "iteration": furthest.iteration, "steps": furthest.steps, "seconds": furthest.seconds,
                "steps_per_second": at.steps_per_second,
            }  # fmt: skip

    # Rating ----------------------------------------------------------------------------------------------------------

    def _match(self, lease: Lease, task: RatingMatch) -> None:
        referee = self._referee()
        self.status, began = {**self.status, "doing": "rating", "pairs": len(task.pairs)}, time.monotonic()
        found = referee.play(self.store, task)
        rate = sum(match.steps for match in found) / (time.monotonic() - began)
        self.status = {**self.status, "steps_per_second": rate}  # anew, for the other thread reads it
        matches = [replace(match, seconds=referee.seconds / len(found), due=task.due) for match in found]
        self._patiently(lambda: self.store.finish(lease, matches=matches))

    def _referee(self) -> "Referee":
        from league.evaluate import Referee

        if "referee" not in self._heavy:
            self.status = {"doing": "compiling matches"}
            self._heavy["referee"] = Referee(self.config, self._arena(self.config.rating.worlds), self.config.league)
        return self._heavy["referee"]

    def _arena(self, worlds: int) -> "Arena":
        """The league's arena for so many worlds: the one that is there, if a new one would be the same."""
        from league.examine import build

        return build(self.config, worlds) if self.built is None else self.built.again(self.config, worlds)

    # The other thread ------------------------------------------------------------------------------------------------

    def _halt(self) -> bool:
        return self.stopping.is_set() or self._lost

    def _beat(self) -> None:
        """Say every second what is being done, keep the lease alive, and notice when it is time to stop.

        It goes on while what is under way is finished after a stop. A store that is away for a moment does not end
        this thread; the lease's expiry settles the rest.
        """
        started: float | None = None
        renewed = time.monotonic()
        kinds, league = "+".join(self.post.kinds), self.config.league
        while not self._ended.wait(BEAT):
            if self._left_alone():  # what is under way is finished and committed
                self.stopping.set()
            if started is None:
                started = _quietly(self.store.now)
            _quietly(self.store.beat, self.id, league, kinds, self.pid, self.host, self.status)
            if started is not None and _quietly(self.store.stop_asked, league, started):
                self.stopping.set()
            lease = self.lease
            if lease is not None and time.monotonic() - renewed > self.config.workers.lease / 4:
                renewed = time.monotonic()
                if _quietly(self.store.renew, lease, self.config.workers.lease) is False:
                    self._lost = self.lease == lease

    def _left_alone(self) -> bool:
        """Whether its manager is gone; one of another host, as far as a store that is there can tell."""
        if self.post.parent is not None:
            return os.getppid() != self.post.parent
        with suppress(StorageError):
            return (self.store.leader(self.config.league) or ("",))[0] != self.post.leader
        return False


def _quietly(verb: Callable[..., R], *args: Any) -> R | None:
    try:
        return verb(*args)
    except StorageError:
        return None
