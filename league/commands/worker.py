"""`league worker`: work for a league that runs, on this host or another; the store is all that they share."""

import time
from dataclasses import dataclass, field
from typing import Literal, get_args

from league import devices
from league.commands.options import Where, parse
from league.config import experiment as configuration
from league.liveness import leader
from league.worker import Post, work
from storage.errors import StorageError

Kind = Literal["train", "match"]
LOOK = 1.0  # seconds between two looks for a manager


@dataclass(frozen=True)
class WorkerOptions(Where):
    """For which league to work, and how."""

    kinds: tuple[Kind, ...] = get_args(Kind)
    """What to do: learn (train), play rating matches (match), or whichever waits."""
    devices: tuple[int, ...] = field(default=(), metadata={"low": 0})
    """The GPUs to work on, by the numbers of nvidia-smi, e.g. 0,1 (none given: all that can be used)."""
    number: int = field(default=0, metadata={"low": 0, "high": 1023})
    """Which of these GPUs it takes, where it needs one of several: workers of one host are numbered from 0."""
    wait: bool = False
    """Wait until somebody runs the league, instead of ending with an error where nobody does."""


def worker(args: list[str]) -> int:
    """Work for a league until its manager ends or it is told to stop."""
    what = "Work for a league that runs, from any host that reaches its store; Ctrl-C finishes what is under way first."
    options = parse(WorkerOptions, args, "worker", what)
    devices.use(options.devices)
    with options.open() as opened:
        store, league = opened.store, opened.league
        while (manager := leader(store, league)) is None:
            if not options.wait:
                raise StorageError(f"League {league!r} is not running: `league run` runs it, --wait waits for that.")
            time.sleep(LOOK)
        config = configuration.loads(store.league(league).config)
    print(f"Works for league {league}, managed by {manager}. Ctrl-C stops.", flush=True)
    spread = config.training.devices if "train" in options.kinds else 1
    text = configuration.dumps(config)
    work(Post(options.store, options.blobs, text, options.kinds, options.number, None, spread, manager))
    print(f"No longer works for league {league}; what was under way is finished.")
    return 0
