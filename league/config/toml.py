"""A tree of frozen dataclasses as a commented TOML file, and back, with errors of one line.

`league/config/schema.py` says what the classes look like. TOML has no null: a setting that is None is written as a
comment where it would be None anyway, else as the word "none", which unsets any setting that may be None. Python's own
`tomllib` reads; on which line a key stands no TOML library tells, so that is found by `league/config/toml_lines.py`.
"""

import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import Field
from typing import Any, Literal, TypeVar, get_args, get_origin

from league.config.build import build
from league.config.schema import (
    UNSET,
    ConfigError,
    Key,
    absent,
    bounds,
    element,
    hints,
    is_table,
    literal,
    notes,
    refuse,
    required,
    settings,
    table_of,
)
from league.config.toml_lines import key_lines

T = TypeVar("T")


def _as_floats(value: Any, kind: Any) -> Any:
    """Turn ints that stand in float fields into floats, so that the file shows the type."""
    if get_origin(kind) is tuple:
        return tuple(_as_floats(each, element(kind, i)) for i, each in enumerate(value))
    return float(value) if kind is float else value


def _comment(lines: list[str]) -> str:
    return "".join(f"# {line}".rstrip() + "\n" for line in lines)


def _entry(field: Field, value: Any, default: Any, hint: Any, note: str, key: Key) -> str:
    """Write a setting under its comments: what it is, what it may be."""
    kind, optional = required(hint)
    lines = note.splitlines()
    if get_origin(kind) is Literal:
        lines.append(f"one of: {', '.join(map(literal, get_args(kind)))}")
    if limits := bounds(field.metadata):
        lines.append(limits)
    if optional and value == UNSET:
        raise refuse(key, value, "the word means that there is no value: use another one")
    if value is None and default is None:
        return _comment([*lines, f"{field.name} =  (unset)"])
    return _comment(lines) + f"{field.name} = {literal(UNSET if value is None else _as_floats(value, kind))}\n"


def _paragraphs(config: Any, base: Any, key: Key, header: str = "") -> Iterator[str]:
    summary, found = notes(type(config))
    if head := _comment([summary] if summary else []) + header:
        yield head
    tables: list[Iterator[str]] = []  # they come last: what follows a table's header belongs to it
    for field in settings(config):
        value, default, inner = getattr(config, field.name), absent(field, base), (*key, field.name)
        name = ".".join(inner)
        hint, note = hints(type(config))[field.name], found.get(field.name, "")
        if is_table(value):
            same = default if type(default) is type(value) else None
            tables.append(_paragraphs(value, same, inner, f"[{name}]\n"))
        elif isinstance(value, tuple) and table_of(hint) is not None:
            if value:
                tables += [_paragraphs(each, None, inner, f"[[{name}]]\n") for each in value]
            else:
                yield _comment(note.splitlines()) + (
                    _comment([f"{field.name} =  (none; each begins with [[{name}]])"])
                    if default == ()
                    else f"{field.name} = []\n"
                )
        else:
            yield _entry(field, value, default, hint, note, inner)
    for table in tables:
        yield from table


def dumps(config: Any, base: Any = None) -> str:
    """Write a tree of dataclasses as TOML in which every setting is explained.

    `loads` gives back an equal tree, if it is given the same `base`.
    """
    return "\n".join(_paragraphs(config, base, ()))


def parse(text: str, source: str = "league.toml") -> dict[str, Any]:
    """Read TOML as dictionaries; raises ConfigError, one line with the file and the line, where it is not TOML."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        told = isinstance(error, tomllib.TOMLDecodeError)
        what, _, where = str(error if told else "too many digits, or brackets within brackets").partition(" (at ")
        found = re.match(r"line (\d+), column (\d+)", where)
        line, column = (found[1], f" (column {found[2]})") if found else (len(text.splitlines()), "")
        raise ConfigError((), f"not TOML: {what}{column}", f"{source}:{line}: ") from None


def loads(text: str, cls: type[T], source: str = "league.toml", base: T | None = None) -> T:
    """Read a tree of dataclasses from TOML; see `build` for what the text does not name.

    Raises:
        ConfigError: one line with the file, the line, the key, the value given and what is possible.
    """
    return located(parse(text, source), cls, text, source, base)


def located(table: Mapping[str, Any], cls: type[T], text: str, source: str, base: T | None = None) -> T:
    """`build`, with the place in `text`, where what is wrong stands, before its errors."""
    try:
        return build(cls, table, base)
    except ConfigError as error:
        raise ConfigError(error.key, error.message, f"{place(error.key, text, source)}: ") from None


def place(key: Key, text: str, source: str) -> str:
    """The file and, if the key or a table round it is named there, the line."""
    lines = key_lines(text)
    line = next((f":{lines[key[:depth]]}" for depth in range(len(key), 0, -1) if key[:depth] in lines), "")
    return f"{source}{line}"
