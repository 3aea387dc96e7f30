"""A turn spread over several devices: a process for each, which the train worker that holds the lease starts and ends.

The worker leads and owns no device. Each *rank* has a GPU, a trainer with its part of the worlds, and the store to read
from; rank 0 also writes. Lease, retries and stop are the worker's, as for any job, and what goes wrong is so in one of
two ways: a rank tells what it met, or its line goes dead. In both the worker kills all ranks, for nothing that is not
in the store was done yet. A rank ends by itself as soon as its worker is gone, wherever it stands.

These processes are ours rather than torchrun's: that one restarts what fails, which the store's leases already do, and
its ranks outlive it where it is killed.
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

from arenas.cores import cores
from league import devices, environment
from league.config import experiment as configuration
from league.config.experiment import Config
from league.jobs import TrainingTurn
from league.memory import TooLarge, is_short
from storage.errors import StorageError
from storage.records import Lease
from storage.store import Store

if TYPE_CHECKING:
    from league.train import Progress, Trainer

TICK = 0.2  # seconds between two looks whether it is time to stop
STOP = "stop"


@dataclass(frozen=True)
class Place:
    """What a rank's process is told."""

    store: str
    blobs: str | None
    config: str  # TOML
    worker: int  # among the train workers
    rank: int
    size: int
    port: int  # where the ranks meet

    @property
    def device(self) -> int:
        """The GPU's number: those of a worker lie side by side."""
        return self.worker * self.size + self.rank


class RankDied(RuntimeError):  # noqa: N818  (a sentence: "a rank died")
    """A rank's process ended by itself, or was killed."""


class Ranks:
    """To a worker what `Trainer` is, with processes behind it. Once `turn` has raised it is good for `close` alone."""

    def __init__(self, config: Config, store: str, worker: int):
        from agents.parallel import meeting_place

        self.interrupted = False  # as in Trainer
        self._meeting = meeting_place()
        size, text = config.training.devices, configuration.dumps(config)
        self._lines = [
            _Line(Place(store, config.storage.blobs, text, worker, rank, size, self._meeting.port))
            for rank in range(size)
        ]

    def turn(self, store: Store, turn: TrainingTurn, stop: Callable[[], bool]) -> "Iterator[Progress]":
        """`Trainer.turn` on every rank; yields what rank 0 does. Raises what a rank did, or RankDied."""
        for line in self._lines:
            line.tell("turn", turn)
        waiting, told = set(self._lines), False
        while waiting:
            if not told and stop():
                told = True
                self._lines[0].tell(STOP)
            for line, (what, said) in self._heard(waiting):
                if what == "progress":
                    yield said
                else:
                    self.interrupted = said
                    waiting.discard(line)

    def commit(self, store: Store, lease: Lease, turn: TrainingTurn) -> None:
        """`Trainer.commit` on rank 0; where it raises Away it can be called again."""
        self._lines[0].tell("commit", lease, turn)
        while not self._heard(self._lines[:1]):
            pass

    def close(self) -> None:
        """End all ranks, whatever they do."""
        for line in self._lines:
            line.close()

    def _heard(self, lines: "Collection[_Line]") -> "list[tuple[_Line, tuple[str, Any]]]":
        """What was said within a tick. Raises what was raised; that a rank died rather than what others met by it."""
        ready = wait([line.pipe for line in lines], TICK)
        said = [(line, line.hear()) for line in lines if line.pipe in ready]
        errors = [error for _, (what, error) in said if what == "raised"]
        if errors:
            raise min(errors, key=lambda error: not isinstance(error, RankDied))
        return said


class _Line:
    """A rank's process and the pipe to it."""

    def __init__(self, place: Place):
        context = multiprocessing.get_context("spawn")
        self.place = place
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=serve, args=(place, theirs))
        self.process.start()
        theirs.close()  # so that this end hears when the process is gone

    def tell(self, *order: Any) -> None:
        """Give an order. Raises RankDied where nobody is there to take it, or what was said last."""
        try:
            self.pipe.send(order)
        except OSError:
            _, error = self.hear()
            raise error from None

    def hear(self) -> tuple[str, Any]:
        """What and its value: progress of an iteration, done and what it gave, raised and the error."""
        try:
            what, value = self.pipe.recv()
        except (EOFError, OSError):
            return "raised", self._died()
        return what, _rebuilt(*value) if what == "raised" else value

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self.pipe.close()

    def _died(self) -> RankDied:
        self.process.join()
        return RankDied(f"rank {self.place.rank} of {self.place.size} died (exit code {self.process.exitcode})")


# In a rank's process -------------------------------------------------------------------------------------------------


def serve(place: Place, pipe: Connection) -> None:
    """Be a rank: obey orders until the worker is gone."""
    for number in (signal.SIGINT, signal.SIGTERM):  # they may reach the whole group; the worker decides
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_worker, name="worker watch", daemon=True).start()
    devices.take(place.device)
    environment.prepare()
    try:
        with Store.open(place.store, blobs=place.blobs) as store:
            _obey(store, _trainer(store, place), pipe)
    except Exception as error:
        with suppress(OSError):  # nobody is there to hear it
            pipe.send(("raised", _taken_apart(error, place.rank)))
    os._exit(0)  # libraries that still wait for other ranks are not asked


def _end_with_worker() -> None:
    """Whatever this process waits for: without its worker nobody would end it."""
    worker = multiprocessing.parent_process()
    assert worker is not None
    wait([worker.sentinel])
    os._exit(0)


def _trainer(store: Store, place: Place) -> "Trainer":
    """The rank's trainer, once all ranks are there."""
    config = configuration.loads(place.config)
    import torch

    from agents.parallel import join
    from league.examine import worlds as training_worlds
    from league.train import Trainer

    torch.set_num_threads(max(1, cores() // place.size // 2))  # as in a worker
    on_gpus = config.training.device != "cpu" and torch.cuda.is_available()
    together, worlds = join(place.rank, place.size, place.port, on_gpus), training_worlds(config)
    arena = config.arena.build(
        engine=config.engine, worlds=worlds // place.size, threads=config.workers.threads or cores
    )  # fmt: skip
    return Trainer(config, arena, store.players(config.league), worlds, together)


def _obey(store: Store, trainer: "Trainer", pipe: Connection) -> None:
    """Do what is asked, and tell what came of it."""

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
                    if trainer.together.rank == 0:
                        pipe.send(("progress", at))
                pipe.send(("done", trainer.interrupted))
            elif order == "commit":
                lease, turn = about
                trainer.commit(store, lease, turn)
                pipe.send(("done", None))
            # Else it is the word to stop, which came when the turn was over.
        except Exception as error:
            told = trainer.too_large() if is_short(error) else error
            pipe.send(("raised", _taken_apart(told, trainer.together.rank)))


def _taken_apart(error: Exception, rank: int) -> tuple[type[Exception], tuple, dict[str, Any]]:
    """An error on its way to another process; what only this one knows of goes as its text."""
    from league.train import PlayerDiverged

    if isinstance(error, StorageError | PlayerDiverged | TooLarge):
        return type(error), error.args, vars(error)
    return RuntimeError, (f"rank {rank}: {type(error).__name__}: {error}\n{traceback.format_exc()}",), {}


def _rebuilt(kind: type[Exception], args: tuple, more: Mapping[str, Any]) -> Exception:
    """The error as it was, past the constructor that has worded it."""
    error = kind.__new__(kind, *args)
    error.__dict__.update(more)
    return error
