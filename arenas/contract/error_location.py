"""One-line description of an error, with the line in the user's own arena file. Loads nothing heavy."""

import importlib.util
import traceback
from collections.abc import Collection
from pathlib import Path


def describe_error(error: BaseException, files: Collection[Path]) -> str:
    """Describe an error and the last line of these files that led to it, e.g. `KeyError: 'no rotor' (duel.py:12)`."""
    message = error.msg if isinstance(error, SyntaxError) else str(error)
    first = next(iter(message.splitlines()), "") or "no message"
    what = f"it exits with {error.code}" if isinstance(error, SystemExit) else f"{type(error).__name__}: {first}"
    place = _place(error, files)
    return f"{what} ({place})" if place else what


def source_files(arena: str) -> list[Path]:
    """Return the file of an arena's name (`my/duel.py:duel` or `package.module:duel`); none for the league's arenas."""
    where, _, _ = arena.rpartition(":")
    if where.endswith(".py"):
        return [Path(where).resolve()]
    try:
        spec = importlib.util.find_spec(where) if where else None
    except (ImportError, ValueError):
        return []
    return [Path(spec.origin).resolve()] if spec is not None and spec.origin else []


def _place(error: BaseException | None, files: Collection[Path]) -> str:
    """Return the innermost line of these files in an error's traceback, as file.py:12, or in its cause's."""
    if error is None:
        return ""
    frames = [(f.filename, f.lineno) for f in traceback.extract_tb(error.__traceback__)]
    if isinstance(error, SyntaxError) and error.filename:
        frames.append((error.filename, error.lineno))
    own = [f"{Path(name).name}:{line}" for name, line in frames if line and Path(name).resolve() in files]
    return own[-1] if own else _place(error.__cause__, files)
