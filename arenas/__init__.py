"""Robot League's arenas: games, most of them with physics, behind one contract. Independent of learning.

`names()` lists the arenas, `settings(name)` returns an arena's settings, `load(name)` builds it. An arena of your own
needs no registration: `path/to/duel.py:duel` names the arena `duel` of a file, `package.module:duel` that of a module.

`pettingzoo(name)`, `vector(name, team, opponent)`, `stable_baselines` and `single` of the same arguments are
environments for learners of your own (docs/environments.md).
"""

import difflib
import hashlib
import importlib
import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Unpack

if TYPE_CHECKING:
    from arenas.arena import Arena, Settings
    from arenas.arena_settings import EngineOptions
    from arenas.contract.environments.parallel_env import WorldEnv
    from arenas.contract.environments.single_env import TeamEnv
    from arenas.contract.environments.stable_baselines import StableBaselinesEnv
    from arenas.contract.environments.vector_env import Choice, TeamVectorEnv

MODULES = (
    "arenas.games.sumo",
    "arenas.games.walk",
    "arenas.games.disturbance",
    "arenas.games.bansal",
    "arenas.games.soccer",
    "arenas.games.galaga",
    "arenas.games.pursuit",
    "arenas.games.pursuit.swarm",
    "arenas.games.tag",
    "arenas.games.race",
    "arenas.games.matrix",
    "arenas.games.matrix.turns",
)


def names() -> list[str]:
    """Return the names of the arenas that come with the league, sorted."""
    return sorted(known())


def known() -> dict[str, "Settings"]:
    """Return the default settings of the arenas that come with the league, by name."""
    return {s.name: s for module in MODULES for s in importlib.import_module(module).ARENAS}


def settings(name: str) -> "Settings":
    """Return an arena's default settings. Raises ArenaError, which lists the known arenas, if unknown."""
    from arenas.errors import ArenaError

    where, _, own = name.rpartition(":")
    found = {s.name: s for s in _module(where).ARENAS} if where else known()
    if own in found:
        return replace(found[own], name=name)
    if name.endswith(".py"):
        each = ", ".join(f"{name}:{s.name}" for s in _module(name).ARENAS)
        raise ArenaError(f"{name} is a file: name an arena in it: {each}")
    if name.endswith(".toml"):
        raise ArenaError(
            f"{name} is a file of settings, and an arena is asked for: give its arena.name, and to a command its other"
            " settings as flags, such as --arena.rules.episode"
        )
    near = difflib.get_close_matches(own, found, 1)
    hint = f": did you mean {near[0]}?" if near else ""
    raise ArenaError(f"unknown arena {name!r}{hint} (arenas: {', '.join(sorted(found))}; your own: file.py:name)")


def load(name: str, **options: Unpack["EngineOptions"]) -> "Arena":
    """Build an arena by name with its default settings."""
    return settings(name).build(**options)


def pettingzoo(
    name: "str | Settings", *, shaping: float = 1.0, void_penalty: float = 1.0, action_limit: float = 1.0,
    render_mode: str | None = None, **options: Unpack["EngineOptions"],
) -> "WorldEnv":  # fmt: skip
    """Return one world of an arena as a PettingZoo `ParallelEnv` of all agents, on the C engine by default.

    Args:
        name: the arena's name, or its settings where the rules should differ.
        shaping: weight of the dense reward in the reward.
        void_penalty: price of a world whose physics the agent's own team made fail.
        action_limit: bound of the action spaces. Robots clip their actions to ±1, except ANYmal, MiniTank and HARL-A's
            rovers, which follow greater ones too.
        render_mode: None; environments draw nothing.
        options: engine, threads and buffers.

    Raises ArenaError or EngineError, one line.
    """
    _require("pettingzoo", "gymnasium")
    from arenas.contract.environments.parallel_env import WorldEnv

    return WorldEnv(name, shaping, void_penalty, action_limit, render_mode, **{"engine": "c", "threads": 1, **options})


def vector(
    name: "str | Settings", team: str, opponent: "Choice" = None, *, num_envs: int = 1, **options: Any
) -> "TeamVectorEnv":
    """Return many worlds of an arena as a Gymnasium `VectorEnv`, in which a team learns against an opponent.

    Args:
        name: the arena's name, or its settings where the rules should differ.
        team: the team that learns, e.g. `blue`.
        opponent: player of the other team, none in an arena of one team: the name of a script, `league.opponent(...)`
            for a snapshot or a policy's file, or a function in JAX: ({agent: observation (obs,)}, key) -> {agent:
            action (act,)}. With several other teams it plays each of them; {team: player} names one for each.
        num_envs: rows of the batch.
        options: `agents`: "joint", where a row is a world and has all observations and actions of the team, one agent
            after the other, or "shared", where each agent of a team of equal robots is a row of its own; `arrays`:
            "numpy", "jax" or "torch"; `shaping`, `void_penalty`, `action_limit` and the engine's as for `pettingzoo`.

    Raises ArenaError or EngineError, one line.
    """
    _require("gymnasium")
    from arenas.contract.environments.vector_env import TeamVectorEnv

    return TeamVectorEnv(name, team, opponent, num_envs, **options)


def single(name: "str | Settings", team: str, opponent: "Choice" = None, **options: Any) -> "TeamEnv":
    """Return one world as a Gymnasium `Env` of a team; arguments are those of `vector`. It is far slower per world."""
    _require("gymnasium")
    from arenas.contract.environments.single_env import TeamEnv

    return TeamEnv(name, team, opponent, **options)


def stable_baselines(
    name: "str | Settings", team: str, opponent: "Choice" = None, *, num_envs: int = 1, **options: Any
) -> "StableBaselinesEnv":
    """Return many worlds as a `VecEnv` of Stable-Baselines3; arguments are those of `vector`, arrays are NumPy's."""
    from arenas.errors import ArenaError

    _require("gymnasium")
    if importlib.util.find_spec("stable_baselines3") is None:
        raise ArenaError("this environment needs another package: pip install stable-baselines3")
    if options.get("arrays", "numpy") != "numpy":
        raise ArenaError(f"arrays={options['arrays']!r:.40}: Stable-Baselines3 takes NumPy's, so leave it out")
    from arenas.contract.environments.stable_baselines import StableBaselinesEnv

    return StableBaselinesEnv(vector(name, team, opponent, num_envs=num_envs, **options))


def _require(*packages: str) -> None:
    """Raise ArenaError for a package of the extra `envs` that is not installed."""
    from arenas.errors import ArenaError

    for package in packages:
        if importlib.util.find_spec(package) is None:
            raise ArenaError(f"environments need the package {package}: pip install 'robot-league[envs]'")


def _module(where: str) -> ModuleType:
    """Import the module at a path or of a name. The module must list its arenas' settings in `ARENAS`."""
    from arenas.errors import ArenaError

    if where.endswith(".py"):
        module = python_file(Path(where))
    else:
        try:
            module = importlib.import_module(where)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{where}.".startswith(f"{error.name}."):
                raise  # the module exists, but a module that it imports does not
            raise ArenaError(f"no arena module {where!r}: give a file such as my/duel.py:duel or a module") from error
    if not hasattr(module, "ARENAS"):
        raise ArenaError(f"{where} lists no arenas: it needs ARENAS = (settings, ...)")
    if not isinstance(module.ARENAS, (tuple, list)):
        raise ArenaError(f"{where}: ARENAS is a {type(module.ARENAS).__name__}: it needs ARENAS = (settings, ...)")
    names = [each.name for each in module.ARENAS]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise ArenaError(f"{where}: two of its ARENAS are named {twice}: give one of them another name")
    return module


def python_file(path: Path) -> ModuleType:
    """Import the module in a file, once per process.

    The module is registered in `sys.modules`, where dataclasses and the settings look for its types and for the notes
    under its fields. Its key is made of the whole path, so that it hides no module of the same name, and is an
    identifier, without which TorchScript compiles no class of the file.
    """
    from arenas.errors import ArenaError

    if not path.is_file():
        raise ArenaError(f"no arena file {path}: give a path such as my/duel.py:duel")
    name = f"file_{hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:16]}"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None
        assert spec.loader is not None
        sys.modules[name] = importlib.util.module_from_spec(spec)
        try:
            spec.loader.exec_module(sys.modules[name])
        except BaseException:
            del sys.modules[name]
            raise
    return sys.modules[name]
