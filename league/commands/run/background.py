"""The run of a prepared league, or of a curriculum stage by stage, at the terminal or in the background.

In the background, a process of its own runs this module.
"""

import json
import os
import socket
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from league.commands.run.next_stage import NextStage
from league.commands.run.summary import NEXT, summary
from league.commands.status_line import Ticker
from league.config import experiment as configuration
from league.config.experiment import Config
from league.config.run_spec import RunSpec
from league.runtime.manager import Manager, ManagerError, RunState
from league.runtime.preflight import Prepared, preparation
from league.runtime.warm_worker import WarmWorker
from league.scheduling import curriculum
from league.scheduling.training_progress import handed_on
from league.snapshots.transfer import warm_start
from league.state.jobs import TrainingTurn
from league.state.league_state import LeagueState
from league.system.memory import SHORT
from league.system.packages.versions import versions
from league.system.provenance import code
from storage.database.lock_wait import RetryReporter
from storage.errors import Unavailable
from storage.records import Worker
from storage.store import Store

AWAY = 5.0  # seconds between two attempts to begin a stage while the store is away


@dataclass(frozen=True)
class BackgroundRun:
    """A prepared league, as the process that runs it in the background receives it."""

    spec: RunSpec
    prepared: Prepared


def manage(
    spec: RunSpec, config: Config, prepared: Prepared, on_lead: Callable[[], None] = lambda: None,
    warm_worker: WarmWorker | None = None,
) -> int:  # fmt: skip
    """Run the league to the end of its budget or until it is stopped; `on_lead` is called when it has begun.

    `config` is the configuration that `spec` has as text. A warm worker is the process that has prepared the league. A
    curriculum's stages are prepared here, the first one by the warm worker. Returns the exit code.

    Raises ManagerError if another process leads the league, a turn of training was set aside, or a player was paused.
    """
    with Store.open(spec.store, blobs=spec.blobs) as store:
        if config.stages:
            _run_stages(store, spec, config, on_lead, warm_worker)
        elif _run_league(store, spec, config, prepared, on_lead, warm_worker) != "stopped":
            print(f"\n{summary(config, curriculum.stage_state(store, config), spec.store)}")
            _refuse_set_aside(store, config)
            _refuse_paused(store, config)
    return 0


def _refuse_set_aside(store: Store, config: Config) -> None:
    """Raise ManagerError, one line, if a turn of training was set aside: its players have not learnt further.

    If memory was short, the message says what would fit.
    """
    for job in store.jobs(config.league, "failed"):
        if job.kind == TrainingTurn.kind:
            why = (job.error or "no reason was given").strip().splitlines()[0]
            if why.startswith(SHORT):
                raise ManagerError(why)
            raise ManagerError(
                f"a turn of training was set aside, so its players learnt no further: {why}"
                " (`league status` tells more; the same command tries it again)"
            )


def _refuse_paused(store: Store, config: Config) -> None:
    """Raise ManagerError, one line, if a player was paused: it has not learnt to the end."""
    players = store.players(config.league)
    paused = [player for player in players if player.paused is not None]
    if paused:
        who = "all players" if paused == players else " and ".join(player.name for player in paused)
        why = (paused[0].paused or "").strip().splitlines()[0]
        were = "were" if len(paused) > 1 else "was"
        raise ManagerError(f"{who} {were} paused: {why} (`league status` tells more; the same command tries again)")


def _run_league(
    store: Store,
    spec: RunSpec,
    config: Config,
    prepared: Prepared,
    on_lead: Callable[[], None],
    warm_worker: WarmWorker | None,
    watch: Callable[[LeagueState, RunState], None] = lambda state, activity: None,
) -> RunState:
    """Manage one league, and print how far it is when it was stopped; `watch` is called as a manager's `report` is."""
    # The schedulers count steps by the number of worlds. The store keeps the sizes open, for a machine with another
    # device.
    episodes, pairings = prepared.rating
    sized = replace(spec, worlds=prepared.worlds, rating_worlds=episodes, rating_pairings=pairings)
    reporter = _Reporter(store, config, spec.config_toml, prepared, on_lead)

    def report(league_state: LeagueState, activity: RunState, workers: list[Worker]) -> None:
        reporter(league_state, activity, workers)
        watch(league_state, activity)

    state = Manager(store, sized, config, warm_worker).run(report)
    if state == "stopped":
        at = curriculum.stage_state(store, config).newest
        where = f" at iteration {at.iteration}, {at.step:,} steps" if at else ""
        print(f"\nStopped{where}. Nothing is lost: the same command continues.\n\n{NEXT}")
    return state


def _run_stages(
    store: Store, spec: RunSpec, config: Config, on_lead: Callable[[], None], warm_worker: WarmWorker | None = None
) -> None:
    """Run the stages one after the other, from the one that is under way, until the last has ended or one was stopped.

    Once a stage has begun, waits for a store that is away. Before that raises Unavailable. Raises ManagerError if a
    stage makes no more progress before its end.
    """
    store.set_config(config.league, spec.config_toml)
    number, has_led, patience = curriculum.reached(store, config), False, RetryReporter()
    next_stage = NextStage(config, spec.store, warm_worker)

    def on_first_lead() -> None:
        nonlocal has_led
        if not has_led:
            has_led = True
            on_lead()

    try:
        while number < len(config.stages):
            try:
                if not _run_stage(store, spec.store, config, number, on_first_lead, next_stage):
                    return
            except Unavailable as error:  # a stage has no state outside the store, so the next try continues from there
                if not has_led:
                    raise
                patience.report(error)
                time.sleep(AWAY)
            else:
                number += 1
    finally:
        next_stage.end()


def _run_stage(
    store: Store, where: str, config: Config, number: int, on_lead: Callable[[], None], next_stage: NextStage
) -> bool:
    """Run a stage, unless it has ended already; return False if it was stopped. Raises ManagerError."""
    stage = configuration.stage(config, number)
    league_state = curriculum.stage_state(store, stage)
    is_last = number == len(config.stages) - 1
    if is_last or curriculum.ended(stage, league_state) is None:
        spec = RunSpec.of(where, stage)
        with preparation(spec, stage, create=False, ahead=next_stage.take_prepared()) as (prepared, warm_worker):
            ends = f"it ends {curriculum.until(stage)}"
            print(f"Stage {number + 1} of {len(config.stages)}, {config.stages[number].name}: {ends}.", flush=True)
            watch = next_stage.watch(number, prepared.engine)
            if _run_league(store, spec, stage, prepared, on_lead, warm_worker, watch) == "stopped":
                return False
        league_state = curriculum.stage_state(store, stage)
    why = curriculum.ended(stage, league_state)
    _refuse_set_aside(store, stage)
    if why is None and not is_last:
        raise ManagerError(
            f"stage {config.stages[number].name} stands still before its end, and the next one does not begin:"
            f" `league status --league {stage.league}` tells why"
        )
    if is_last:
        print(f"\n{summary(stage, league_state, where)}")
        _refuse_paused(store, stage)
    else:
        print(f"Stage {config.stages[number].name} has ended: {why}.{_handed_on(stage, league_state)}\n")
    return True


def _handed_on(config: Config, league_state: LeagueState) -> str:
    """Return a sentence that names the snapshots that players pass on instead of their newest states, if any."""
    quota, against = config.rating.episodes_per_pair, config.budget.against
    found = [handed_on(league_state, player.name, quota, against) for player in league_state.players]
    older = [str(each) for each in found if each is not None]
    return f" Handed on instead of the newest: {'; '.join(older)}." if older else ""


def _warm_starts(store: Store, config: Config) -> list[str]:
    """Return a line for each player of a new league that starts from an earlier policy."""
    if not config.every_after or store.newest_checkpoints(config.league):
        return []
    found = warm_start.of_config(store, store.players(config.league), config)
    return warm_start.describe(found, store)


class _Reporter:
    """Printer of the league's state. At its first call the manager leads, and the printer records the run."""

    def __init__(self, store: Store, config: Config, config_toml: str, prepared: Prepared, on_lead: Callable[[], None]):
        self.store, self.config, self.prepared, self.on_lead = store, config, prepared, on_lead
        self.config_toml = config_toml
        self.ticker = Ticker(config)
        self.has_begun = False

    def __call__(self, *how: Any) -> None:
        if not self.has_begun:
            self.has_begun = True
            self.store.set_config(self.config.league, self.config_toml)
            self.store.start_run(self.config.league, self.config_toml, socket.gethostname(), {**versions(), **code()})
            starts = [f"  {line}" for line in (*_warm_starts(self.store, self.config), *self.prepared.starts)]
            print("\n".join([_greeting(self.config, self.prepared, self.store.where), *starts]), flush=True)
            self.on_lead()
        self.ticker(*how)


def _greeting(config: Config, prepared: Prepared, where: str) -> str:
    rated, pairings = prepared.rating
    sized = f"{_count(prepared.worlds, config.training.worlds)} worlds"
    if config.workers.match:
        batch = f"{_count(rated, config.rating.worlds)} episodes of {_count(pairings, config.rating.pairings)}"
        sized += f", rating batches of {batch} pairing{'s' * (pairings != 1)}"
    return (
        f"League {config.league}: {' against '.join(prepared.sides)} in {prepared.arena}, engine {prepared.engine},"
        f" {sized}; stored in {where}. Ctrl-C stops it, the same command continues."
    )


def _count(used: int, given: int | None) -> str:
    """Return a number of this run as text, marked if device and arena rather than a setting determined it."""
    return f"{used:,}" if given is not None else f"{used:,} (by device)"


def main() -> int:
    """Read a BackgroundRun from stdin and run it; write to the pipe named on the command line when it leads."""
    run = json.load(sys.stdin)
    spec = RunSpec(**run["spec"])
    prepared = Prepared.from_json(run["prepared"])

    def on_lead() -> None:
        with os.fdopen(int(sys.argv[1]), "w") as pipe:
            pipe.write("leads")

    return manage(spec, spec.config(), prepared, on_lead)


if __name__ == "__main__":
    from league.commands.cli import guarded

    sys.exit(guarded(main))
