"""`league run`: validate all settings, create a new league, run it until its budget is spent or it is stopped."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

from league.commands.run.background import BackgroundRun, manage
from league.commands.run.live import live_matches
from league.commands.run.request import RunOptions, RunRequest, read
from league.commands.run.summary import summary
from league.config import experiment as configuration
from league.config.durations import seconds
from league.config.experiment import Budget, Config
from league.config.run_spec import RunSpec
from league.config.schema import ConfigError
from league.runs.sweeps.run_state import with_retries
from league.runtime.manager import ManagerError
from league.runtime.preflight import Prepared, preparation
from league.runtime.warm_worker import WarmWorker
from league.scheduling import curriculum
from league.scheduling.episode_lengths import averaged_iterations
from league.scheduling.match_scheduler import rating_goes_on
from league.scheduling.training_progress import trained_enough
from league.state.league_state import LeagueState
from league.state.liveness import leader, process_named
from league.state.setting_changes import learner_changes, run_changes, start_changed
from league.system import devices, exit_codes, provenance
from storage.database.urls import without_passwords
from storage.errors import NotAStore
from storage.store import Store

WHAT = "Run a league: train, play rating matches, continue where it stopped."


class SettingChanges(NamedTuple):
    """Settings of this run that differ from those of the last run of its leagues."""

    start: Sequence[str] = ()  # lines about `after`, which players that have begun do not read
    used: Sequence[str] = ()  # lines for a run that goes on with the settings
    settings: Sequence[str] = ()  # each setting, as `seed 1 -> 2`


def run(args: list[str]) -> int:
    """Run a league."""
    request = read(args)
    if request.help:
        from league.commands import help

        print(without_passwords(help.page("run", WHAT, RunOptions, request.config)))
        return 0
    if request.options.live and (request.options.detach or request.config.stages):
        which = "--detach" if request.options.detach else "a curriculum, which is a league for each stage"
        raise ConfigError(
            (), f"--live shows a league that runs at this terminal, not {which}: use `league watch --live`"
        )
    devices.use(request.options.devices)
    return execute(request)


def execute(request: RunRequest) -> int:
    """Prepare and run a league; return the exit code.

    Raises ConfigError, StorageError, ManagerError or PrepareError.
    """
    config, where = request.config, request.options.store
    _refuse_if_running(where, config)
    changes = _setting_changes(where, config)
    with ExitStack() as until_the_end:
        spec = RunSpec.of(where, config)
        preparing = preparation(spec, config, debug="--debug" in sys.argv, keep=not request.options.detach)
        try:
            prepared, warm_worker = until_the_end.enter_context(preparing)
        except ConfigError as error:
            raise request.with_location(error) from None
        return _run(request, spec, prepared, warm_worker, changes)


def _run(
    request: RunRequest, spec: RunSpec, prepared: Prepared, warm_worker: WarmWorker | None, changes: SettingChanges
) -> int:
    """Run a prepared league, unless nothing is left to do. Writes the configuration again if it has another budget."""
    for line in changes.start:  # only now: a setting may just have been refused
        print(line)
    config = request.config
    with Store.open(spec.store, blobs=spec.blobs) as store:
        if config.stages:
            done = _finished_curriculum(store, spec.store, config)
            if done is not None:
                print(f"{done}{_unused(changes)}")
                return 0
            return _start(request, spec, config, prepared, warm_worker, changes)
        state = with_retries(LeagueState.of(store, config.league, recent=averaged_iterations(config)))
        config = _with_budget(request, state)
        paused = any(player.paused is not None for player in state.players)  # the manager resumes them
        if trained_enough(config, state) and not paused and not rating_goes_on(config, state):
            print(f"{summary(config, state, spec.store)}\n\n{_nothing_left(config, changes)}")
            return 0
    if config != request.config:
        spec = RunSpec.of(spec.store, config)
    return _start(request, spec, config, prepared, warm_worker, changes)


def _start(
    request: RunRequest, spec: RunSpec, config: Config, prepared: Prepared, warm_worker: WarmWorker | None,
    changes: SettingChanges,
) -> int:  # fmt: skip
    for line in changes.used:
        print(line)
    if request.options.detach:
        return _detach(BackgroundRun(spec, prepared))
    with live_matches(spec, config.league) if request.options.live else nullcontext():
        return manage(spec, config, prepared, warm_worker=warm_worker)


def _finished_curriculum(store: Store, where: str, config: Config) -> str | None:
    """Return the message about a curriculum whose last stage has ended; None if something is left to do."""
    last = configuration.stage(config, len(config.stages) - 1)
    state = curriculum.stage_state(store, last)
    why = curriculum.ended(last, state)
    if why is None or rating_goes_on(last, state):
        return None
    more = f"`league run --league {last.league}` goes on with the last stage without a budget"
    return f"{summary(last, state, where)}\n\nThe last stage of league {config.league} has ended: {why}; {more}."


def _refuse_if_running(where: str, config: Config) -> None:
    """Raise ManagerError at once if the league runs already; later, the manager's lease decides that."""
    leagues = [config, *(configuration.stage(config, number) for number in range(len(config.stages)))]
    try:
        with Store.open(where, blobs=config.storage.blobs) as store:
            found = next(filter(None, (leader(store, each.league) for each in leagues)), None)
    except NotAStore:
        return
    if found is not None:
        host, pid = process_named(found)
        raise ManagerError(
            f"league {config.league!r} is running already (process {pid} on {host}): see `league status`, or"
            " `league stop` first",
            transient=True,
        )


def _setting_changes(where: str, config: Config) -> SettingChanges:
    """Return how the settings of each league of this run differ from those of its last run."""
    first = configuration.stage(config, 0) if config.stages else config
    try:
        with Store.open(where, blobs=config.storage.blobs) as store:
            kept = {league.name: league.config for league in store.leagues()}
            begun = [*store.newest_checkpoints(first.league)]
    except NotAStore:
        return SettingChanges()
    start, used, settings = [], [], dict[str, None]()
    if begun and config.every_after and start_changed(kept.get(config.league, ""), configuration.dumps(config)):
        by_parts = f", by after_parts = {json.dumps(config.after_parts)}," if config.after_parts else ""
        start.append(
            f"after = {json.dumps(config.every_after)}{by_parts} is for players that begin to learn:"
            f" {', '.join(begun)} of league {first.league} go on from where they are. A league of another name"
            " (--league) starts from there."
        )
    for each in [configuration.stage(config, number) for number in range(len(config.stages))] or [config]:
        before, now = kept.get(each.league, ""), configuration.dumps(each)
        if changes := learner_changes(before, now):
            settings |= dict.fromkeys(changes)
            shown = ", ".join(changes)
            used.append(
                f"Learns on with other settings than before: {shown}. `league explain SNAPSHOT` shows them later."
            )
        if changes := run_changes(before, now):
            settings |= dict.fromkeys(changes)
            used.append(f"Goes on with other settings than before: {', '.join(changes)}.")
    return SettingChanges(start, used, tuple(settings))


def _unused(changes: SettingChanges) -> str:
    """Return the sentence about settings that a run without work leaves unused; an empty text without any."""
    if not changes.settings:
        return ""
    return f" The league keeps the settings of its last run, and these are not used: {', '.join(changes.settings)}."


def _with_budget(request: RunRequest, state: LeagueState) -> Config:
    """Return the settings with the budget of this run.

    --for and --steps count from now. A plain `league run` of a league that has had its budget has none.
    """
    config, options = request.config, request.options
    used = [state.spent(group, config.training.schedule) for group in state.groups]
    done, steps = max((seconds for seconds, _ in used), default=0.0), max((steps for _, steps in used), default=0)
    if options.duration is not None or options.steps is not None:
        train = None if options.duration is None else f"{done + seconds(options.duration):.3f}s"
        until = None if options.steps is None else steps + options.steps
        return replace(config, budget=Budget(train, until, config.budget.rating_time or "3m"))
    if request.continued and not any(key[0] == "budget" for key in request.given) and trained_enough(config, state):
        if config.deterministic:
            raise ConfigError(
                ("budget", "steps"),
                f"league {config.league} is deterministic and has had its budget of {_budget(config)}: say how many"
                " more with --steps",
            )
        return replace(config, budget=Budget())
    return config


def _nothing_left(config: Config, changes: SettingChanges) -> str:
    """Return why the run ends at once, which settings it leaves unused, and what goes on."""
    if config.budget == replace(config.budget, training_time=None, steps=None):
        return f"Nobody in league {config.league} can learn any more: `league status` tells why.{_unused(changes)}"
    had = f"League {config.league} has had its budget of {_budget(config)}"
    if changes.settings:  # a plain `league run` would go on with those of the store
        more = "--steps" if config.deterministic else "--for or --steps"
        return f"{had}.{_unused(changes)} To learn on with them, give them again with a larger budget or with {more}."
    more = "--steps says how many more" if config.deterministic else "`league run` goes on without one"
    return f"{had}; {more}."


def _budget(config: Config) -> str:
    budget = config.budget
    return f"{budget.training_time} of training" if budget.training_time else f"{budget.steps or 0:,} steps"


def _detach(run: BackgroundRun) -> int:
    """Manage the league in a process with its own session, and wait until that process leads the league.

    Raises ManagerError, with the last line that the process printed, if it ends before.
    """
    log = _log(run.spec.store)
    reading, writing = os.pipe()
    with log.open("ab") as out:
        start = out.tell()
        process = subprocess.Popen(
            provenance.command("league.commands.run.background", str(writing)), stdin=subprocess.PIPE, stdout=out,
            stderr=out, start_new_session=True, pass_fds=(writing,),
        )  # fmt: skip
    os.close(writing)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # Ctrl-C must end the other process as well
    try:
        assert process.stdin is not None
        with process.stdin as stdin:
            stdin.write(json.dumps(asdict(run)).encode())
        with os.fdopen(reading) as answer:
            leads = bool(answer.read())
    except (KeyboardInterrupt, BrokenPipeError):
        process.terminate()
        leads = False
    if not leads:
        process.wait()
        with log.open("rb") as out:
            out.seek(start)
            lines = out.read().decode(errors="replace").strip().splitlines()
        reason = lines[-1].removeprefix("league: ") if lines else f"exit code {process.returncode}"
        raise ManagerError(
            f"it could not start in the background: {reason} ({log} has all)",
            transient=process.returncode == exit_codes.PASSING or process.returncode < 0,
        )
    print(f"Runs in the background as process {process.pid}; it writes to {log}. See `league status`, `league stop`.")
    return 0


def _log(store: str) -> Path:
    """Return the path of a background run's log: beside a store of files, or in the working folder."""
    folder = Path(store.removeprefix("sqlite:///"))
    if "://" in store and not store.startswith("sqlite:///"):
        return Path("run.log").absolute()
    return (folder.parent if folder.is_file() else folder) / "run.log"
