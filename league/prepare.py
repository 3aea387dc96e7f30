"""What only the heavy half of the program can check before a league runs, and the rows with which a league begins.

`prepare` starts a short-lived process, so that the one that stays, the manager, never loads jax, torch or mujoco. That
process builds the arena, examines the configuration against it and this machine, and only then writes: the league, its
players and the scripted opponents, all of which may be there already. What it refuses leaves nothing behind.
"""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

from arenas.about import crowd
from league.config import experiment as configuration
from league.config.experiment import Config
from league.config.schema import ConfigError
from league.create import create, examine_beginning, examine_heritage, examine_victim, players_of
from league.examine import examine, worlds
from storage.records import League
from storage.store import Store


@dataclass(frozen=True)
class Prepared:
    """What a league's front needs to know of the heavy half."""

    arena: str
    engine: str
    worlds: int  # simulated at once in training
    sides: tuple[str, ...]  # each team in words, e.g. blue (2 × leatherback)


class PrepareError(Exception):
    """The process that prepares a league died, or hit a fault that is nobody's setting."""


# The light half ------------------------------------------------------------------------------------------------------


def prepare(where: str, config: Config, debug: bool = False, brought: Sequence[str] = ()) -> Prepared:
    """Examine a configuration and write what a league begins with, in a process of its own.

    `brought` are snapshots that will be brought into the league when all is well. Raises ConfigError, one line, for
    what cannot be; PrepareError where the process died. Ctrl-C ends both processes at once: nothing is lost, since
    nothing has been done.
    """
    request = {"where": where, "config": configuration.dumps(config), "parent": os.getpid(), "brought": list(brought)}
    with _ending_with_us() as children:
        process = subprocess.Popen(
            [sys.executable, "-m", "league.prepare"], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=None if debug else subprocess.PIPE, text=True,
        )  # fmt: skip
        children.append(process)
        out, err = process.communicate(json.dumps(request))
    answer = json.loads(out or "{}")
    if "refused" in answer:
        raise ConfigError(tuple(answer["key"]), answer["refused"])
    if "prepared" not in answer:
        last = (err or "").strip().splitlines()[-1:] or ["it said nothing"]
        raise PrepareError(f"preparing the league failed (exit code {process.returncode}): {last[0]}")
    found = answer["prepared"]
    return Prepared(**{**found, "sides": tuple(found["sides"])})


@contextmanager
def _ending_with_us() -> Iterator[list[subprocess.Popen[str]]]:
    """Until this is over, Ctrl-C and SIGTERM end the processes in the list, and this one.

    An exception would not do: Python drops one that a signal raises while, say, a module is being imported.
    """
    children: list[subprocess.Popen[str]] = []

    def leave(number: int, frame: object) -> None:
        for process in children:
            process.kill()
        os.write(2, b"\nleague: stopped before it began; nothing was lost.\n")
        os._exit(128 + number)

    before = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)}
    before = {s: handler for s, handler in before.items() if handler not in (signal.SIG_IGN, None)}
    for number in before:
        signal.signal(number, leave)
    try:
        yield children
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# The heavy half ------------------------------------------------------------------------------------------------------


def _serve(request: Mapping[str, Any]) -> Prepared:
    """Do what `prepare` asks for."""
    config = configuration.loads(request["config"])
    stages = [configuration.stage(config, number) for number in range(len(config.stages))]
    arenas = [examine(each) for each in stages or [config]]
    if os.getppid() != request["parent"]:
        raise PrepareError("the process that asked has gone; nothing was written")
    examine_heritage(request["where"], config, list(map(players_of, stages or [config], arenas)))
    first = (stages or [config])[0]
    if first.after:
        examine_beginning(request["where"], first, arenas[0])
    examine_victim(request["where"], first, arenas[0], request["brought"])
    with Store.open(request["where"], create=True, blobs=config.storage.blobs) as store:
        if stages:  # each is made when it is its turn
            store.create_league(League(config.league, configuration.dumps(config)))
        else:
            create(store, config, arenas[0])
    arena = arenas[0]
    sides = tuple(f"{t.name} ({crowd(a.kind for a in t.agents)})" for t in arena.teams)
    return Prepared(arena.name, arena.engine.name, worlds(config), sides)


def main() -> None:
    """Read a request from stdin and answer it on stdout: the process that `prepare` starts."""
    from league import environment
    from storage.errors import StorageError

    environment.prepare()
    with os.fdopen(os.dup(1), "w") as answer:
        os.dup2(2, 1)  # libraries greet on stdout
        try:
            told: dict[str, Any] = {"prepared": asdict(_serve(json.load(sys.stdin)))}
        except ConfigError as error:
            told = {"refused": error.message, "key": error.key}
        except StorageError as error:
            told = {"refused": str(error), "key": ()}
        json.dump(told, answer)


if __name__ == "__main__":
    main()
