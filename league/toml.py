"""A tree of frozen dataclasses as a commented TOML file, and back, with errors of one line.

`league/settings.py` says what the classes look like. TOML has no null: a setting that is None is written as a comment
where it would be None anyway, else as the word "none", which unsets any setting that may be None.
"""

import difflib
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, is_dataclass, replace
from typing import Any, Literal, TypeVar, get_args, get_origin

from league.settings import (
    UNSET,
    ConfigError,
    Key,
    absent,
    bounds,
    check,
    expected,
    hints,
    is_table,
    literal,
    notes,
    refuse,
    required,
    settings,
)
from league.toml_lines import key_lines

T = TypeVar("T")


def _element(kind: Any, index: int) -> Any:
    """Return the type of an element of a tuple type."""
    args = get_args(kind)
    return args[0] if args[-1] is ... else args[index]


def _as_floats(value: Any, kind: Any) -> Any:
    """Turn ints that stand in float fields into floats, so that the file shows the type."""
    if get_origin(kind) is tuple:
        return tuple(_as_floats(each, _element(kind, i)) for i, each in enumerate(value))
    return float(value) if kind is float else value


def _comment(lines: list[str]) -> str:
    return "".join(f"# {line}".rstrip() + "\n" for line in lines)


def _entry(field: Field, value: Any, default: Any, hint: Any, note: str, key: Key) -> str:
    """Write a setting under its comments: what it is, what it may be."""
    kind, optional = required(hint)
    lines = note.splitlines()
    if get_origin(kind) is Literal:
        lines.append(f"one of: {', '.join(map(literal, get_args(kind)))}")
    if limits := bounds(field):
        lines.append(limits)
    if optional and value == UNSET:
        raise refuse(key, value, "the word means that there is no value: use another one")
    if value is None and default is None:
        return _comment([*lines, f"{field.name} =  (unset)"])
    return _comment(lines) + f"{field.name} = {literal(UNSET if value is None else _as_floats(value, kind))}\n"


def _paragraphs(config: Any, base: Any, key: Key) -> Iterator[str]:
    summary, found = notes(type(config))
    if head := _comment([summary] if summary else []) + (f"[{'.'.join(key)}]\n" if key else ""):
        yield head
    tables = []  # they come last: what follows a table's header belongs to it
    for field in settings(config):
        value, default, inner = getattr(config, field.name), absent(field, base), (*key, field.name)
        if is_table(value):
            tables.append((value, default if type(default) is type(value) else None, inner))
        else:
            yield _entry(field, value, default, hints(type(config))[field.name], found.get(field.name, ""), inner)
    for table in tables:
        yield from _paragraphs(*table)


def dumps(config: Any) -> str:
    """Write a tree of dataclasses as TOML in which every setting is explained; `loads` gives back an equal tree."""
    return "\n".join(_paragraphs(config, None, ()))


def _convert(value: Any, hint: Any) -> Any:
    """Turn what `tomllib` read into the type of a field; raises ValueError where that is not possible."""
    kind, optional = required(hint)
    if optional and value == UNSET:
        return None
    args = get_args(kind)
    if get_origin(kind) is Literal and any(value == arg and type(value) is type(arg) for arg in args):
        return value
    if get_origin(kind) is tuple and isinstance(value, list) and (args[-1] is ... or len(args) == len(value)):
        return tuple(_convert(each, _element(kind, i)) for i, each in enumerate(value))
    if kind is float and type(value) is int:
        return float(value)
    if kind in (int, float, bool, str) and type(value) is kind:
        return value
    raise ValueError


def _keys(cls: type, base: Any, prefix: Key = ()) -> Iterator[Key]:
    for field in settings(cls):
        key, default = (*prefix, field.name), absent(field, base)
        yield key
        kind = type(default) if is_table(default) else required(hints(cls)[field.name])[0]
        if isinstance(kind, type) and is_dataclass(kind):
            yield from _keys(kind, default, key)


def _unknown(key: Key, names: Mapping[str, Field], everywhere: list[Key]) -> ConfigError:
    """Name the key that was probably meant: a similar one of this table, else of any."""
    similar = [(*key[:-1], name) for name in difflib.get_close_matches(key[-1], names, 1)]
    if not similar:
        last_names = {each[-1]: each for each in reversed(everywhere)}
        similar = [last_names[name] for name in difflib.get_close_matches(key[-1], last_names, 1)]
    meant = f"did you mean {'.'.join(similar[0])}? " if similar else ""
    return ConfigError(key, f"unknown key {'.'.join(key)}: {meant}(keys: {', '.join(names)})")


def _build(cls: type, table: dict[str, Any], base: Any, prefix: Key, everywhere: list[Key]) -> Any:
    known, values = {field.name: field for field in settings(cls)}, {}
    for name, value in table.items():
        key = (*prefix, name)
        if name not in known:
            raise _unknown(key, known, everywhere)
        hint, default = hints(cls)[name], absent(known[name], base)
        kind = type(default) if is_table(default) else required(hint)[0]
        if isinstance(kind, type) and is_dataclass(kind) and isinstance(value, dict):
            values[name] = _build(kind, value, default, key, everywhere)
            continue
        try:
            values[name] = _convert(value, hint)
        except ValueError:
            raise refuse(key, value, f"expected {expected(hint)}") from None
    for name, field in known.items():
        if name not in values and absent(field, base) is MISSING:
            key = (*prefix, name)
            raise ConfigError(key, f"{'.'.join(key)} is missing: expected {expected(hints(cls)[name])}")
    try:
        return replace(base, **values) if is_table(base) else cls(**values)
    except ValueError as error:
        name, colon, reason = str(error).partition(": ")
        if colon and name in known:
            raise refuse((*prefix, name), values.get(name, absent(known[name], base)), reason) from None
        raise ConfigError(prefix, ": ".join(filter(None, (".".join(prefix), str(error))))) from None


def parse(text: str, source: str = "league.toml") -> dict[str, Any]:
    """Read TOML as dictionaries; raises ConfigError, one line with the file and the line, where it is not TOML."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        what, _, where = str(error).rpartition(" (at ")
        found = re.match(r"line (\d+), column (\d+)", where)
        line, column = (found[1], f" (column {found[2]})") if found else (len(text.splitlines()), "")
        raise ConfigError((), f"not TOML: {what}{column}", f"{source}:{line}: ") from None


def loads(text: str, cls: type[T], source: str = "league.toml", base: T | None = None) -> T:
    """Read a tree of dataclasses from TOML; what the text does not name is as in `base`, else the default.

    Where the base or the default holds a table, that table's own class is read: a field may be of several classes.

    Raises:
        ConfigError: one line with the file, the line, the key, the value given and what is possible.
    """
    table = parse(text, source)
    cls = cls if base is None else type(base)
    try:
        config = _build(cls, table, base, (), list(_keys(cls, base)))
        check(config)
    except ConfigError as error:
        lines, key = key_lines(text), error.key
        line = next((f":{lines[key[:depth]]}" for depth in range(len(key), 0, -1) if key[:depth] in lines), "")
        raise ConfigError(key, error.message, f"{source}{line}: ") from None
    return config
