"""Write the reference of commands and settings from the code: python -m scripts.reference_pages.

`docs/commands.md` holds what each command prints for `--help`; `docs/settings.md` holds every key of `league.toml` with
its default, its bounds and its note, and `docs/arenas/settings.md` those of each arena. All are written whole, and a
test fails when they are out of date.
"""

import io
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from dataclasses import MISSING
from pathlib import Path
from typing import Any, Literal, get_args, get_origin
from unittest import mock

from arenas import known
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
ALL_TAKE = ("--help", "--debug")
KEYS = ("key", "default", "possible", "what it is")


def commands() -> str:
    """Return the page of all commands: a table for each folder of commands, and first the options of several."""
    helps = help_pages()
    read = {name: dict(_options(text)) for name, text in helps.items()}
    counts = Counter(entry for options in read.values() for entry in options.items())
    shared = [entry for entry, count in counts.items() if count > 1 and entry[0].startswith("-")]
    shared.sort(key=lambda entry: -counts[entry])
    parts = [
        "# Which commands are there, and what are their options?",
        HEAD,
        "`league COMMAND --help` prints the same. `-` and `_` are alike in an option's name; `--option VALUE` and"
        " `--option=VALUE` are alike. Defaults are in square brackets. [Exit codes](deploy.md#exit-codes).",
        "## Options of several commands",
        "Every command takes `--help` and `--debug`. The tables below name the others after *Also*.",
        _table(("option", "meaning"), [(f"`{option}`", text) for option, text in shared]),
    ]
    for room, title in ROOMS.items():
        named = [name for name, (module, _) in cli.COMMANDS.items() if module.split(".")[2] == room]
        rows = [row for name in named for row in _rows(helps[name], read[name], shared)]
        parts += [f"## {title}", _table(("command, option", "meaning"), rows)]
    return "\n\n".join(parts) + "\n"


def help_pages() -> dict[str, str]:
    """Return what each command prints for `--help`."""
    with mock.patch.dict(os.environ, {"COLUMNS": str(WIDTH)}):
        return {name: _help(name) for name in cli.COMMANDS}


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


def _options(text: str) -> Iterator[tuple[str, str]]:
    """Yield each option of a help page with its kind of value, and its meaning."""
    for entry in re.split(r"\n(?=  \S)", text.partition("\nOptions\n")[2]):
        option, meaning = re.split(r"\s{2,}", entry.strip(), maxsplit=1)
        yield option, _line(meaning)


def _rows(text: str, options: dict[str, str], shared: list[tuple[str, str]]) -> Iterator[tuple[str, str]]:
    """Yield the row of a command, with its words without flags and its shared options, then those of its options."""
    usage, _, summary = text.partition("\nOptions\n")[0].partition("\n")
    command = usage.removeprefix("usage: ").removesuffix(" [--option VALUE ...]")
    flags = [option.split()[0] for option, _ in shared]
    words = [f"`{option}`: {meaning}" for option, meaning in options.items() if not option.startswith("-")]
    common = [option for option, meaning in options.items() if (option, meaning) in shared and option not in ALL_TAKE]
    also = ", ".join(f"`{option if flags.count(option.split()[0]) > 1 else option.split()[0]}`" for option in common)
    yield f"**`{command}`**", " ".join([f"**{_line(summary)}**", *words, *([f"Also {also}."] if also else [])])
    own = [entry for entry in options.items() if entry not in shared and entry[0].startswith("-")]
    yield from ((f"`{option}`", meaning) for option, meaning in own)


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
        " until the next release, with a line on stderr. The keys of `[arena]` depend on `arena.name`"
        f" (`{config.arena.name}` by default) and have [a page of their own](arenas/settings.md).",
        "## Presets",
        '`league run --preset NAME`, or `preset = "NAME"` in the file, with the file\'s other keys laid over it.',
        _table(("preset", "is"), named),
        *_tables(config),
        "## `[[stages]]`",
        "The stages of a curriculum, in order: `name`, and any other keys with values that differ from those above"
        " ([curricula](curriculum.md)). `--stages.match.learner.lr 1e-4` sets a key of the stage `match` alone.",
    ]
    return "\n\n".join(parts) + "\n"


def arena_settings() -> str:
    """Return the page of the settings of arenas: a table for each class of settings."""
    arenas: dict[type, dict[str, Any]] = {}
    for name, each in known().items():
        arenas.setdefault(type(each), {})[name] = each
    parts = [
        "# Which settings does an arena have?",
        HEAD,
        "Keys of the table `[arena]` in `league.toml`, and options of `league run`: `--arena.rules.episode 20`."
        " Defaults are those of the arena that is named first; `league arenas NAME` prints those of any other.",
    ]
    for cls, named in arenas.items():
        rows = _table(KEYS, list(_rows_of(next(iter(named.values())), ("arena",))))
        parts += ["## " + ", ".join(f"`{name}`" for name in named), _paragraph(cls.__doc__), rows]
    return "\n\n".join(parts) + "\n"


def _tables(config: Any) -> Iterator[str]:
    """Yield a title, a summary and a table of keys for each top table of settings, then for each list of tables."""
    yield from ("## The league", _paragraph(type(config).__doc__), _table(KEYS, list(_keys(type(config), config, ()))))
    for each in settings(config):
        key, value = key_of(each), getattr(config, each.name)
        if is_table(value) and key != "arena":
            yield from (f"## `[{key}]`", _paragraph(type(value).__doc__), _table(KEYS, list(_rows_of(value, (key,)))))
    for kind, key, note in _lists(config, ()):
        yield from (f"## `[[{'.'.join(key)}]]`", _line(note), _table(KEYS, list(_keys(kind, None, ()))))


def _rows_of(config: Any, key: Key) -> Iterator[tuple[str, ...]]:
    """Yield the rows of a table's own keys, then of the tables in it, each after a row with its summary."""
    yield from _keys(type(config), config, key)
    for each in settings(config):
        if is_table(value := getattr(config, each.name)):
            inner = (*key, key_of(each))
            yield f"**`[{'.'.join(inner)}]`**", "", "", f"**{_paragraph(type(value).__doc__)}**"
            yield from _rows_of(value, inner)


def _lists(config: Any, key: Key) -> Iterator[tuple[type, Key, str]]:
    """Yield each list of tables in the settings: the class of one, its key and its note."""
    for each in settings(config):
        inner = (*key, key_of(each))
        if is_table(value := getattr(config, each.name)):
            yield from _lists(value, inner)
        elif (kind := table_of(hints(type(config))[each.name])) is not None:
            yield kind, inner, notes(type(config))[1].get(each.name, "")


def _keys(cls: type, values: Any, prefix: Key) -> Iterator[tuple[str, ...]]:
    """Yield the row of each setting of a class, with the defaults of `values`, or of the class where that is None."""
    found = notes(cls)[1]
    for each in settings(cls):
        hint, value = hints(cls)[each.name], absent(each, values)
        if is_table(value) or (values is not None and table_of(hint) is not None):
            continue
        default, possible = ("none", "a table") if table_of(hint) else (_default(value), _possible(each, hint))
        former = each.metadata.get("formerly")
        note = found.get(each.name, "") + (f" Formerly `{former}`." if former else "")
        yield f"`{'.'.join((*prefix, key_of(each)))}`", default, possible, note


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


PAGES: dict[str, Callable[[], str]] = {
    "docs/commands.md": commands,
    "docs/settings.md": configuration,
    "docs/arenas/settings.md": arena_settings,
}
"""Each page's file, relative to the repository, and what writes it."""


def main() -> None:
    """Write all pages."""
    for file, text in PAGES.items():
        (ROOT / file).write_text(text(), "utf-8")
        print(file)


if __name__ == "__main__":
    main()
