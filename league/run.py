"""`league run`: make the league if it is new, run it until its budget is spent or it is stopped, tell how it stands."""

import socket
import subprocess
import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

import arenas
from arenas.arena import Arena
from league import config as configuration
from league.config import Budget, Config
from league.daemon import DaemonError, Manager, running
from league.durations import seconds
from league.options import STORE, parse
from league.plan import Standing, trained_enough
from league.policies import add_scripts
from league.progress import NEXT, Ticker, summary
from league.query import only_league
from league.settings import ConfigError, check
from league.versions import versions
from matchmaking.roles import MAIN
from storage.records import ArenaKey, League, Player
from storage.store import Store


@dataclass(frozen=True)
class RunOptions:
    """What to run, and for how long. All settings below can also stand in the file."""

    file: Annotated[Path | None, tyro.conf.Positional] = None
    """A league.toml (see `league init`); it comes first. Without one and without --preset: the league last run here."""
    preset: str | None = None
    """Settings to start from: quickstart, duel or paper."""
    store: str = STORE
    """The store: a folder, or a URL such as sqlite:///runs/league.db."""
    duration: Annotated[str | None, tyro.conf.arg(name="for")] = None
    """Train for so long from now on, e.g. 10m, whatever the budget says."""
    steps: int | None = None
    """Train for so many environment steps from now on, whatever the budget says."""
    detach: bool = False
    """Run in the background; `league status` and `league stop` reach it."""
    config: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    """All settings."""


def run(args: list[str]) -> int:
    """Run a league."""
    base, stored = _base(args)
    default = RunOptions(config=base)
    options = parse(
        RunOptions, args, "run", "Run a league: train, play rating matches, go on where it stopped.", default
    )
    check(options.config)
    if options.duration is not None:
        try:
            seconds(options.duration)
        except ValueError as error:
            raise ConfigError(("for",), f"--for: {error}") from None
    if options.detach:
        return _detach(args, options)
    with Store.open(options.store, create=True) as store:
        config = options.config
        arena = config.arena.build(engine=config.engine, threads=1)
        _create(store, config, arena)
        config = _with_budget(store, options, stored)
        standing = Standing.of(store, config.league)
        if trained_enough(config, standing) and not _to_rate(config, standing):
            print(summary(config, standing))
            print(f"\nLeague {config.league} has had its budget of {_spent(config)}; `league run` goes on without one.")
            return 0
        store.start_run(config.league, configuration.dumps(config), socket.gethostname(), versions())
        print(_greeting(config, arena, options.store), flush=True)
        phase = Manager(store, options.store, config).run(Ticker(config))
        standing = Standing.of(store, config.league)
        if phase == "stopped":
            at = standing.newest
            where = f" at iteration {at.iteration}, {at.step:,} steps" if at else ""
            print(f"\nStopped{where}. Nothing is lost: the same command goes on.\n\n{NEXT}")
        else:
            print(f"\n{summary(config, standing)}")
    return 0


def _base(args: list[str]) -> tuple[Config, bool]:
    """The settings that flags then change: those of file, preset or the league last run; and if it was the last."""
    if args and not args[0].startswith("-"):
        return configuration.load(Path(args[0])), False
    given = {name: value for name, value in (_flag(args, n) for n in ("preset", "store", "arena.name", "league"))}
    if given["preset"]:
        base = configuration.preset(given["preset"])
    elif given["arena.name"]:
        base = configuration.default(given["arena.name"])
    else:
        return _last(given["store"] or STORE, given["league"])
    if given["arena.name"] and given["arena.name"] != base.arena.name:
        base = replace(base, arena=arenas.settings(given["arena.name"]))
    return base, False


def _flag(args: list[str], name: str) -> tuple[str, str | None]:
    """The value of --name, which decides what the other flags may be."""
    for i, arg in enumerate(args):
        if arg == f"--{name}" and i + 1 < len(args):
            return name, args[i + 1]
        if arg.startswith(f"--{name}="):
            return name, arg.partition("=")[2]
    return name, None


def _last(where: str, league: str | None) -> tuple[Config, bool]:
    """The settings of the league that was run last in a store; those of the quick start where there is no store."""
    folder = where.removeprefix("sqlite:///")
    if "://" not in folder and not Path(folder).exists():
        return configuration.quickstart(), False
    with Store.open(where) as store:
        if not store.leagues():
            return configuration.quickstart(), False
        kept = store.league(league or only_league(store))
    return configuration.loads(kept.config, f"{where}, league {kept.name}"), True


def _create(store: Store, config: Config, arena: Arena) -> None:
    """Make the league, its players and the scripted opponents; what exists already stays."""
    key = ArenaKey(arena.name, arena.config_hash, arena.engine.name)
    kept = store.create_league(League(config.league, key, configuration.dumps(config)))
    other = running(store, config.league)
    if other is not None:
        raise DaemonError(
            f"league {config.league!r} is running already (process {other.pid} on {other.host}): see `league status`,"
            " or `league stop` first"
        )
    store.add_players([Player(config.league, t.name, i, MAIN.name, t.roster) for i, t in enumerate(arena.teams)])
    add_scripts(store, config.league, arena, config.rating.scripts)
    if kept.config != configuration.dumps(config):
        store.set_config(config.league, configuration.dumps(config))


def _with_budget(store: Store, options: RunOptions, stored: bool) -> Config:
    """The settings with the budget of this run: --for and --steps count from now; a plain `league run` has none."""
    config = options.config
    newest = Standing.of(store, config.league).newest
    done = (newest.seconds, newest.step) if newest else (0.0, 0)
    if options.duration is not None or options.steps is not None:
        train = None if options.duration is None else f"{done[0] + seconds(options.duration):.3f}s"
        steps = None if options.steps is None else done[1] + options.steps
        return replace(config, budget=Budget(train, steps, config.budget.rate or "3m"))
    if stored and trained_enough(config, Standing.of(store, config.league)):
        return replace(config, budget=Budget())
    return config


def _to_rate(config: Config, standing: Standing) -> bool:
    """Whether rating was cut short: the newest snapshots have not met all by which progress is told."""
    from league.plan import newest_snapshots, yardsticks

    payoff = standing.payoff()
    return config.workers.match > 0 and any(
        payoff.score(s.digest, other.digest).games < config.rating.quota
        for s in newest_snapshots(standing)
        for other in yardsticks(config, standing, s)
    )


def _spent(config: Config) -> str:
    budget = config.budget
    return f"{budget.train} of training" if budget.train else f"{budget.steps:,} steps"


def _greeting(config: Config, arena: Arena, where: str) -> str:
    teams = " against ".join(f"{t.name} ({len(t.agents)} × {t.agents[0].kind})" for t in arena.teams)
    return (
        f"League {config.league}: {teams} in {arena.name}, engine {arena.engine.name}; stored in {where}."
        " Ctrl-C stops it, the same command goes on."
    )


def _detach(args: list[str], options: RunOptions) -> int:
    """Start the same command in a session of its own, its output in a file beside the store."""
    folder = Path(options.store.removeprefix("sqlite:///"))
    folder = folder.parent if folder.suffix == ".db" else folder if "://" not in options.store else Path.cwd()
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "run.log"
    command = [sys.executable, "-m", "league", "run", *(a for a in args if a != "--detach")]
    with log.open("ab") as out:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=out, stderr=out, start_new_session=True)
    time.sleep(3)  # long enough for bad input to show itself
    if process.poll() not in (None, 0):
        raise DaemonError(f"it ended at once: {log.read_text().strip().splitlines()[-1]}")
    print(f"Runs in the background as process {process.pid}; it writes to {log}. See `league status`, `league stop`.")
    return 0
