"""Bodies and rules: games, most of them with physics, behind one contract. Knows nothing of learning.

`names()` lists the arenas, `settings(name)` gives an arena's settings, `load(name)` builds it. An arena of your own
needs no registration: `path/to/duel.py:duel` names the arena `duel` of a file, `package.module:duel` that of a module.
"""

import difflib
import importlib
import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Unpack

if TYPE_CHECKING:
    from arenas.arena import Arena
    from arenas.options import Settings, Where

MODULES = ("arenas.sumo", "arenas.soccer", "arenas.galaga", "arenas.pursuit", "arenas.matrix")


def names() -> list[str]:
    """The arenas that come with the league."""
    return sorted(known())


def known() -> dict[str, "Settings"]:
    """Default settings of the arenas that come with the league, by name."""
    return {s.name: s for module in MODULES for s in importlib.import_module(module).ARENAS}


def settings(name: str) -> "Settings":
    """An arena's default settings. Raises ArenaError, one line with what exists, for an unknown name."""
    from arenas.errors import ArenaError

    where, _, own = name.rpartition(":")
    found = {s.name: s for s in _module(where).ARENAS} if where else known()
    if own in found:
        return replace(found[own], name=name)
    near = difflib.get_close_matches(own, found, 1)
    hint = f"did you mean {near[0]}? " if near else ""
    raise ArenaError(f"unknown arena {name!r}: {hint}(arenas: {', '.join(sorted(found))}; your own: file.py:name)")


def load(name: str, **where: Unpack["Where"]) -> "Arena":
    """An arena by name with its default settings."""
    return settings(name).build(**where)


def _module(where: str) -> ModuleType:
    """The module at a path or of a name; it lists its arenas' settings in `ARENAS`."""
    from arenas.errors import ArenaError

    if where.endswith(".py"):
        module = _file(Path(where))
    else:
        try:
            module = importlib.import_module(where)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{where}.".startswith(f"{error.name}."):
                raise  # the module is there, and something that it imports is not
            raise ArenaError(f"no arena module {where!r}: give a file such as my/duel.py:duel or a module") from error
    if not hasattr(module, "ARENAS"):
        raise ArenaError(f"{where} lists no arenas: it needs ARENAS = (settings, ...)")
    return module


def _file(path: Path) -> ModuleType:
    """The module in a file, run once in a process.

    It is listed in `sys.modules`, where dataclasses and the settings look for its types and for the notes under its
    fields, by its whole path, so that it hides no module of the same name.
    """
    from arenas.errors import ArenaError

    if not path.is_file():
        raise ArenaError(f"no arena file {path}: give a path such as my/duel.py:duel")
    name = str(path.resolve())
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
