"""Errors of arenas and engines, each with a one-line message, and a line about any error in a user's own file.

Loads nothing heavy.
"""

import importlib.util
import traceback
from collections.abc import Collection
from pathlib import Path

TRACED_IF = "TracerBoolConversionError"  # JAX's, by name: this module loads no JAX


class ArenaError(Exception):
    """A wrong arena name, setting or contract; the message is one line for the user."""


class TermError(ArenaError):
    """A fault in a term of a file; the message names the file and, where there is one, its line."""


class RobotError(ArenaError):
    """A robot file or model that is missing or wrong; the message names the file."""


class RosterError(ValueError):
    """A robot in a roster that is unknown or whose file is wrong; a ValueError, as of any value of a setting."""


class EngineError(Exception):
    """An engine that does not exist or cannot run here; the message is one line for the user."""


def describe_error(error: BaseException, files: Collection[Path]) -> str:
    """Describe an error and the last line of these files that led to it, e.g. `KeyError: 'no rotor' (duel.py:12)`."""
    if isinstance(error, TermError):
        return str(error)  # names its own file, which `files` may lack
    message = error.msg if isinstance(error, SyntaxError) else str(error)
    first = next(iter(message.splitlines()), "") or "no message"
    if type(error).__name__ == TRACED_IF:
        first = f"{first.rstrip('.')}; use jnp.where instead of `if` on an array"
    what = f"{type(error).__name__}: {first}"
    if isinstance(error, SystemExit):
        what = f"it exits with {error.code}"
    elif isinstance(error, (RobotError, RosterError)):
        what = first  # no fault of the program whose type would help to find it
    place = innermost_line(error, files)
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


def innermost_line(error: BaseException | None, files: Collection[Path]) -> str:
    """Return the innermost line of these files in an error's traceback, as file.py:12, or in its cause's."""
    if error is None:
        return ""
    frames = [(f.filename, f.lineno) for f in traceback.extract_tb(error.__traceback__)]
    if isinstance(error, SyntaxError) and error.filename:
        frames.append((error.filename, error.lineno))
    own = [f"{Path(name).name}:{line}" for name, line in frames if line and Path(name).resolve() in files]
    return own[-1] if own else innermost_line(error.__cause__, files)
