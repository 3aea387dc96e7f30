"""`league worker`: work for a running league, on this host or another. Its processes share only the store."""

import os
import signal
import sys
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, get_args

from league.commands.options import Where, parse
from league.config.durations import check_duration, seconds
from league.config.run_spec import RunSpec
from league.runtime.worker_process import WorkerSpec, work
from league.state.liveness import leader
from league.system import devices, exit_codes
from storage.database.lock_wait import RetryReporter
from storage.errors import NoLeague, NotAStore, StorageError, Unavailable, UnknownName

if TYPE_CHECKING:
    from agents.devices.rendezvous import Place

Kind = Literal["train", "match"]
LOOK = 1.0  # seconds between two checks for a manager


@dataclass(frozen=True)
class WorkerOptions(Where):
    """The league to work for, and the jobs and devices."""

    kinds: tuple[Kind, ...] = get_args(Kind)
    """The jobs to do: learn (train), play rating matches (match), or whichever is queued."""
    devices: tuple[int, ...] = field(default=(), metadata={"low": 0})
    """The GPUs to work on, by the numbers of nvidia-smi, e.g. 0,1 (none given: all that can be used)."""
    number: int = field(default=0, metadata={"low": 0, "high": 1023})
    """Number of the worker on its host, from 0, which decides its GPU among several."""
    wait: bool = False
    """Wait until somebody runs the league, instead of ending with an error where nobody does."""
    ranks: bool = False
    """Learn as one of the ranks that torchrun or srun has started; training.devices is their number."""
    ranks_limit: str = field(default="5m", metadata={"valid": check_duration})
    """With --ranks: how long a rank waits for the others."""

    def __post_init__(self) -> None:
        """Raise ValueError if ranks would not learn, or would not wait for each other."""
        if self.ranks and "train" not in self.kinds:
            raise ValueError("kinds: with --ranks a worker learns, so they must have train")
        if not seconds(self.ranks_limit):
            raise ValueError("ranks_limit: must be longer than nothing")


def worker(args: list[str]) -> int:
    """Work for a league until its manager ends or a stop is requested."""
    what = "Work for a league that runs, from any host that reaches its store; Ctrl-C finishes what is under way first."
    options = parse(WorkerOptions, args, "worker", what)
    devices.use(options.devices)
    place, limit = _place() if options.ranks else None, seconds(options.ranks_limit)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(exit_codes.DONE))  # a wait ends as it was asked to
    league, manager, text = _sought(options)
    spec = RunSpec(options.store, options.blobs, text)
    config = spec.config()
    print(f"Works for league {league}, managed by {manager}. Ctrl-C stops.", flush=True)
    if place is not None and (place.size > 1 or config.training.devices > 1):
        from league.runtime.rank_process import work_as_rank

        work_as_rank(WorkerSpec(spec, ("train",), options.number, None, place.size, manager), place, limit)
    count = config.training.devices if "train" in options.kinds else 1
    work(WorkerSpec(spec, options.kinds, options.number, None, count, manager))
    print(f"No longer works for league {league}; what was under way is finished.")
    return 0


def _place() -> "Place":
    """Return the place of this process among the ranks. Raises RanksError."""
    os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")  # its warnings of a lost connection are pages of C++ frames
    from agents.devices.rendezvous import place_of

    return place_of(os.environ)


def _sought(options: WorkerOptions) -> tuple[str, str, str]:
    """Return the league, its manager and its settings as TOML; with --wait, wait for them. Raises StorageError."""
    patience = RetryReporter()
    while True:
        try:
            with options.open() as opened:
                store, league = opened.store, opened.league
                if manager := leader(store, league):
                    return league, manager, store.league(league).config
            missing = StorageError(f"League {league!r} is not running: `league run` runs it, --wait waits for that.")
        except (Unavailable, NotAStore, NoLeague, UnknownName) as error:  # a manager creates the store and the league
            missing = error
            if options.wait:
                patience.report(error)
        if not options.wait:
            raise missing
        time.sleep(LOOK)
