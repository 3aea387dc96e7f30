"""The contract of an arena as a callable, for our arenas and for yours.

    for name, ok, detail in examine("duel.py:duel"):
        print(name, "ok" if ok else detail)

Each promise is one function in `arenas/promises.py`, in the order in which they are tried.
"""

import inspect
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, NamedTuple, Unpack

import jax
from jax import Array

import arenas
from arenas.arena import Arena
from arenas.blame import blame, sources
from arenas.engines import choose
from arenas.errors import ArenaError, EngineError
from arenas.hooks import hooks
from arenas.options import Settings, Where
from arenas.promises import PROMISES, config_hash, runs
from arenas.told import told
from arenas.trial import WORLDS, Trial

FOUND = "its file can be read and its settings build it"
HOOKS = "hooks give arrays of the declared names, shapes and types"
BASIS = "reset and step run under jit and vmap"
TOLD = "what it says about itself is so"
Broken = (Exception, SystemExit)  # what an arena's own code may raise: a promise broken, and not the end of the check


class Promise(NamedTuple):
    """One property of an arena and whether it holds."""

    name: str
    ok: bool
    detail: str = ""


def examine(name: str, **where: Unpack[Where]) -> list[Promise]:
    """Find an arena by name and try every promise of the contract, that it can be found and built first.

    Raises ArenaError or EngineError for names that lead nowhere; what the arena's own code raises is a promise broken.
    """
    choose(where.get("engine", "auto"))  # an engine that does not exist is no fault of the arena
    own = sources(name)
    try:
        settings = arenas.settings(name)
    except ArenaError:
        raise
    except Broken as error:
        return [Promise(FOUND, False, blame(error, own))]
    own += _files(type(settings))
    try:
        arena = settings.build(**where | {"worlds": WORLDS})
    except EngineError:
        raise  # it cannot run here, whatever the arena
    except Broken as error:
        return [Promise(FOUND, False, blame(error, own))]
    return [Promise(FOUND, True), *check_arena(arena, settings)]


def check_arena(arena: Arena, settings: Settings | None = None, *, key: Array | None = None) -> list[Promise]:
    """Try every promise of the contract; `arena` is built for at least WORLDS worlds.

    With the `settings` that it was built from, the configuration hash is tried too. Where the hooks or `reset` and
    `step` do not even run, that is the last promise told. Raises nothing: what an arena's own code raises is a promise
    broken, told with the line of its own file.
    """
    own = _files(type(arena), *([type(settings)] if settings else []))
    trial = Trial(arena, jax.random.key(0) if key is None else key)
    try:
        problem = hooks(trial)
        tried = [Promise(HOOKS, not problem, problem)]
    except Broken as error:
        return [Promise(HOOKS, False, blame(error, own))]
    tried.append(_try(BASIS, runs, own, trial))
    if not tried[-1].ok:
        return tried
    tried.append(_try(TOLD, told, own, trial, settings))
    tried += [_try(name, problem, own, trial) for name, problem in PROMISES.items()]
    if settings is not None:
        tried.append(_try("the configuration hash follows the rules", config_hash, own, arena, settings))
    return tried


def _try(name: str, problem: Callable[..., str], own: Collection[Path], *of: Any) -> Promise:
    try:
        detail = problem(*of)
    except Broken as error:
        detail = blame(error, own)
    return Promise(name, not detail, detail)


def _files(*classes: type) -> list[Path]:
    """The files in which the classes and what they inherit from are written, the contract's own left out."""
    every = [base for each in classes for base in each.__mro__ if base not in (Arena, object)]
    found = []
    for base in every:
        try:
            found.append(Path(inspect.getfile(base)).resolve())
        except (TypeError, OSError):
            continue  # built in
    return found
