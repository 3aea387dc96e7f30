"""What only the heavy half of the program can check before a league runs, and the rows with which a league begins.

`prepare` starts a process for it, so that the manager never loads jax, torch or mujoco. That process builds the arena,
examines the configuration against it and this machine, and only then writes: the league, its players and the scripted
opponents, all of which may be there already. What it refuses leaves nothing behind. Then it ends, or goes on as a train
worker (`league/handover.py`).
"""

import json
import os
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from typing import Any

from arenas.about import crowd
from league.config import experiment as configuration
from league.config.experiment import Config
from league.config.schema import ConfigError
from league.create import create, examine_beginning, examine_heritage, examine_victim, players_of
from league.examine import Built, examine, worlds
from league.handover import Standby, goes_on, stand_by
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
    with standing_by(where, config, debug, brought, stay=False) as (prepared, _):
        return prepared


@contextmanager
def standing_by(
    where: str, config: Config, debug: bool = False, brought: Sequence[str] = (), stay: bool = True
) -> Iterator[tuple[Prepared, Standby | None]]:
    """`prepare`, and the process that did so where it can go on as the first train worker; it ends with the context.

    Without `stay` it has ended as soon as it has prepared.
    """
    stay = stay and goes_on(config)
    request = {"where": where, "config": configuration.dumps(config), "parent": os.getpid(), "brought": list(brought)}
    with ExitStack() as until_the_end:
        with _ending_with_us() as children:
            process = Standby("league.prepare", debug)
            children.append(process)
            until_the_end.callback(process.end)
            answer = process.ask({**request, "stay": stay})
        if "refused" in answer:
            raise ConfigError(tuple(answer["key"]), answer["refused"])
        if "prepared" not in answer:
            code, last = process.exitcode, process.last_words()
            raise PrepareError(f"preparing the league failed (exit code {code}): {last}")
        if not stay:
            process.end()
        found = answer["prepared"]
        yield Prepared(**{**found, "sides": tuple(found["sides"])}), process if stay else None


@contextmanager
def _ending_with_us() -> Iterator[list[Standby]]:
    """Until this is over, Ctrl-C and SIGTERM end the processes in the list, and this one.

    An exception would not do: Python drops one that a signal raises while, say, a module is being imported.
    """
    children: list[Standby] = []

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


def _serve(request: Mapping[str, Any]) -> tuple[Prepared, Built]:
    """Do what `prepare` asks for; the arena that was built for it, of several stages the first one's."""
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
    return Prepared(arena.name, arena.engine.name, worlds(config), sides), Built(arena, first, worlds(first))


def main() -> None:
    """Read a request from stdin and answer it on stdout: the process that `prepare` starts."""
    from league import devices, environment
    from storage.errors import StorageError

    environment.prepare()
    request, built = json.loads(sys.stdin.readline()), None
    if request["stay"]:
        devices.take(0)  # as the worker that it becomes, before anything that would take others is imported
    with os.fdopen(os.dup(1), "w") as answer:
        os.dup2(2, 1)  # libraries greet on stdout
        try:
            prepared, built = _serve(request)
            told: dict[str, Any] = {"prepared": asdict(prepared)}
        except ConfigError as error:
            told = {"refused": error.message, "key": error.key}
        except StorageError as error:
            told = {"refused": str(error), "key": ()}
        answer.write(json.dumps(told) + "\n")
    if request["stay"] and built is not None:
        stand_by(request, built)


if __name__ == "__main__":
    main()
