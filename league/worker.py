"""A worker process: claim a job, do it, finish it, and say so all the while. Killed at any moment, it loses only work.

Nothing heavy is imported above: `work` first sets what jax, XLA and Warp read from the environment.
"""

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from league import environment
from storage.errors import LeaseLost, StorageError
from storage.records import Job, Lease
from storage.store import Store

if TYPE_CHECKING:
    from arenas.arena import Arena
    from league.config import Config

BEAT = 1.0  # seconds between two words of life
IDLE = 0.1  # seconds between two looks for work
NICE = 19  # a match worker lives on what the learner leaves idle


def work(where: str, config_text: str, kinds: tuple[str, ...], number: int) -> None:
    """Work on the jobs of these kinds until told to stop: by SIGTERM, by `league stop`, or by the parent's death."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the manager decides
    stopping = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stopping.set())
    if kinds == ("match",):
        os.nice(NICE)
    environment.prepare()
    import torch

    from league import config as configuration

    # Learning takes turns with physics, whose threads it would wake and wait for: on two cores an update takes 0.39 s
    # with one thread and 0.47 s with two, and the rollout after it 1.5 s instead of 1.9 s.
    torch.set_num_threads(max(1, (os.cpu_count() or 1) // 2))
    config = configuration.loads(config_text)
    try:
        with Store.open(where) as store:
            Worker(store, config, kinds, number, stopping).run()
    except (
        StorageError
    ) as error:  # the manager starts another one; a person needs the reason, not the place in the code
        print(f"league: {'+'.join(kinds)} worker: {error}", file=sys.stderr, flush=True)
        sys.exit(2)


class Worker:
    """One process's loop over leases. Arena, learners and compiled matches stay in memory between jobs."""

    def __init__(self, store: Store, config: "Config", kinds: tuple[str, ...], number: int, stopping: threading.Event):
        self.store, self.config, self.kinds, self.stopping = store, config, kinds, stopping
        self.host, self.pid, self.parent = socket.gethostname(), os.getpid(), os.getppid()
        self.id = f"{self.host}:{self.pid}:{'+'.join(kinds)}{number}"
        self.status: dict[str, Any] = {"doing": "starting"}
        self.lease: Lease | None = None
        self._lost = False
        self._heavy: dict[str, Any] = {}

    def run(self) -> None:
        """Claim and work until told to stop."""
        beating = threading.Thread(target=self._beat, name="heartbeat", daemon=True)
        beating.start()
        idle_since = time.monotonic()
        try:
            while not self.stopping.is_set():
                claimed = self.store.claim(self.config.league, self.kinds, self.id, self.config.workers.lease)
                if claimed is not None:
                    self._do(*claimed)
                    idle_since = time.monotonic()
                elif not self.stopping.wait(IDLE) and time.monotonic() - idle_since > 2 * BEAT:
                    self.status = {"doing": "waiting"}
        finally:
            self.stopping.set()
            beating.join(timeout=2 * BEAT)
            self.store.leave(self.id)

    def _do(self, lease: Lease, job: Job) -> None:
        """One job, to its end or to a clear failure; a lost lease means that the result is somebody else's to write."""
        self.lease, self._lost = lease, False
        try:
            {"train": self._train, "match": self._match}[job.kind](lease, job)
        except LeaseLost:
            self.status = {"doing": "lost its lease"}
        except StorageError as error:
            self.store.fail(lease, str(error))
        except Exception as error:
            import traceback

            self.store.fail(lease, f"{type(error).__name__}: {error}\n{traceback.format_exc()}")
        finally:
            self.lease = None

    def _train(self, lease: Lease, job: Job) -> None:
        from league.lineup import Turn
        from league.train import Trainer

        turn = Turn.of(job.payload)
        players = self.store.players(self.config.league)
        names = [players[t].name for t in turn.learners]
        if "trainer" not in self._heavy:
            self.status = {"doing": "compiling the training rollout", "learners": names}
            self._heavy["trainer"] = Trainer(self.config, self._arena(self.config.training.worlds), players)
        trainer: Trainer = self._heavy["trainer"]
        try:
            for at in trainer.turn(self.store, turn, self._halt):
                self.status = {
                    "doing": "training", "learners": names, "iteration": at.counters.iteration,
                    "steps": at.counters.steps, "seconds": at.counters.seconds,
                    "steps_per_second": at.steps_per_second, "diagnostics": at.diagnostics,
                }  # fmt: skip
            if self._lost:
                raise LeaseLost(job.key)
            if self.config.deterministic and trainer.counters.iteration < turn.last:
                self._give_back(lease)  # a part of a turn would change all that follows
            else:
                trainer.commit(self.store, lease, turn)
        except BaseException:
            self._heavy.pop("trainer", None)  # it may stand anywhere; the store knows better
            raise

    def _match(self, lease: Lease, job: Job) -> None:
        from league.evaluate import Referee, pairs_of

        pairs = pairs_of(job.payload)
        self.status = {"doing": "rating", "pairs": len(pairs)}
        if "referee" not in self._heavy:
            self.status = {"doing": "compiling matches"}
            self._heavy["referee"] = Referee(self.config, self._arena(self.config.rating.worlds), self.config.league)
        referee: Referee = self._heavy["referee"]
        matches = referee.play(self.store, pairs, job.payload["seed"])
        self.store.finish(lease, matches=matches)

    def _arena(self, worlds: int) -> "Arena":
        """The league's arena for so many worlds; a GPU's buffers depend on their number."""
        config = self.config
        return config.arena.build(engine=config.engine, worlds=worlds, threads=config.workers.threads)

    def _give_back(self, lease: Lease) -> None:
        del self._heavy["trainer"]
        self.store.release(lease)

    def _halt(self) -> bool:
        return self.stopping.is_set() or self._lost

    def _beat(self) -> None:
        """Say every second what is being done, keep the lease alive, and notice when it is time to stop."""
        started = self.store.now()
        renewed = time.monotonic()
        while not self.stopping.wait(BEAT):
            if os.getppid() != self.parent:  # the manager was killed: what is under way is finished and committed
                self.stopping.set()
            kinds = "+".join(self.kinds)
            self._quietly(self.store.beat, self.id, self.config.league, kinds, self.pid, self.host, self.status)
            if self._quietly(self.store.stop_asked, self.config.league, started):
                self.stopping.set()
            lease = self.lease
            if lease is not None and time.monotonic() - renewed > self.config.workers.lease / 4:
                renewed = time.monotonic()
                if self._quietly(self.store.renew, lease, self.config.workers.lease) is False:
                    self._lost = self.lease == lease

    @staticmethod
    def _quietly(verb: Callable[..., Any], *args: Any) -> Any:
        """A store that is busy or away for a moment does not end the work; the lease's expiry settles the rest."""
        try:
            return verb(*args)
        except StorageError:
            return None
