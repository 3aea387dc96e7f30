"""Physics engines: MuJoCo's C engine, MJX and Warp behind one interface.

For one release, the names of the former module `arenas.physics` can still be imported from here; import them from
`arenas.physics.engine`. They load on first use, because the package also holds modules that load nothing heavy.
"""

from importlib import import_module
from typing import Any

_FORMER = ("DERIVED", "DYNAMICS", "KINEMATICS", "MAX_SPEED", "VARIABLE", "Engine", "Physics")


def __getattr__(name: str) -> Any:
    if name not in _FORMER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("arenas.physics.engine"), name)
