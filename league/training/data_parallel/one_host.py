"""Data-parallel training: a turn spread over several devices, with one process for each.

The train worker that holds the lease starts and ends these processes, and has no device itself. Each *rank* has a GPU,
a trainer with its part of the worlds, and the store to read from; rank 0 also writes. The worker handles lease, retries
and stop, as for any job. A failure shows in one of two ways: a rank sends an error, or its pipe closes. In both cases
the worker kills all ranks, since work that is not in the store was not done yet. A rank ends by itself as soon as its
worker is gone, even during work.

These ranks are on one host, and need no torchrun: it restarts failed ranks, as the store's leases already do, and its
ranks outlive it if it is killed. `several_hosts.py` has ranks that torchrun or srun has started.
"""

import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING, Any

from arenas.physics.cpu import cores
from league.config.experiment import Config
from league.config.run_spec import RunSpec
from league.state.jobs import TrainingTurn
from league.state.team_exchange import as_made
from league.system import devices, environment
from league.system.memory import TooLarge, is_short
from storage.errors import StorageError
from storage.records import Lease
from storage.store import Store

if TYPE_CHECKING:
    from agents.devices.distributed import Communicator
    from league.training.trainer import Progress, Trainer

TICK = 0.2  # seconds between two checks for a stop
STOP = "stop"


@dataclass(frozen=True)
class RankSpec:
    """The values that the process of a rank receives."""

    run: RunSpec
    worker: int  # among the train workers
    rank: int
    size: int
    port: int  # at which the ranks meet

    @property
    def device(self) -> int:
        """The GPU's number; the GPUs of a worker have consecutive numbers."""
        return self.worker * self.size + self.rank


class RankDied(RuntimeError):  # noqa: N818  (a sentence: "a rank died")
    """An error for a rank's process that ended by itself, or was killed."""


class DataParallelTrainer:
    """A trainer with the methods of `Trainer` that a worker uses, and with processes that do the work.

    After `turn` has raised, only `close` may be called.
    """

    def __init__(self, config: Config, run: RunSpec, worker: int):
        from agents.devices.distributed import rendezvous

        self.interrupted = False  # as in Trainer
        self._meeting = rendezvous()
        size = config.training.devices
        self._ranks = [_RankProcess(RankSpec(run, worker, rank, size, self._meeting.port)) for rank in range(size)]

    def turn(self, store: Store, turn: TrainingTurn, stop: Callable[[], bool]) -> "Iterator[Progress]":
        """Do `Trainer.turn` on each rank, and yield what rank 0 yields. Raises what a rank raised, or RankDied."""
        for rank in self._ranks:
            rank.send("turn", turn)
        waiting, sent_stop = set(self._ranks), False
        while waiting:
            if not sent_stop and stop():
                sent_stop = True
                self._ranks[0].send(STOP)
            for rank, (what, value) in self._received(waiting):
                if what == "progress":
                    yield value
                else:
                    self.interrupted = value
                    waiting.discard(rank)

    def commit(self, store: Store, lease: Lease, turn: TrainingTurn) -> None:
        """Do `Trainer.commit` on rank 0; if it raises Unavailable, it can be called again."""
        self._ranks[0].send("commit", lease, turn)
        while not self._received(self._ranks[:1]):
            pass

    def close(self) -> None:
        """Kill all ranks, even during work."""
        for rank in self._ranks:
            rank.close()

    def _received(self, ranks: "Collection[_RankProcess]") -> "list[tuple[_RankProcess, tuple[str, Any]]]":
        """Return the messages that arrive within a tick.

        Raises what a rank raised; RankDied first, since the death of one rank causes errors of the others.
        """
        ready = wait([rank.pipe for rank in ranks], TICK)
        messages = [(rank, rank.receive()) for rank in ranks if rank.pipe in ready]
        errors = [error for _, (what, error) in messages if what == "raised"]
        if errors:
            raise min(errors, key=lambda error: not isinstance(error, RankDied))
        return messages


class _RankProcess:
    """The process of a rank and the pipe to it."""

    def __init__(self, spec: RankSpec):
        context = multiprocessing.get_context("spawn")
        self.spec = spec
        self.pipe, other_end = context.Pipe()
        self.process = context.Process(target=serve, args=(spec, other_end))
        self.process.start()
        other_end.close()  # then this end notices when the process is gone

    def send(self, *order: Any) -> None:
        """Send an order. If the process has ended, raises the error that it sent last, or RankDied."""
        try:
            self.pipe.send(order)
        except OSError:
            _, error = self.receive()
            raise error from None

    def receive(self) -> tuple[str, Any]:
        """Return a message, (what, value): progress and an iteration's, done and the result, raised and the error."""
        try:
            what, value = self.pipe.recv()
        except (EOFError, OSError):
            return "raised", self._died()
        return what, _from_message(*value) if what == "raised" else value

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self.pipe.close()

    def _died(self) -> RankDied:
        self.process.join()
        return RankDied(f"rank {self.spec.rank} of {self.spec.size} died (exit code {self.process.exitcode})")


# In a rank's process -------------------------------------------------------------------------------------------------


def serve(spec: RankSpec, pipe: Connection) -> None:
    """Do the orders that come through the pipe until the worker is gone."""
    for number in (signal.SIGINT, signal.SIGTERM):  # they may reach the whole group; the worker decides
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_worker, name="worker watch", daemon=True).start()
    devices.take(spec.device)
    environment.prepare()
    try:
        with Store.open(spec.run.store, blobs=spec.run.blobs) as store:
            _obey(store, _trainer(store, spec), pipe)
    except Exception as error:
        with suppress(OSError):  # the worker is gone
            pipe.send(("raised", _as_message(error, spec.rank)))
    os._exit(0)  # without the exit handlers of libraries, which may wait for other ranks


def _end_with_worker() -> None:
    """End this process when its worker is gone, even during a wait, since no other process would end it."""
    worker = multiprocessing.parent_process()
    assert worker is not None
    wait([worker.sentinel])
    os._exit(0)


def _trainer(store: Store, spec: RankSpec) -> "Trainer":
    """Return the rank's trainer, once all ranks are there."""
    config = spec.run.config()
    import torch

    from agents.devices.distributed import join

    torch.set_num_threads(max(1, cores() // spec.size // 2))  # as in a worker
    return rank_trainer(store, config, join(spec.rank, spec.size, spec.port, on_gpus(config)))


def on_gpus(config: Config) -> bool:
    """Return whether a rank learns on a GPU here. Loads torch."""
    return config.training.device != "cpu" and devices.torch_has_cuda()


def rank_trainer(store: Store, config: Config, comm: "Communicator") -> "Trainer":
    """Return the trainer of a rank, with its part of the worlds. Raises StorageError."""
    from league.system.arena_build import worlds as training_worlds
    from league.training.trainer import Trainer

    worlds = training_worlds(config)
    arena = config.arena.build(
        engine=config.engine, worlds=worlds // comm.size, threads=config.workers.threads or cores,
        **config.buffers.where(),
    )  # fmt: skip
    players = store.players(config.league)
    return Trainer(config, as_made(arena, players), players, worlds, comm)


def _obey(store: Store, trainer: "Trainer", pipe: Connection) -> None:
    """Do each order, and send its result."""

    def stop() -> bool:
        return pipe.poll() and pipe.recv() == (STOP,)

    while True:
        try:
            order, *about = pipe.recv()
        except EOFError:
            return
        try:
            if order == "turn":
                (turn,) = about
                for at in trainer.turn(store, turn, stop):
                    if trainer.comm.rank == 0:
                        pipe.send(("progress", at))
                pipe.send(("done", trainer.interrupted))
            elif order == "commit":
                lease, turn = about
                trainer.commit(store, lease, turn)
                pipe.send(("done", None))
            # Any other order is a stop that arrived after the end of the turn.
        except Exception as error:
            shown = trainer.too_large() if is_short(error) else error
            pipe.send(("raised", _as_message(shown, trainer.comm.rank)))


def _as_message(error: Exception, rank: int) -> tuple[type[Exception], tuple, dict[str, Any]]:
    """Return an error in a form for another process; if that process may not know its class, as text."""
    from league.training.setback import PlayerDiverged

    if isinstance(error, StorageError | PlayerDiverged | TooLarge):
        return type(error), error.args, vars(error)
    return RuntimeError, (f"rank {rank}: {type(error).__name__}: {error}\n{traceback.format_exc()}",), {}


def _from_message(kind: type[Exception], args: tuple, more: Mapping[str, Any]) -> Exception:
    """Return the error given to `_as_message`. Its constructor is not called, because it would add text again."""
    error = kind.__new__(kind, *args)
    error.__dict__.update(more)
    return error
