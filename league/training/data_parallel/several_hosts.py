"""A turn spread over ranks that torchrun or srun has started, on one host or on several.

Every rank has a trainer in its own process. Rank 0 is also the worker: it holds the lease, writes, and gives orders to
the others in the keys of their meeting. An order needs no answer in time, so a rank may wait for one however long the
league has nothing to learn. When a rank fails, work that is not in the store was not done yet: all ranks end, and
whatever started them starts them again.
"""

import json
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import TYPE_CHECKING

from agents.devices.distributed import TIMEOUT, Communicator
from agents.devices.rendezvous import POLL, Meeting, RanksError
from league.config.experiment import Config
from league.state.jobs import TrainingTurn, decode, encode
from league.system.memory import TooLarge, is_short
from league.training.data_parallel.one_host import RankDied, rank_trainer
from league.training.setback import PlayerDiverged
from storage.errors import StorageError, Unavailable
from storage.records import Job, Lease
from storage.store import Store

if TYPE_CHECKING:
    from league.training.trainer import Progress, Trainer

MAKE, TURN, END = "make", "turn", "end"
LAST_WORDS = 1.0  # seconds in which a rank that has ended may still be heard
PARTING = 10.0  # seconds that rank 0 waits at the end until the others have heard of it
REASONS: dict[str, Callable[[str], Exception]] = {"TooLarge": TooLarge, "Unavailable": Unavailable}
"""Errors of another rank that rank 0 raises as its own."""


class Ranks:
    """The ranks as rank 0 leads them. `broken` is the reason for which they can do nothing more together."""

    def __init__(self, meeting: Meeting, comm: Communicator, stopping: threading.Event):
        self.comm = comm
        self.broken = ""
        self._meeting, self._stopping = meeting, stopping
        self._orders = 0

    def order(self, what: str, about: object = None) -> None:
        """Give the other ranks an order, once they have done the one before. Raises the error for which one left."""
        try:
            self._finish(TIMEOUT.total_seconds())
            self._orders += 1
            self._meeting.tell("order", json.dumps([self._orders, what, about]))
        except Exception as error:
            raise self.broke(error) from error

    def end(self) -> None:
        """Have the other ranks end in good order."""
        self.order(END)
        with suppress(RuntimeError):
            self._finish(PARTING)

    def broke(self, error: Exception) -> Exception:
        """Have this worker end, since its ranks are no longer in step; return the error that tells why."""
        found = error
        if isinstance(error, RuntimeError) and not isinstance(error, RankDied):
            with suppress(RuntimeError):  # the table of keys is gone too
                found = self._last_words() or RankDied(f"the ranks have lost each other: {first_line(error)}")
        self.broken = self.broken or first_line(found)
        self._stopping.set()
        return found

    def _finish(self, limit: float) -> None:
        """Wait until all ranks have done the last order. Raises the error for which one left, and RankDied."""
        deadline = time.monotonic() + limit
        for rank in range(1, self.comm.size):
            while int(self._meeting.told(f"done/{rank}") or 0) < self._orders:
                if (left := self._left()) is not None:
                    raise left
                if time.monotonic() > deadline:
                    raise RankDied(f"rank {rank} of {self.comm.size} did not answer within {limit:g} s")
                time.sleep(POLL)

    def _last_words(self) -> Exception | None:
        """Return the error for which a rank has left; its note may arrive after the end of its connections."""
        deadline = time.monotonic() + LAST_WORDS
        while (left := self._left()) is None and time.monotonic() < deadline:
            time.sleep(POLL)
        return left

    def _left(self) -> Exception | None:
        """Return the error for which a rank has left, if one has said so."""
        for rank in range(1, self.comm.size):
            if (told := self._meeting.told(f"left/{rank}")) is not None:
                kind, text = json.loads(told)
                return REASONS.get(kind, RankDied)(f"rank {rank} of {self.comm.size} left: {text}")
        return None


class RanksTrainer:
    """A trainer with the methods of `Trainer` that a worker uses, which has the other ranks do the same."""

    def __init__(self, config: Config, store: Store, ranks: Ranks):
        self._league, self._ranks = config.league, ranks
        ranks.order(MAKE)
        self._trainer = rank_trainer(store, config, ranks.comm)

    @property
    def interrupted(self) -> bool:
        """True if the last turn was stopped before its end."""
        return self._trainer.interrupted

    def turn(self, store: Store, turn: TrainingTurn, stop: Callable[[], bool]) -> "Iterator[Progress]":
        """Do `Trainer.turn` on all ranks. Raises PlayerDiverged; any other error ends the ranks."""
        self._ranks.order(TURN, encode(self._league, turn, "").payload)
        try:
            yield from self._trainer.turn(store, turn, stop)
        except PlayerDiverged:
            raise  # on all ranks, since it depends on sums over them
        except Exception as error:
            raise self._ranks.broke(self._trainer.too_large() if is_short(error) else error) from error

    def commit(self, store: Store, lease: Lease, turn: TrainingTurn) -> None:
        """Do `Trainer.commit`; the other ranks have nothing to write."""
        self._trainer.commit(store, lease, turn)

    def close(self) -> None:
        """Leave the ranks where they are: the next trainer replaces theirs."""


# In the other ranks --------------------------------------------------------------------------------------------------


def follow(meeting: Meeting, config: Config, store: Store, comm: Communicator, ending: Callable[[], None]) -> None:
    """Do the orders of rank 0 until it ends; `ending` is called before it may be gone.

    Raises RanksError, transient, for anything that keeps this rank from going on.
    """
    follower = _Follower(config, store, comm)
    rank, done = comm.rank, 0
    try:
        while True:
            number, what, about = json.loads(meeting.told("order") or "[0, null, null]")
            if number == done:
                time.sleep(POLL)
                continue
            if what == END:
                ending()
            else:
                follower.obey(what, about)
            meeting.tell(f"done/{rank}", str(number))
            done = number
            if what == END:
                return
    except Exception as error:
        shown = follower.shown(error)
        with suppress(RuntimeError):
            meeting.tell(f"left/{rank}", json.dumps([type(shown).__name__, _described(shown)]))
        raise RanksError(f"rank {rank} of {comm.size} left its turn: {first_line(shown)}", transient=True) from error


class _Follower:
    """The trainer of a rank that is not the first."""

    def __init__(self, config: Config, store: Store, comm: Communicator):
        self._config, self._store, self._comm = config, store, comm
        self._trainer: Trainer | None = None

    def obey(self, what: str, about: dict) -> None:
        """Do an order. Raises what `Trainer.turn` raises, except PlayerDiverged, which rank 0 reports."""
        if what == MAKE:
            self._trainer = None  # two at once would need twice the memory
            self._trainer = rank_trainer(self._store, self._config, self._comm)
            return
        assert self._trainer is not None
        turn = decode(Job(self._config.league, TrainingTurn.kind, "", about))
        assert isinstance(turn, TrainingTurn)
        with suppress(PlayerDiverged):
            for _ in self._trainer.turn(self._store, turn, lambda: False):  # rank 0 decides when to stop
                pass

    def shown(self, error: Exception) -> Exception:
        """Return the error for the user."""
        return self._trainer.too_large() if self._trainer is not None and is_short(error) else error


def _described(error: Exception) -> str:
    known = isinstance(error, StorageError | TooLarge)
    return str(error) if known else f"{first_line(error)}\n{traceback.format_exc()}"


def first_line(error: Exception) -> str:
    """Return the first line of an error, with its type if the type says more than the message."""
    text = str(error).partition("\n")[0]
    known = isinstance(error, StorageError | TooLarge | RankDied | RanksError)
    return text if known else f"{type(error).__name__}: {text}"
