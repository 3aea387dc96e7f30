"""`league log`: learning curves for TensorBoard and Weights & Biases."""

import hashlib
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from league.commands.options import Where, parse
from league.config.schema import ConfigError
from league.queries.query import Open
from storage.errors import Unavailable
from storage.records import CurvePoint

LOOK = 1.0  # seconds between two reads of a league that is followed


@dataclass(frozen=True)
class LogOptions(Where):
    """The league, and the folders for its curves."""

    tensorboard: Path | None = None
    """A folder for TensorBoard, which may have been written before: what it lacks is added."""
    wandb: Path | None = None
    """The same for Weights & Biases. It stays on this machine, for `wandb sync` to send, unless WANDB_MODE=online."""
    follow: bool = False
    """Add new points while the league learns, until Ctrl-C."""


class Writer(Protocol):
    """Writer of a player's curve to another program's files."""

    @property
    def iteration(self) -> int:
        """Newest iteration in the files."""
        ...

    def extend(self, points: Iterable[CurvePoint]) -> int:
        """Add the points that the files lack; return their number."""
        ...


Writers = Sequence[tuple[str, Writer]]
"""Writers with the names of their players."""


def log(args: list[str]) -> int:
    """Write the learning curves in the store; learners are not affected."""
    options = parse(LogOptions, args, "log", "Learning curves for other programs, a run for each player.")
    if options.tensorboard is None and options.wandb is None:
        raise ConfigError((), "league log needs --tensorboard FOLDER or --wandb FOLDER: see league log --help")
    with options.open() as opened, ExitStack() as stack:
        runs = _writers(opened, options, stack)
        _tell(_extend(opened, runs))
        if options.tensorboard is not None:
            print(f"Wrote {options.tensorboard}; `tensorboard --logdir {options.tensorboard}` shows it.", flush=True)
        if options.wandb is not None:
            print(_written(options.wandb), flush=True)
        if options.follow:
            try:
                _follow(opened, runs)
            except KeyboardInterrupt:
                return 0
    return 0


def _written(wandb: Path) -> str:
    from dashboards.export.wandb import wandb_mode

    sent = " and sent it" if wandb_mode() == "online" else f"; `wandb sync {wandb}/wandb/offline-run-*` sends it"
    return f"Wrote {wandb}{sent}."


def _writers(opened: Open, options: LogOptions, stack: ExitStack) -> Writers:
    """Make a writer of each requested kind for each player."""
    from dashboards.export.run_folders import league_folder, locked_folder
    from dashboards.export.tensorboard import open_event_file
    from dashboards.export.wandb import open_run

    league, found = opened.store.league(opened.league), []
    identity = _identity(opened)
    with locked_folder(options.tensorboard) if options.tensorboard is not None else nullcontext():
        folder = options.tensorboard and league_folder(options.tensorboard, league.name, league.created, identity)
        for player in opened.store.players(league.name):
            if folder is not None:
                run = open_event_file(folder / player.name, league.created, identity)
                found.append((player.name, stack.enter_context(run)))
            if options.wandb is not None:
                run = open_run(options.wandb, league.name, player.name, league.created, identity)
                found.append((player.name, stack.enter_context(run)))
    if folder is not None and folder.name != league.name:
        print(f"{folder} has its runs: {options.tensorboard}/{league.name} has those of another league of that name.")
    return found


def _identity(opened: Open) -> str:
    """Return an identifier that differs from those of leagues of the same name in other stores."""
    league = opened.store.league(opened.league)
    return hashlib.sha256(f"{opened.store.made():.6f}/{league.created:.6f}".encode()).hexdigest()[:8]


def _extend(opened: Open, runs: Writers) -> dict[str, tuple[int, int]]:
    """Add new points; return for each player the most iterations added to one writer, and the newest iteration."""
    found: dict[str, tuple[int, int]] = {}
    for name, run in runs:
        new = run.extend(opened.store.curves(opened.league, name, after=run.iteration))
        found[name] = max(new, found.get(name, (0, 0))[0]), run.iteration
    return found


def _follow(opened: Open, runs: Writers) -> None:
    seen = opened.store.revision(opened.league)
    while True:
        time.sleep(LOOK)
        try:
            if (now := opened.store.revision(opened.league)) != seen:
                _tell(_extend(opened, runs))
                seen = now
        except Unavailable as error:
            print(f"league: {error}; waiting for it", file=sys.stderr, flush=True)


def _tell(added: dict[str, tuple[int, int]]) -> None:
    for name, (new, newest) in added.items():
        if new:
            print(f"{name}: {new:,} iterations, up to {newest:,}", flush=True)
