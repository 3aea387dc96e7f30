"""Write the reference of commands and settings from the code: python -m scripts.reference_pages.

`docs/commands.md` holds what each command prints for `--help`; `docs/settings.md` holds every key of `league.toml` with
its default, its bounds and its note. Both are written whole, and a test fails when they are out of date.
"""

import io
import os
import re
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from dataclasses import MISSING
from pathlib import Path
from typing import Any, Literal, get_args, get_origin
from unittest import mock

from league.commands import cli
from league.config import experiment, presets
from league.config.schema import (
    Key,
    absent,
    bounds,
    expected,
    hints,
    is_table,
    key_of,
    literal,
    notes,
    required,
    settings,
    table_of,
)
from league.system import exit_codes

ROOT = Path(__file__).parents[1]
HEAD = "<!-- written from the code: python -m scripts.reference_pages -->"
WIDTH = 120
ROOMS = {
    "run": "Running a league",
    "analyse": "Ratings, tables and checks",
    "design": "Preparing",
    "watch": "Watching",
    "play": "Matches of your own",
    "store": "Stores, archives and policies",
}
SHARED = ("--store", "--league", "--blobs", "--help", "--debug")
"""Options that stand at the top of the page once, and in a command's own list only where they differ."""


def commands() -> str:
    """Return the page of all commands: their `--help`, by the folder that holds them."""
    with mock.patch.dict(os.environ, {"COLUMNS": str(WIDTH)}):
        helps = {name: _help(name) for name in cli.COMMANDS}
    shared = {name: entry for name, entry in _entries(helps["status"]) if name in SHARED}
    parts = [
        "# Which commands are there, and what are their options?",
        HEAD,
        "`league COMMAND --help` prints the same text. `-` and `_` are alike in an option's name; `--option VALUE` and"
        " `--option=VALUE` are alike. These options have the same meaning for every command that takes them:",
        _block("\n".join(shared.values())),
        _table(("exit code", "meaning"), [(str(code), meaning) for code, meaning in exit_codes.MEANINGS.items()]),
    ]
    for room, title in ROOMS.items():
        named = [name for name, (module, _) in cli.COMMANDS.items() if module.split(".")[2] == room]
        parts += [f"## {title}", *(_block(_own(helps[name], shared)) for name in named)]
    return "\n\n".join(parts) + "\n"


def _help(command: str) -> str:
    """Return the help page of a command without its list of settings, which has a page of its own."""
    args = [command, "--help"] + (["--preset", "quickstart"] if command == "run" else [])
    printed = io.StringIO()
    with redirect_stdout(printed):
        try:
            cli.main(args)
        except SystemExit as ended:
            if ended.code:
                raise RuntimeError(f"league {command} --help ended with {ended.code}") from None
    return printed.getvalue().partition("\n\nSettings: ")[0].strip()


def _entries(text: str) -> Iterator[tuple[str, str]]:
    """Yield each option of a help page: its name, and its lines."""
    for entry in re.split(r"\n(?=  \S)", text.partition("\nOptions\n")[2]):
        yield entry.split()[0], entry


def _own(text: str, shared: dict[str, str]) -> str:
    """Return a help page without the options that stand at the top of the page."""
    own = [entry for name, entry in _entries(text) if shared.get(name) != entry]
    return "\n".join([text.partition("\nOptions\n")[0].strip(), "", *own]).strip()


def configuration() -> str:
    """Return the page of all settings: a table for each table of `league.toml`."""
    config = experiment.default()
    named = [(name, _paragraph(make.__doc__)) for name, make in presets.PRESETS.items()]
    parts = [
        "# Which settings are there?",
        HEAD,
        "Every key of `league.toml` is also an option of `league run`: `learner.lr = 3e-4` in the file is"
        " `--learner.lr 3e-4` on the command line. A list is written with commas, a switch is set by `--name` and unset"
        " by `--no-name`, and the word `none` unsets a setting that can be unset. Durations are written as `30s`, `5m`"
        " or `1h30m`. `league init` writes all of this as a file. The former name of a renamed setting is accepted"
        " until the next release, with a line on stderr. The keys of `[arena]` depend on `arena.name`; this"
        f" page has those of `{config.arena.name}`, and `league arenas NAME` prints those of any other arena.",
        "## Presets",
        '`league run --preset NAME`, or `preset = "NAME"` in the file, with the file\'s other keys laid over it.',
        _table(("preset", "is"), named),
        *_tables(config),
        "## `[[stages]]`",
        "The stages of a curriculum, in order: `name`, and any other keys with values that differ from those above"
        " ([curricula](curriculum.md)).",
    ]
    return "\n\n".join(parts) + "\n"


def _tables(config: Any, prefix: Key = ()) -> Iterator[str]:
    """Yield a title, a summary and a table of keys for each group of settings, then one for each list of tables."""
    inner, lists = [], []
    for each in settings(config):
        key, hint, value = (*prefix, key_of(each)), hints(type(config))[each.name], getattr(config, each.name)
        if is_table(value):
            inner.append((value, key))
        elif table_of(hint) is not None:
            lists.append((table_of(hint), key, notes(type(config))[1].get(each.name, "")))
    if table := _keys(type(config), config, prefix):
        yield f"## `[{'.'.join(prefix)}]`" if prefix else "## The league"
        yield _paragraph(type(config).__doc__)
        yield table
    for value, key in inner:
        yield from _tables(value, key)
    for kind, key, note in lists:
        yield f"## `[[{'.'.join(key)}]]`"
        yield _line(note)
        yield _keys(kind, None, ())


def _keys(cls: type, values: Any, prefix: Key) -> str:
    """Return the settings of a class as a table, with the defaults of `values`, or of the class where that is None."""
    rows, found = [], notes(cls)[1]
    for each in settings(cls):
        hint, value = hints(cls)[each.name], absent(each, values)
        if is_table(value) or (values is not None and table_of(hint) is not None):
            continue
        default, possible = ("none", "a table") if table_of(hint) else (_default(value), _possible(each, hint))
        former = each.metadata.get("formerly")
        note = found.get(each.name, "") + (f" Formerly `{former}`." if former else "")
        rows.append((f"`{'.'.join((*prefix, key_of(each)))}`", default, possible, note))
    return _table(("key", "default", "possible", "what it is"), rows) if rows else ""


def _default(value: Any) -> str:
    if value is None:
        return "none"
    return "required" if value is MISSING else f"`{literal(value)}`"


def _possible(each: Any, hint: Any) -> str:
    """Return what a setting may be, in words."""
    kind, optional = required(hint)
    choices = get_args(kind) if get_origin(kind) is Literal else ()
    text = ", ".join(f"`{value}`" for value in choices) or expected(kind)
    text = f"{text}, {limits}" if (limits := bounds(each.metadata)) else text
    return f"{text}; or none" if optional else text


def _paragraph(doc: str | None) -> str:
    """Return the first paragraph of a docstring as one line."""
    return _line((doc or "").partition("\n\n")[0])


def _line(text: str) -> str:
    return " ".join(text.split())


def _block(text: str) -> str:
    return f"```text\n{text}\n```"


def _table(titles: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [titles, tuple("---" for _ in titles), *rows]
    return "\n".join(f"| {' | '.join(_line(cell).replace('|', chr(92) + '|') for cell in line)} |" for line in lines)


PAGES: dict[str, Callable[[], str]] = {"docs/commands.md": commands, "docs/settings.md": configuration}
"""Each page's file, relative to the repository, and what writes it."""


def main() -> None:
    """Write both pages."""
    for file, text in PAGES.items():
        (ROOT / file).write_text(text(), "utf-8")
        print(file)


if __name__ == "__main__":
    main()
