"""Manage a league that is prepared, or a curriculum stage by stage: at the terminal, or in the background.

There it is a process of its own, `python -m league.commands.manage`.
"""

import json
import os
import socket
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from league import curriculum, heirs
from league.commands.progress import NEXT, Ticker, summary
from league.config import experiment as configuration
from league.config.experiment import Config
from league.daemon import DaemonError, Manager, Stage
from league.handover import Standby
from league.jobs import TrainingTurn
from league.memory import SHORT
from league.prepare import Prepared, standing_by
from league.versions import versions
from storage.store import Store


@dataclass(frozen=True)
class Task:
    """A league to manage: everything that a background process is told."""

    where: str  # the store
    blobs: str | None
    config: str  # TOML
    prepared: Prepared


def manage(task: Task, leads: Callable[[], None] = lambda: None, standby: Standby | None = None) -> int:
    """Run the league to the end of its budget or until it is stopped; `leads` is called when it has begun.

    Who stands by has prepared it. A curriculum is prepared here, stage by stage.

    Raises DaemonError where another process leads the league.
    """
    config = configuration.loads(task.config)
    with Store.open(task.where, blobs=task.blobs) as store:
        if config.stages:
            _walk(store, task, config, leads)
        elif _run(store, task.where, config, task.prepared, leads, standby) != "stopped":
            print(f"\n{summary(config, curriculum.standing(store, config))}")
            _refuse_set_aside(store, config)
    return 0


def _refuse_set_aside(store: Store, config: Config) -> None:
    """Raise DaemonError, one line, where a turn of training was set aside: its players have learnt no further.

    Where memory was short it says what would fit.
    """
    for job in store.jobs(config.league, "failed"):
        if job.kind == TrainingTurn.kind:
            why = (job.error or "no reason was given").strip().splitlines()[0]
            if why.startswith(SHORT):
                raise DaemonError(why)
            raise DaemonError(
                f"a turn of training was set aside, and who was to learn in it learnt no further: {why}"
                " (`league status` tells more; the same command tries it again)"
            )


def _run(
    store: Store, where: str, config: Config, prepared: Prepared, leads: Callable[[], None], standby: Standby | None
) -> Stage:
    """Manage one league; say where it is when it was stopped."""
    # The plan counts steps by the number of worlds; what the store keeps stays open, for a machine with another device.
    sized = replace(config, training=replace(config.training, worlds=prepared.worlds))
    phase = Manager(store, where, sized, standby).run(_Teller(store, config, prepared, leads))
    if phase == "stopped":
        at = curriculum.standing(store, config).newest
        told = f" at iteration {at.iteration}, {at.step:,} steps" if at else ""
        print(f"\nStopped{told}. Nothing is lost: the same command goes on.\n\n{NEXT}")
    return phase


def _walk(store: Store, task: Task, config: Config, leads: Callable[[], None]) -> None:
    """Run the stages one after the other, from the one that is under way.

    Raises DaemonError where a stage stands still and has not come to its end.
    """
    store.set_config(config.league, task.config)
    for number in range(curriculum.reached(store, config), len(config.stages)):
        stage = configuration.stage(config, number)
        standing = curriculum.standing(store, stage)
        last = number == len(config.stages) - 1
        if last or curriculum.ended(stage, standing) is None:
            with standing_by(task.where, stage) as (prepared, standby):
                ends = f"it ends {curriculum.until(stage)}"
                print(f"Stage {number + 1} of {len(config.stages)}, {config.stages[number].name}: {ends}.", flush=True)
                if _run(store, task.where, stage, prepared, leads, standby) == "stopped":
                    return
            leads, standing = (lambda: None), curriculum.standing(store, stage)
        why = curriculum.ended(stage, standing)
        _refuse_set_aside(store, stage)
        if why is None and not last:
            raise DaemonError(
                f"stage {config.stages[number].name} stands still before its end, and the next one does not begin:"
                f" `league status --league {stage.league}` tells why"
            )
        print(f"\n{summary(stage, standing)}" if last else f"Stage {config.stages[number].name} has ended: {why}.\n")


def _beginnings(store: Store, config: Config) -> list[str]:
    """What the players of a new league start from, where others came before it."""
    if not config.after or store.newest_checkpoints(config.league):
        return []
    return heirs.words(heirs.of(store, store.players(config.league), config.after, config.learner.critic_input))


class _Teller:
    """Prints how the league stands; when it first does so the manager leads, and the run is written down."""

    def __init__(self, store: Store, config: Config, prepared: Prepared, leads: Callable[[], None]):
        self.store, self.config, self.prepared, self.leads = store, config, prepared, leads
        self.ticker = Ticker(config)
        self.begun = False

    def __call__(self, *how: Any) -> None:
        if not self.begun:
            self.begun = True
            text = configuration.dumps(self.config)
            self.store.set_config(self.config.league, text)
            self.store.start_run(self.config.league, text, socket.gethostname(), versions())
            told = [f"  {line}" for line in _beginnings(self.store, self.config)]
            print("\n".join([_greeting(self.config, self.prepared, self.store.where), *told]), flush=True)
            self.leads()
        self.ticker(*how)


def _greeting(config: Config, prepared: Prepared, where: str) -> str:
    return (
        f"League {config.league}: {' against '.join(prepared.sides)} in {prepared.arena}, engine {prepared.engine};"
        f" stored in {where}. Ctrl-C stops it, the same command goes on."
    )


def main() -> int:
    """Read a task from stdin and manage it; say on the pipe named on the command line when it leads."""
    told = json.load(sys.stdin)
    task = Task(**{**told, "prepared": Prepared(**{**told["prepared"], "sides": tuple(told["prepared"]["sides"])})})

    def leads() -> None:
        with os.fdopen(int(sys.argv[1]), "w") as pipe:
            pipe.write("leads")

    return manage(task, leads)


if __name__ == "__main__":
    from league.cli import guarded

    sys.exit(guarded(main))
