"""Where in a person's own arena file something went wrong, in one line. Loads nothing heavy."""

import importlib.util
import traceback
from collections.abc import Collection
from pathlib import Path


def blame(error: BaseException, files: Collection[Path]) -> str:
    """What was raised, and the last line of those files that led there, e.g. `KeyError: 'no rotor' (duel.py:12)`."""
    told = error.msg if isinstance(error, SyntaxError) else str(error)
    first = next(iter(told.splitlines()), "") or "no message"
    what = f"it exits with {error.code}" if isinstance(error, SystemExit) else f"{type(error).__name__}: {first}"
    place = _place(error, files)
    return f"{what} ({place})" if place else what


def sources(arena: str) -> list[Path]:
    """The file that an arena's name leads to: `my/duel.py:duel`, `package.module:duel`; none for one of ours."""
    where, _, _ = arena.rpartition(":")
    if where.endswith(".py"):
        return [Path(where).resolve()]
    try:
        spec = importlib.util.find_spec(where) if where else None
    except (ImportError, ValueError):
        return []
    return [Path(spec.origin).resolve()] if spec is not None and spec.origin else []


def _place(error: BaseException | None, files: Collection[Path]) -> str:
    """The innermost line of the files in an error's traceback, as file.py:12; else in that of what caused the error."""
    if error is None:
        return ""
    frames = [(f.filename, f.lineno) for f in traceback.extract_tb(error.__traceback__)]
    if isinstance(error, SyntaxError) and error.filename:
        frames.append((error.filename, error.lineno))
    own = [f"{Path(name).name}:{line}" for name, line in frames if line and Path(name).resolve() in files]
    return own[-1] if own else _place(error.__cause__, files)
