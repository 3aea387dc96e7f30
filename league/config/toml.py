"""Conversion of a tree of frozen dataclasses to a commented TOML file and back, with errors of one line.

`league/config/schema.py` describes the classes. TOML has no null: a setting that is None is written as a comment if its
default is None, else as the word "none", which unsets any setting that may be None. Python's `tomllib` parses; it does
not report the line of a key, so `key_lines` finds it.
"""

import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import Field
from typing import Any, Literal, TypeVar, get_args, get_origin

from arenas.arena_settings import Table
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
    key_of,
    literal,
    notes,
    refuse,
    required,
    settings,
    table_of,
)

T = TypeVar("T")
_TOKEN = re.compile(
    r'''"""(?:\\.|[^\\])*?"{3,5}|\'{3}.*?\'{3,5}'''  # strings over several lines; up to two quotes may precede the end
    r"""|"(?:\\.|[^"\\])*"|'[^']*\'"""
    r"""|\#[^\n]*|\n|[][{}=,]|[^]\s[{}=,\#"']+""",
    re.DOTALL,
)


def _as_floats(value: Any, kind: Any) -> Any:
    """Convert ints in float fields to floats, so that the file shows the type."""
    if get_origin(kind) is tuple:
        return tuple(_as_floats(each, element(kind, i)) for i, each in enumerate(value))
    return float(value) if kind is float else value


def _comment(lines: list[str]) -> str:
    return "".join(f"# {line}".rstrip() + "\n" for line in lines)


def _entry(field: Field, value: Any, default: Any, hint: Any, note: str, key: Key) -> str:
    """Write a setting under its comments: its note and the possible values. Raises ConfigError."""
    kind, optional = required(hint)
    lines = note.splitlines()
    if get_origin(kind) is Literal:
        lines.append(f"one of: {', '.join(map(literal, get_args(kind)))}")
    if limits := bounds(field.metadata):
        lines.append(limits)
    if optional and value == UNSET:
        raise refuse(key, value, "the word means that there is no value: use another one")
    if value is None and default is None:
        return _comment([*lines, f"{key_of(field)} =  (unset)"])
    if isinstance(value, Table) and not value and not default:
        return _comment([*lines, f"{key_of(field)} =  (a table; none is given)"])
    return _comment(lines) + f"{key_of(field)} = {literal(UNSET if value is None else _as_floats(value, kind))}\n"


def _paragraphs(config: Any, base: Any, key: Key, header: str = "") -> Iterator[str]:
    summary, found = notes(type(config))
    if head := _comment([summary] if summary else []) + header:
        yield head
    tables: list[Iterator[str]] = []  # they come last: all keys after a table's header belong to it
    for field in settings(config):
        value, default, inner = getattr(config, field.name), absent(field, base), (*key, key_of(field))
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


def dumps(config: Any, base: Any = None, comments: bool = True) -> str:
    """Write a tree of dataclasses as TOML, with a comment for every setting or without any.

    `loads` returns an equal tree if it gets the same `base`.
    """
    text = "\n".join(_paragraphs(config, base, ()))
    if comments:
        return text
    return "".join(f"{line}\n" for line in text.split("\n") if line and not line.startswith("#"))


def parse(text: str, source: str = "league.toml") -> dict[str, Any]:
    """Parse TOML to dictionaries; raises ConfigError, one line with the file and the line, if it is not TOML."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        has_place = isinstance(error, tomllib.TOMLDecodeError)
        what, _, where = str(error if has_place else "too many digits, or brackets within brackets").partition(" (at ")
        found = re.match(r"line (\d+), column (\d+)", where)
        line, column = (found[1], f" (column {found[2]})") if found else (len(text.splitlines()), "")
        named = f"; an arena in this file is named by --arena.name {source}:NAME" if source.endswith(".py") else ""
        raise ConfigError((), f"not TOML: {what}{column}{named}", f"{source}:{line}: ") from None


def loads(text: str, cls: type[T], source: str = "league.toml", base: T | None = None) -> T:
    """Read a tree of dataclasses from TOML; see `build` for keys that the text does not name.

    Raises:
        ConfigError: one line with the file, the line, the key, the value given and the possible values.
    """
    return located(parse(text, source), cls, text, source, base)


def located(table: Mapping[str, Any], cls: type[T], text: str, source: str, base: T | None = None) -> T:
    """Call `build`, and put the place of an error in `text` before its message. Raises ConfigError."""
    try:
        return build(cls, table, base)
    except ConfigError as error:
        raise ConfigError(error.key, error.message, f"{place(error.key, text, source)}: ") from None


def place(key: Key, text: str, source: str) -> str:
    """Return the file and, if it names the key or a table that contains it, the line."""
    lines = key_lines(text)
    line = next((f":{lines[key[:depth]]}" for depth in range(len(key), 0, -1) if key[:depth] in lines), "")
    return f"{source}{line}"


# Lines of keys, for error messages ------------------------------------------------------------------------------------


def _tokens(text: str) -> Iterator[tuple[int, str]]:
    """Yield (line, token) for every token except comments."""
    line, last = 1, 0
    for found in _TOKEN.finditer(text):
        line += text.count("\n", last, found.start())
        last = found.start()
        if not found[0].startswith("#"):
            yield line, found[0]


def _names(token: str) -> list[str]:
    """Split the token of a dotted key: `a.b` is two names, `"a.b"` is one."""
    if token[0] in "\"'":
        return [tomllib.loads(f"name = {token}")["name"]]
    return [name for name in token.split(".") if name]


class _Bracket:
    """An open bracket of a value: the key that inner keys extend and, for a list, the index of the current element."""

    def __init__(self, token: str, key: Key):
        self.token, self.key, self.index = token, key, 0

    @property
    def inner(self) -> Key:
        return (*self.key, str(self.index)) if self.token == "[" else self.key


class _Tables:
    """The table of the last header; in a list of tables, its newest element."""

    def __init__(self) -> None:
        self._last: dict[Key, int] = {}  # list of tables -> index of its last element

    def enter(self, names: list[str], is_list: bool) -> Key:
        key: Key = ()
        for depth, name in enumerate(names, 1):
            key = (*key, name)
            if is_list and depth == len(names):
                self._last[key] = self._last.get(key, -1) + 1
            if key in self._last:
                key = (*key, str(self._last[key]))
        return key


def key_lines(text: str) -> dict[Key, int]:
    """Map every key and table of a valid TOML text to the line (from 1) where it is first named.

    The elements of a list of tables are named by their index: `("players", "0", "team")`.
    """
    lines: dict[Key, int] = {}
    tables, table, header = _Tables(), (), 0  # the table of the last header, and the number of brackets that opened it
    brackets: list[_Bracket] = []  # open brackets of a value
    parent, names, in_key = table, [], True

    def note(key: Key, line: int) -> None:
        for depth in range(1, len(key) + 1):
            lines.setdefault(key[:depth], line)

    for line, token in _tokens(text):
        if token == "\n":
            if not brackets:
                parent, names, in_key, header = table, [], True, 0
        elif in_key and token == "=":
            note((*parent, *names), line)
            in_key = False
        elif in_key and token == "[":  # a header, since no key is open
            header += 1
        elif in_key and token == "]":
            if names:
                table, names = tables.enter(names, header == 2), []
                note(table, line)
        elif in_key and token not in "{},":
            names += _names(token)
        elif token in "[{":
            brackets.append(_Bracket(token, brackets[-1].inner if brackets and not names else (*parent, *names)))
            if token == "{":
                parent, names, in_key = brackets[-1].key, [], True
                note(parent, line)
            else:
                names = []
        elif token in "]}":
            parent, names, in_key = brackets.pop().key, [], False
        elif token == "," and brackets[-1].token == "{":
            parent, names, in_key = brackets[-1].key, [], True
        elif token == ",":
            brackets[-1].index += 1
    return lines
