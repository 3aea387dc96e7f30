"""The contract of an arena as a function, for our arenas and for yours.

    for name, ok, detail in examine("duel.py:duel"):
        print(name, "ok" if ok else detail)

Each check is one function in `arenas/contract/checks.py`; they run in the order of that file.
"""

import inspect
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, NamedTuple, Unpack

import jax
from jax import Array

import arenas
from arenas.arena import Arena, Settings
from arenas.arena_settings import EngineOptions
from arenas.contract.check_run import WORLDS, CheckRun
from arenas.contract.checks import CHECKS, config_hash, reset_and_step
from arenas.contract.description_check import check_description
from arenas.contract.shape_checks import check_shapes
from arenas.errors import ArenaError, EngineError, RobotError, RosterError, describe_error, source_files
from arenas.physics.registry import resolve_engine

FOUND = "its file can be read and its settings build it"
SHAPES = "hooks give arrays of the declared names, shapes and types"
RUNS = "reset and step run under jit and vmap"
DESCRIPTION = "its description agrees with the arena"
BUFFERS = "Warp's buffers have room for untrained play"
UNLIKE = "equal teams count as unlike, with a ladder for each: they are not declared `exchangeable`"
ARENA_FAILURES = (Exception, SystemExit)  # raised by the arena's own code: a failed check, and the other checks go on


class CheckResult(NamedTuple):
    """Name of a check, its outcome, and the detail of a failure."""

    name: str
    ok: bool
    detail: str = ""


def examine(
    name: str, change: Callable[[Settings], Settings] | None = None, **options: Unpack[EngineOptions]
) -> list[CheckResult]:
    """Find an arena by name and run every check of the contract, including that the arena can be found and built.

    `change` turns its default settings into those to examine, such as those with terms of functions in files.

    Raises ArenaError or EngineError for names that lead nowhere, and for robots and robot files that are missing or
    wrong. An error in the arena's own code is a failed check.
    """
    resolve_engine(options.get("engine", "auto"))  # an engine that does not exist is no fault of the arena
    own = source_files(name)
    try:
        settings = arenas.settings(name)
    except ArenaError:
        raise
    except RosterError as error:
        raise ArenaError(f"arena {name}: {describe_error(error, own)}") from error
    except ARENA_FAILURES as error:
        return [CheckResult(FOUND, False, describe_error(error, own))]
    settings = settings if change is None else change(settings)
    own += _files(type(settings))
    try:
        arena = settings.build(**options | {"worlds": WORLDS})
    except EngineError:
        raise  # the engine cannot run here, whatever the arena
    except (RobotError, RosterError) as error:  # a wrong file beside the arena
        raise ArenaError(f"arena {name}: {describe_error(error, own)}") from error
    except ARENA_FAILURES as error:
        return [CheckResult(FOUND, False, describe_error(error, own))]
    if not isinstance(arena, Arena):
        return [CheckResult(FOUND, False, f"its build() returns {arena!r:.80}, which is no Arena")]
    arena.engine.prepare()()  # all cores compile a GPU's kernels; the first launches would compile one by one
    return [CheckResult(FOUND, True), *check_arena(arena, settings)]


def check_arena(arena: Arena, settings: Settings | None = None, *, key: Array | None = None) -> list[CheckResult]:
    """Run every check of the contract; `arena` must be built for at least WORLDS worlds.

    With the `settings` that it was built from, the configuration hash is checked too. The checks stop early if hooks,
    `reset` or `step` fail, or if Warp's buffers are too small. Raises nothing: an error in the arena's own code is a
    failed check, reported with the line of its file.
    """
    own = _files(type(arena), *([type(settings)] if settings else []))
    run = CheckRun(arena, jax.random.key(0) if key is None else key)
    try:
        problem = check_shapes(run)
        tried = [CheckResult(SHAPES, not problem, problem)]
    except ARENA_FAILURES as error:
        return [CheckResult(SHAPES, False, describe_error(error, own))]
    tried.append(_run_check(RUNS, reset_and_step, own, run))
    if not tried[-1].ok:
        return tried
    if arena.engine.name == "warp":
        tried.append(_run_check(BUFFERS, _untrained_play, own, arena))
        if not tried[-1].ok:
            return tried  # a full buffer changes the worlds, so later checks would report the wrong fault
    tried.append(_run_check(DESCRIPTION, check_description, own, run, settings))
    tried += [_run_check(name, problem, own, run) for name, problem in CHECKS.items()]
    if any(team.side_specific for team in arena.teams):
        tried.append(CheckResult(UNLIKE, True))
    if settings is not None:
        tried.append(_run_check("the configuration hash follows the rules", config_hash, own, arena, settings))
    return tried


def _run_check(name: str, problem: Callable[..., str], own: Collection[Path], *of: Any) -> CheckResult:
    try:
        detail = problem(*of)
    except ARENA_FAILURES as error:
        detail = describe_error(error, own)
    return CheckResult(name, not detail, detail)


def _untrained_play(arena: Arena) -> str:
    """Describe the buffers of Warp that are too small; empty if none is."""
    from arenas.contract import buffer_check  # MJX and Warp take seconds to import

    return buffer_check.problem(buffer_check.measure_untrained_play(arena))


def _files(*classes: type) -> list[Path]:
    """Return the source files of the classes and of their bases, except the contract's own."""
    every = [base for each in classes for base in each.__mro__ if base not in (Arena, object)]
    found = []
    for base in every:
        try:
            found.append(Path(inspect.getfile(base)).resolve())
        except (TypeError, OSError):
            continue  # built in
    return found
