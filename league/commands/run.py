"""`league run`: check everything, make the league if it is new, run it until its budget is spent or it is stopped."""

import json
import os
import signal
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path

from league import curriculum, devices
from league.commands.asked import Asked, RunOptions, read
from league.commands.manage import Task, manage
from league.commands.progress import summary
from league.config import experiment as configuration
from league.config.durations import seconds
from league.config.experiment import Budget, Config
from league.config.schema import ConfigError
from league.daemon import DaemonError
from league.handover import Standby
from league.jobs import TrainingTurn
from league.liveness import leader, place
from league.matches import rating_goes_on
from league.plan import spent, trained_enough
from league.prepare import Prepared, standing_by
from league.standing import Standing
from storage.errors import NotAStore
from storage.store import Store

WHAT = "Run a league: train, play rating matches, go on where it stopped."


def run(args: list[str]) -> int:
    """Run a league."""
    asked = read(args)
    config, where = asked.config, asked.options.store
    if asked.help:
        from league.commands import help

        print(help.page("run", WHAT, RunOptions, config))
        return 0
    devices.use(asked.options.devices)
    _refuse_second(where, config)
    with ExitStack() as until_the_end:
        preparing = standing_by(where, config, debug="--debug" in sys.argv, stay=not asked.options.detach)
        try:
            prepared, standby = until_the_end.enter_context(preparing)
        except ConfigError as error:
            raise asked.located(error) from None
        return _run(asked, prepared, standby)


def _run(asked: Asked, prepared: Prepared, standby: Standby | None) -> int:
    """Run a league that is prepared, unless nothing is left to do."""
    config, where = asked.config, asked.options.store
    with Store.open(where, blobs=config.storage.blobs) as store:
        if config.stages:
            done = _walked(store, config)
            if done is not None:
                print(done)
                return 0
            return _go(asked, Task(where, config.storage.blobs, configuration.dumps(config), prepared), standby)
        standing = _tried_again(Standing.of(store, config.league, recent=config.budget.window))
        config = _with_budget(asked, standing)
        if trained_enough(config, standing) and not rating_goes_on(config, standing):
            print(f"{summary(config, standing)}\n\n{_had_enough(config)}")
            return 0
    return _go(asked, Task(where, config.storage.blobs, configuration.dumps(config), prepared), standby)


def _tried_again(standing: Standing) -> Standing:
    """The standing as the manager will find it: a turn that was set aside is tried again when a person runs it."""
    kept = [job for job in standing.jobs if (job.kind, job.state) != (TrainingTurn.kind, "failed")]
    return replace(standing, jobs=kept)


def _go(asked: Asked, task: Task, standby: Standby | None) -> int:
    return _detach(task) if asked.options.detach else manage(task, standby=standby)


def _walked(store: Store, config: Config) -> str | None:
    """What to say of a curriculum whose last stage has ended; None where there is something left to do."""
    last = configuration.stage(config, len(config.stages) - 1)
    standing = curriculum.standing(store, last)
    why = curriculum.ended(last, standing)
    if why is None or rating_goes_on(last, standing):
        return None
    more = f"`league run --league {last.league}` goes on with the last stage without a budget"
    return f"{summary(last, standing)}\n\nThe last stage of league {config.league} has ended: {why}; {more}."


def _refuse_second(where: str, config: Config) -> None:
    """Say at once that the league runs already; the manager's lease is what decides."""
    leagues = [config, *(configuration.stage(config, number) for number in range(len(config.stages)))]
    try:
        with Store.open(where, blobs=config.storage.blobs) as store:
            found = next(filter(None, (leader(store, each.league) for each in leagues)), None)
    except NotAStore:
        return
    if found is not None:
        host, pid = place(found)
        raise DaemonError(
            f"league {config.league!r} is running already (process {pid} on {host}): see `league status`, or"
            " `league stop` first"
        )


def _with_budget(asked: Asked, standing: Standing) -> Config:
    """The settings with the budget of this run: --for and --steps count from now; a plain `league run` has none."""
    config, options = asked.config, asked.options
    used = [spent(config, standing, group) for group in standing.groups]
    done, steps = max((seconds for seconds, _ in used), default=0.0), max((steps for _, steps in used), default=0)
    if options.duration is not None or options.steps is not None:
        train = None if options.duration is None else f"{done + seconds(options.duration):.3f}s"
        until = None if options.steps is None else steps + options.steps
        return replace(config, budget=Budget(train, until, config.budget.rate or "3m"))
    if asked.continued and not any(key[0] == "budget" for key in asked.given) and trained_enough(config, standing):
        if config.deterministic:
            raise ConfigError(
                ("budget", "steps"),
                f"league {config.league} is deterministic and has had its budget of {_budget(config)}: say how many"
                " more with --steps",
            )
        return replace(config, budget=Budget())
    return config


def _had_enough(config: Config) -> str:
    if config.budget == replace(config.budget, train=None, steps=None):
        return f"Nobody in league {config.league} can learn any more: `league status` tells why."
    more = "--steps says how many more" if config.deterministic else "`league run` goes on without one"
    return f"League {config.league} has had its budget of {_budget(config)}; {more}."


def _budget(config: Config) -> str:
    budget = config.budget
    return f"{budget.train} of training" if budget.train else f"{budget.steps or 0:,} steps"


def _detach(task: Task) -> int:
    """Manage the league in a process of a session of its own, and wait until that one leads or says why it cannot."""
    log = _log(task)
    listening, speaking = os.pipe()
    with log.open("ab") as out:
        start = out.tell()
        process = subprocess.Popen(
            [sys.executable, "-m", "league.commands.manage", str(speaking)], stdin=subprocess.PIPE, stdout=out,
            stderr=out, start_new_session=True, pass_fds=(speaking,),
        )  # fmt: skip
    os.close(speaking)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # the other process must not outlive this one unsaid
    try:
        assert process.stdin is not None
        with process.stdin as told:
            told.write(json.dumps(asdict(task)).encode())
        with os.fdopen(listening) as answer:
            leads = bool(answer.read())
    except (KeyboardInterrupt, BrokenPipeError):
        process.terminate()
        leads = False
    if not leads:
        process.wait()
        with log.open("rb") as out:
            out.seek(start)
            said = out.read().decode(errors="replace").strip().splitlines()
        reason = said[-1].removeprefix("league: ") if said else f"exit code {process.returncode}"
        raise DaemonError(f"it could not start in the background: {reason} ({log} has all)")
    print(f"Runs in the background as process {process.pid}; it writes to {log}. See `league status`, `league stop`.")
    return 0


def _log(task: Task) -> Path:
    """Where a background run writes: beside a store of files, else here."""
    folder = Path(task.where.removeprefix("sqlite:///"))
    if "://" in str(task.where) and not task.where.startswith("sqlite:///"):
        return Path("run.log").absolute()
    return (folder.parent if folder.is_file() else folder) / "run.log"
