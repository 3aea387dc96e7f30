"""Arenas of environments, and their compiled programs: environments of equal settings share both while one lives."""

from collections.abc import Callable
from typing import Any, Unpack
from weakref import WeakValueDictionary

import jax

import arenas
from arenas.arena import Arena, Settings
from arenas.arena_settings import EngineOptions
from arenas.contract.environments.opponent import Opponent
from arenas.contract.environments.team_programs import Reset, Step, TeamRows, make_reset, make_step
from arenas.errors import ArenaError
from arenas.physics.interrupts import interruptible


class SharedArena:
    """An arena with the programs that environments have compiled so far. Each is compiled when it is first called."""

    def __init__(self, arena: Arena):
        arena.engine.prepare()()  # all cores compile a GPU's kernels; the first step would compile them one by one
        self.arena = arena
        self._programs: dict[object, Any] = {}

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Refuse to pickle or copy environments, all of which hold this."""
        raise ArenaError(
            f"an environment of {self.arena.name} cannot be pickled or copied, since its compiled programs belong to"
            " this process: pass on the function that makes it"
        )

    def program(self, name: object, make: Callable[[], Any]) -> Any:
        """Return the program of this name, made once. It raises KeyboardInterrupt if Ctrl-C stops the engine."""
        if name not in self._programs:
            self._programs[name] = interruptible(make())
        return self._programs[name]

    def world(self, method: str) -> Any:
        """Return the arena's `reset`, `step` or `privileged_state` for one world, compiled."""
        return self.program(method, lambda: jax.jit(getattr(self.arena, method)))

    def team_reset(self, rows: TeamRows) -> Reset:
        """Return the program that starts the worlds of a team's environment."""
        return self.program(("reset", rows.index, rows.shared), lambda: make_reset(self.arena, rows))

    def team_step(self, rows: TeamRows, opponent: Opponent) -> Step:
        """Return the program of a decision of a team's environment against such an opponent."""
        name = ("step", rows.index, rows.shared, opponent.act)
        return self.program(name, lambda: make_step(self.arena, rows, opponent.act))


_shared: WeakValueDictionary[object, SharedArena] = WeakValueDictionary()


def shared_arena(name: str | Settings, **options: Unpack[EngineOptions]) -> SharedArena:
    """Return the arena of this name or of these settings. Raises ArenaError or EngineError, one line."""
    settings = arenas.settings(name) if isinstance(name, str) else name
    if not hasattr(settings, "build"):
        raise ArenaError(f"{name!r:.80} is no arena: give a name ({', '.join(arenas.names())}) or arenas.settings(...)")
    key = (type(settings), settings, *sorted(options.items()))
    try:
        found = _shared.get(key)
    except TypeError:  # settings of one's own with a field that cannot be hashed
        return SharedArena(settings.build(**options))
    if found is None:
        _shared[key] = found = SharedArena(settings.build(**options))
    return found
