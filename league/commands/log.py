"""`league log`: learning curves for the programs that other people watch theirs with."""

import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from dashboards.scalars import Events
from league.commands.options import Where, parse
from league.config.schema import ConfigError
from league.query import Open
from storage.errors import Away

LOOK = 1.0  # seconds between two looks at a league that is followed


@dataclass(frozen=True)
class LogOptions(Where):
    """Which league, and where its curves go."""

    tensorboard: Path | None = None
    """A folder for TensorBoard, which may have been written before: what it lacks is added."""
    follow: bool = False
    """Go on with what the league learns, until Ctrl-C."""


def log(args: list[str]) -> int:
    """Write learning curves as they stand in the store; who learns does not know of it."""
    options = parse(LogOptions, args, "log", "Learning curves for TensorBoard, a run for each player.")
    if options.tensorboard is None:
        raise ConfigError((), "league log needs --tensorboard FOLDER: see league log --help")
    from dashboards.scalars import events

    with options.open() as opened, ExitStack() as stack:
        began = opened.store.league(opened.league).created
        runs = {
            player.name: stack.enter_context(events(options.tensorboard / opened.league / player.name, began))
            for player in opened.store.players(opened.league)
        }
        _tell(_extend(opened, runs))
        print(f"Wrote {options.tensorboard}; `tensorboard --logdir {options.tensorboard}` shows it.", flush=True)
        if options.follow:
            try:
                _follow(opened, runs)
            except KeyboardInterrupt:
                return 0
    return 0


def _extend(opened: Open, runs: dict[str, Events]) -> dict[str, tuple[int, int]]:
    """Add what is new; for each player how many iterations that were, and the newest."""
    curves = {name: opened.store.curves(opened.league, name, after=run.iteration) for name, run in runs.items()}
    return {name: (run.extend(curves[name]), run.iteration) for name, run in runs.items()}


def _follow(opened: Open, runs: dict[str, Events]) -> None:
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
