"""Pages of `league COMMAND --help`, written from the notes of options and settings, without slow imports."""

import re
import shutil
import textwrap
from collections.abc import Iterator
from dataclasses import MISSING, Field
from typing import Any, Literal, get_args, get_origin

from league.config import flags
from league.config.schema import Key, absent, hints, is_table, key_of, literal, notes, required, settings, table_of

INDENT = 33  # columns before the notes


def page(command: str, what: str, options: type, config: Any = None) -> str:
    """Return a command's help: its options and, if it takes settings, the settings of `config` with their values."""
    places = [f for f in settings(options) if f.metadata.get("positional")]
    words = "".join(f" {f.name.upper()}" if f.default is MISSING else f" [{f.name.upper()}]" for f in places)
    lines = [f"usage: league {command}{words} [--option VALUE ...]", "", *_wrap(what, ""), "", "Options"]
    found = notes(options)[1]
    for each in settings(options):
        lines += _entry(_left(each, hints(options)[each.name]), _description(each, found.get(each.name, "")))
    lines += _entry("--help", "This page.") + _entry("--debug", "Show where in the code an error comes from.")
    if config is not None:
        lines += ["", *_wrap(
            "Settings: the keys of league.toml, each with the value that it has now; `league init` writes them with"
            " all that there is to know of each. A list is written with commas, a switch is set by --name and unset by"
            " --no-name, and none unsets what may be unset. --stages.match.learner.lr 1e-4 is for the stage match of a"
            " curriculum alone.", ""
        )]  # fmt: skip
        for title, entries in groups(config):
            lines += ["", *_wrap(title, ""), *entries]
    return "\n".join(lines)


def _left(each: Field, hint: Any) -> str:
    """Return an option in the form in which it is typed."""
    if each.metadata.get("positional"):
        return each.name.upper()
    return f"--{flags.option(each).replace('_', '-')} {placeholder(hint)}".rstrip()


def _description(each: Field, note: str) -> str:
    default = absent(each, None)
    plain = default not in (MISSING, None, False, ()) and not each.metadata.get("positional")
    shown = ",".join(map(str, default)) if isinstance(default, tuple) else default
    return f"{_flat(note)} [{shown}]" if plain else _flat(note)


def groups(config: Any, prefix: Key = ()) -> Iterator[tuple[str, list[str]]]:
    """Yield each table of settings with a title: its name and its summary."""
    summary, found = notes(type(config))
    entries, tables = [], []
    for each in settings(config):
        key, value, hint = (*prefix, key_of(each)), getattr(config, each.name), hints(type(config))[each.name]
        if is_table(value):
            tables.append((value, key))
        elif table_of(hint) is not None:
            entries += _entry(f"[[{'.'.join(key)}]]", f"{_flat(found.get(each.name, ''))} [{len(value)} given]")
        else:
            entries += _entry(f"--{'.'.join(key)} {_value(value)}".rstrip(), _note(each, hint, found))
    if entries:
        yield f"[{'.'.join(prefix)}] {summary}" if prefix else summary, entries
    for table, key in tables:
        yield from groups(table, key)


def _note(each: Field, hint: Any, found: dict[str, str]) -> str:
    """Describe a setting in a few words; the file written by `league init` has the whole note."""
    kind, _ = required(hint)
    if get_origin(kind) is Literal:
        return f"{', '.join(map(str, get_args(kind)))}"
    brief = re.sub(r" \([^()]*\)", "", _flat(found.get(each.name, "")))
    return re.split(r"(?<!\.)(?<!e\.g)\.(?: |$)|; ", brief)[0]


def _value(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, tuple) and not any(isinstance(each, tuple) for each in value):
        return ",".join(map(_value, value)) or "[]"
    return str(value) if isinstance(value, str) else literal(value)


def _flat(note: str) -> str:
    return " ".join(note.split())


def _entry(left: str, note: str) -> list[str]:
    """Return an option and its note in one line, or in several if they are too long."""
    lines = _wrap(note, " " * INDENT) or [""]
    head = f"  {left}"
    if len(head) >= INDENT:
        return [head, *lines]
    return [head.ljust(INDENT) + lines[0].strip(), *lines[1:]]


def _wrap(text: str, indent: str) -> list[str]:
    width = max(60, min(120, shutil.get_terminal_size().columns))
    return textwrap.wrap(text, width, initial_indent=indent, subsequent_indent=indent)


def placeholder(hint: Any) -> str:
    """Return the text that stands for a value of a type in a help page."""
    kind, _ = required(hint)
    if get_origin(kind) is Literal:
        return "|".join(map(str, get_args(kind)))
    if get_origin(kind) is tuple:
        return f"{placeholder(get_args(kind)[0])},..."
    return {int: "N", float: "X", bool: ""}.get(kind, "TEXT")
