"""`league log`: learning curves for the programs that other people watch theirs with."""

import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from league.commands.options import Where, parse
from league.config.schema import ConfigError
from league.query import Open
from storage.errors import Away
from storage.records import CurvePoint

LOOK = 1.0  # seconds between two looks at a league that is followed


@dataclass(frozen=True)
class LogOptions(Where):
    """Which league, and where its curves go."""

    tensorboard: Path | None = None
    """A folder for TensorBoard, which may have been written before: what it lacks is added."""
    wandb: Path | None = None
    """The same for Weights & Biases. It stays on this machine, for `wandb sync` to send, unless WANDB_MODE=online."""
    follow: bool = False
    """Go on with what the league learns, until Ctrl-C."""


class Writer(Protocol):
    """A player's curve in another program's files."""

    @property
    def iteration(self) -> int:
        """The newest that it holds."""
        ...

    def extend(self, points: Iterable[CurvePoint]) -> int:
        """Add those that it lacks; how many these were."""
        ...


Writers = Sequence[tuple[str, Writer]]
"""By player."""


def log(args: list[str]) -> int:
    """Write learning curves as they stand in the store; who learns does not know of it."""
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
    from dashboards.wandb_runs import mode

    sent = " and sent it" if mode() == "online" else f"; `wandb sync {wandb}/wandb/offline-run-*` sends it"
    return f"Wrote {wandb}{sent}."


def _writers(opened: Open, options: LogOptions, stack: ExitStack) -> Writers:
    """One of each kind that was asked for, for each player."""
    from dashboards.scalars import events
    from dashboards.wandb_runs import runs

    league, found = opened.store.league(opened.league), []
    for player in opened.store.players(league.name):
        if options.tensorboard is not None:
            folder = options.tensorboard / league.name / player.name
            found.append((player.name, stack.enter_context(events(folder, league.created))))
        if options.wandb is not None:
            run = runs(options.wandb, league.name, player.name, league.created)
            found.append((player.name, stack.enter_context(run)))
    return found


def _extend(opened: Open, runs: Writers) -> dict[str, tuple[int, int]]:
    """Add what is new; for each player how many iterations that were at most, and the newest."""
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
        except Away as error:
            print(f"league: {error}; waiting for it", file=sys.stderr, flush=True)


def _tell(added: dict[str, tuple[int, int]]) -> None:
    for name, (new, newest) in added.items():
        if new:
            print(f"{name}: {new:,} iterations, up to {newest:,}", flush=True)
