"""The checks before a league runs that need jax, torch or mujoco, and the rows with which a league begins.

`prepare` starts a process for them, so that the manager never loads these libraries. The process builds the arena and
validates the configuration against the arena and this machine. Only then does it write the league, its players and the
scripted opponents, all of which may be there already. A configuration that it refuses leaves nothing behind. Then the
process ends, or becomes a train worker (`league/runtime/warm_worker.py`). `prepare_ahead` has it do all of this but for
the writing, while the stage before is still under way.
"""

import json
import os
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from arenas.description import describe_team
from league.config import experiment as configuration
from league.config import stages as parts
from league.config.experiment import Config
from league.config.run_spec import RunSpec
from league.config.schema import ConfigError
from league.runtime.bootstrap import create, validate_first_start, validate_stage_starts, validate_victims
from league.runtime.validation import early_restarts, validate
from league.runtime.warm_worker import WarmWorker, await_message, become_worker, can_become_worker
from league.snapshots.transfer import warm_start
from league.state.team_exchange import as_made, players_in
from league.system import devices, environment, exit_codes
from league.system.arena_build import Built, rating_batch, worlds
from league.system.batch_sizes import RATING
from storage.errors import NotAStore, StorageError, Unavailable
from storage.records import League, Player
from storage.store import Store

if TYPE_CHECKING:
    from arenas.arena import Arena


@dataclass(frozen=True)
class Prepared:
    """Facts about a prepared league for the manager and the greeting."""

    arena: str
    engine: str
    worlds: int  # simulated at once in training
    sides: tuple[str, ...]  # each team as text, e.g. blue (2 × leatherback)
    rating: tuple[int, int] = RATING["cpu"]  # worlds and pairings of a batch of rating matches
    starts: tuple[str, ...] = ()  # lines that a user should read first, as about robots that see other things now

    @classmethod
    def from_json(cls, found: Mapping[str, Any]) -> "Prepared":
        """Return the facts that `asdict` gave, read back from JSON, which has lists for tuples."""
        as_tuples = {name: tuple(found[name]) for name in ("sides", "rating", "starts")}
        return cls(**{**found, **as_tuples})


class PrepareError(Exception):
    """An error of the process that prepares a league: it died, by a fault that no setting explains.

    `transient`: it was killed, which may not happen the next time.
    """

    def __init__(self, message: str, transient: bool = False):
        super().__init__(message)
        self.transient = transient


_MODULE = "league.runtime.preflight"
LOOK = 1.0  # seconds between two checks for the parent

# In the manager's process --------------------------------------------------------------------------------------------


def prepare(spec: RunSpec, config: Config, debug: bool = False, imported: Sequence[str] = ()) -> Prepared:
    """Validate a configuration and write the rows with which a league begins, in a process of its own.

    `config` is the configuration that `spec` has as text. `imported` names snapshots that are imported into the league
    afterwards. Raises ConfigError, one line, for a configuration that cannot be run; Unavailable if the store is away;
    PrepareError if the process died. Ctrl-C ends both processes at once: nothing is lost, since nothing has been done.
    """
    with preparation(spec, config, debug, imported, keep=False) as (prepared, _):
        return prepared


@contextmanager
def preparation(
    spec: RunSpec, config: Config, debug: bool = False, imported: Sequence[str] = (), keep: bool = True,
    create: bool = True, ahead: WarmWorker | None = None,
) -> Iterator[tuple[Prepared, WarmWorker | None]]:  # fmt: skip
    """Prepare as `prepare` does, and keep the process if it can become the first train worker.

    The process ends with the context; without `keep` it has ended when the context begins. Without `create` a store
    that does not exist counts as away: a stage that begins on a disk that was unmounted meanwhile makes no new store
    below the mount point. `ahead` is a process that waits for the request, and is replaced if it has died.
    """
    keep = keep and can_become_worker(config)
    request = _request(spec, imported, keep, create)
    with ExitStack() as until_the_end:
        with _killed_by_signals() as children:

            def ask(process: WarmWorker) -> dict[str, Any]:
                children.append(process)
                until_the_end.callback(process.end)
                return process.ask(request)

            process, answer = ahead, ask(ahead) if ahead is not None else {}
            if process is None or not answer:
                process = WarmWorker(_MODULE, debug)
                answer = ask(process)
        if "refused" in answer:
            raise ConfigError(tuple(answer["key"]), answer["refused"])
        if "away" in answer:
            raise Unavailable(answer["away"])
        if "prepared" not in answer:
            code, last = process.exitcode, process.last_line()
            killed = code is not None and code < 0
            raise PrepareError(f"preparing the league failed (exit code {code}): {last}", transient=killed)
        if not keep:
            process.end()
        found = answer["prepared"]
        yield Prepared.from_json(found), process if keep else None


def prepare_ahead(spec: RunSpec, config: Config) -> WarmWorker | None:
    """Return a process that builds the arena of a later stage, imports all, and waits for `preparation`.

    None for a stage of which that process cannot become a worker.
    """
    if not can_become_worker(config):
        return None
    process = WarmWorker(_MODULE, debug=False)
    process.send({**_request(spec, (), keep=True, create=False), "ahead": True})
    return process


def _request(spec: RunSpec, imported: Sequence[str], keep: bool, create: bool) -> dict[str, Any]:
    return {"spec": asdict(spec), "parent": os.getpid(), "imported": list(imported), "keep": keep, "create": create}


@contextmanager
def _killed_by_signals() -> Iterator[list[WarmWorker]]:
    """Have Ctrl-C and SIGTERM end the processes in the list, and this process, within the context.

    An exception is not enough: Python drops one that a signal raises while a module is being imported.
    """
    children: list[WarmWorker] = []

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


# In the process that prepares ----------------------------------------------------------------------------------------


def _build_ahead(request: Mapping[str, Any]) -> Built | None:
    """Build the arena of a stage; None if that fails, which the stage reports when it begins, or a GPU is nearly full.

    The settings have been validated with the whole curriculum.
    """
    config = RunSpec(**request["spec"]).config()
    with suppress(Exception):
        if devices.has_room():
            return Built(validate(config), config, worlds(config))
    return None


def _prepare(request: Mapping[str, Any], ahead: Built | None) -> tuple[Prepared, Built]:
    """Do the work of `prepare`, and return also the arena that was built; of several stages, the first one's.

    `ahead` is the arena that this process has built before.
    """
    spec = RunSpec(**request["spec"])
    config = spec.config()
    stages = [configuration.stage(config, number) for number in range(len(config.stages))]
    arenas = []
    for number, each in enumerate(stages or [config]):
        try:
            arenas.append(_arena(each, players_in(spec.store, spec.blobs, each.league), ahead))
        except ConfigError as error:
            raise parts.of_stage(error, number, config.stages) if stages else error from None
    if os.getppid() != request["parent"]:
        raise PrepareError("the process that asked has gone; nothing was written")
    validate_stage_starts(spec.store, config, list(zip(stages or [config], arenas, strict=True)))
    first = (stages or [config])[0]
    if first.every_after:
        validate_first_start(spec.store, first, arenas[0])
    validate_victims(spec.store, first, arenas[0], request["imported"])
    with Store.open(spec.store, create=request["create"], blobs=spec.blobs) as store:
        if stages:  # each stage's league is made when the stage begins
            store.create_league(League(config.league, spec.config_toml))
        else:
            create(store, config, arenas[0], spec.config_toml)
        begins = config.every_after and not stages and not store.newest_checkpoints(config.league)
        starts = warm_start.fit_lines(store, config, arenas[0]) if begins else []
        starts += warm_start.changed_actions(store, config) if begins else []
    arena = arenas[0]
    sides = tuple(f"{t.name} ({describe_team(a.kind for a in t.agents)})" for t in arena.teams)
    count, batch = worlds(config), rating_batch(config)
    starts += [] if stages else early_restarts(config, arena, count)
    prepared = Prepared(arena.name, arena.engine.name, count, sides, batch, tuple(starts))
    return prepared, Built(arena, first, worlds(first))


def _arena(config: Config, players: Sequence[Player], ahead: Built | None) -> "Arena":
    """Return the validated arena of a league that has these players, the one built `ahead` if it is of this league."""
    if ahead is not None and ahead.config == config:
        return as_made(ahead.arena, players)
    return validate(config, players)


def _answer(request: Mapping[str, Any], ahead: Built | None) -> tuple[dict[str, Any], Built | None]:
    """Return the answer to a request, and the arena if the league has been prepared."""
    try:
        prepared, built = _prepare(request, ahead)
    except ConfigError as error:
        return {"refused": error.message, "key": error.key}, None
    except StorageError as error:
        gone = isinstance(error, NotAStore) and not request["create"]
        away = error.transient or gone
        return {"away": str(error)} if away else {"refused": str(error), "key": ()}, None
    return {"prepared": asdict(prepared)}, built


def _import_trainer() -> None:
    """Load torch and all else that a train worker needs, while the manager begins or the stage before goes on."""
    import league.training.trainer  # noqa: F401


def _end_with(parent: int | None, is_worker: threading.Event) -> None:
    """End this process when its parent is gone, even if it hangs; a worker first finishes its job."""
    while not is_worker.wait(LOOK):
        if os.getppid() != parent:
            os._exit(exit_codes.NO)


def main() -> None:
    """Read requests from stdin and answer them on stdout, in the process that `prepare` starts; then become a worker.

    A request for what is to be done ahead has no answer. The first request that is refused is the last.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it may reach the whole group; the parent decides
    environment.prepare()
    message, built = await_message(), None
    outputs, is_worker = message.get("outputs", ()), threading.Event()
    threading.Thread(target=_end_with, args=(message.get("parent"), is_worker), daemon=True).start()
    if message.get("keep"):
        devices.take(0)  # as the later worker does, before the import of a library that would take other GPUs
    with os.fdopen(os.dup(1), "w") as answer:
        os.dup2(2, 1)  # libraries print greetings on stdout
        while "spec" in message:
            if message.get("ahead"):
                built = _build_ahead(message)
                _import_trainer()
            else:
                said, built = _answer(message, built)
                print(json.dumps(said), file=answer, flush=True)
                if built is None or not message["keep"]:
                    return
                if not RunSpec(**message["spec"]).config().stages:  # else the request for the first stage follows
                    built.arena.engine.compile_ahead()  # while the rest is imported and the learners are made
                    _import_trainer()
            message = await_message()
    if message and built is not None:
        is_worker.set()
        become_worker(outputs, message, built)


if __name__ == "__main__":
    main()
