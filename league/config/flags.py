"""Settings from a command line: every key of a file is a flag, `--learner.lr 3e-4`, and its text is read as a value.

    --key VALUE, --key=VALUE    a value; lists with commas, `--rating.milestones 10s,1m`, or as in a file
    --switch, --no-switch       true and false, as are --switch=yes and --switch=no

`-` and `_` are equivalent in a key. All other words are positional, at any place on the line.
"""

import difflib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import Field
from typing import TYPE_CHECKING, Any, NamedTuple

from arenas.arena_settings import Table
from league.config.build import TRUTHS, from_text
from league.config.former_names import Former
from league.config.schema import (
    ConfigError,
    Key,
    dotted,
    hints,
    inner_table,
    key_of,
    refuse,
    removed,
    required,
    settings,
)

if TYPE_CHECKING:
    from league.config.experiment import Config

Given = Mapping[Key, str]
"""The text of flags by their keys."""

_NEGATIVE = re.compile(r"-\.?\d")


class SplitArguments(NamedTuple):
    """A parsed command line."""

    given: dict[Key, str]
    rest: list[str]  # positional words
    help: bool


def split(args: Iterable[str], is_switch: Callable[[Key], bool | None]) -> SplitArguments:
    """Parse a command line. `is_switch` returns whether a flag may have no value, or None if that is not known.

    If a flag is given twice, the last value counts. Raises ConfigError for a flag without its value.
    """
    words, found = list(args), SplitArguments({}, [], False)
    while words:
        word = words.pop(0)
        if word in ("-h", "--help"):
            found = found._replace(help=True)
        elif word == "--":
            found.rest.extend(words)
            break
        elif not word.startswith("-") or word == "-" or _NEGATIVE.match(word):
            found.rest.append(word)
        elif not word.startswith("--"):
            raise ConfigError((), f"unknown option {word}: options begin with --; --help lists them")
        else:
            key, text = take(word, words, is_switch)
            found.given[key] = text  # the last value counts
    return found


def take(word: str, words: list[str], is_switch: Callable[[Key], bool | None]) -> tuple[Key, str]:
    """Return the key and text of a flag; removes its value from `words`, the words that follow.

    Raises ConfigError for a flag without its value.
    """
    name, equals, text = word[2:].partition("=")
    key = tuple(name.replace("-", "_").split("."))
    switch = is_switch(key)
    if switch is None and key[0].startswith("no_") and is_switch((key[0][3:], *key[1:])):
        if equals:
            raise ConfigError(key, f"--{name} takes no value: give --{name[3:]}={text}")
        return (key[0][3:], *key[1:]), "false"
    if equals:
        return key, text
    follows = words[0] if words and not words[0].startswith("--") else None
    if switch:
        return key, words.pop(0) if follows is not None and follows.lower() in TRUTHS else "true"
    if switch is None and (follows is None or follows.endswith(".toml")):
        return key, ""  # a flag not known yet: the line is split again, or the flag is refused
    if follows is None:
        raise ConfigError(key, f"--{name} needs a value: --help tells what it may be")
    return key, words.pop(0)


def find(key: Key, cls: type, base: Any = None) -> Any:
    """Return the type of the setting with that key, None if there is none; `base` as for `build`.

    Raises ConfigError for a setting that was removed.
    """
    return _found(key, cls, base)[1]


def _found(key: Key, cls: type, base: Any) -> tuple[Key, Any]:
    """Return the key by present names, and the type of the setting; None if there is no such setting."""
    now: Key = ()
    for depth, name in enumerate(key):
        field = next((each for each in settings(cls) if name in (option(each), each.metadata.get("formerly"))), None)
        if field is None:
            if why := removed(cls, name):
                raise ConfigError(key, f"{_spelled(dotted(key))}: {why}")
            return key, None
        now = (*now, option(field))
        inner, default = inner_table(cls, field, base)
        if depth == len(key) - 1:
            return now, type(default) if default is not None else hints(cls)[field.name]
        if required(hints(cls)[field.name])[0] is Table:
            return (*now, *key[depth + 1 :]), Any  # a key of a table of any keys
        if inner is None:
            return key, None
        cls, base = inner, default
    return key, None


def present(given: Given, cls: type, base: Any = None) -> tuple[dict[Key, str], Former]:
    """Return the flags by the present keys of their settings, and the keys that were given by former names.

    Raises ConfigError if a setting is given by both names.
    """
    found: dict[Key, str] = {}
    former: Former = {}
    for key, text in given.items():
        now, _ = _found(key, cls, base)
        if now in found:
            was = former.get(now, key)
            raise ConfigError(was, f"{_spelled(dotted(was))} is now {_spelled(dotted(now))}: give only the latter")
        found[now] = text
        if now != key:
            former[now] = key
    return found, former


def option(field: Field) -> str:
    """Return the name of a field's flag: `flag` of its metadata, else the name of the setting."""
    return field.metadata.get("flag", key_of(field))


def is_switch(key: Key, cls: type, base: Any = None) -> bool | None:
    """Return whether the setting with that key is a bool; None if there is no such setting."""
    hint = find(key, cls, base)
    return None if hint is None else required(hint)[0] is bool


def values(given: Given, cls: type, base: Any = None) -> dict[str, Any]:
    """Return flags as the nested tables of a file. Raises ConfigError for an unknown flag."""
    tables: dict[str, Any] = {}
    for key, text in given.items():
        hint = find(key, cls, base)
        if hint is None:
            raise unknown(key, [".".join(each) for each in every(cls, base)])
        table = tables
        for name in key[:-1]:
            table = table.setdefault(name, {})
        table[key[-1]] = from_text(text, hint, key)
    return tables


def unknown(key: Key, options: Iterable[str]) -> ConfigError:
    """Return the error for an unknown flag, with similar flags as a suggestion."""
    names = list(options)
    near = [name for name in names if name.rpartition(".")[2] == key[-1]]  # without its table, or in a wrong table
    near = near or [name for name in names if _in_table_with(name, key)]  # budget.time: budget.training_time
    near = near or difflib.get_close_matches(".".join(key), names, 1)
    meant = f": did you mean {' or '.join(map(_spelled, near))}?" if near else ""
    return ConfigError(key, f"unknown option {_spelled(dotted(key))}{meant} (--help lists all)")


def _in_table_with(name: str, key: Key) -> bool:
    """Return whether a flag lies in the table of `key` and has its last word among its own words."""
    table, _, last = name.rpartition(".")
    return table == ".".join(key[:-1]) and key[-1] in last.split("_")


def every(cls: type, base: Any, prefix: Key = ()) -> Iterator[Key]:
    """Yield the keys of all flags."""
    for field in settings(cls):
        key = (*prefix, option(field))
        _, default = inner_table(cls, field, base)
        if default is not None:
            yield from every(type(default), default, key)
        else:
            yield key


def merged(table: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables of a file, overridden by those of flags."""
    both = dict(table)
    for name, value in over.items():
        below = both.get(name)
        if isinstance(value, Mapping):
            if below is None or isinstance(below, Mapping):
                both[name] = merged(below or {}, value)  # else the file has a plain value here, which `build` refuses
        else:
            both[name] = value
    return both


def is_of(key: Key, given: Given) -> bool:
    """Return whether the setting with that key, or a table that contains it, was given as a flag."""
    return any(key[: len(each)] == each for each in given)


def names(tables: Mapping[str, Any], key: Key) -> bool:
    """Return whether tables hold a value at a key, or at a part of it."""
    own: Any = tables
    for name in key:
        if not isinstance(own, Mapping):
            return True
        if name not in own:
            return False
        own = own[name]
    return bool(key)


def check_learner_flags(config: "Config", given: Given) -> None:
    """Raise ConfigError for a flag of HAPPO where no player learns by it. A file may have such keys: presets do."""
    from agents.settings import HAPPO  # late: a query does not import agents

    if any(key[0] == "learner" for key in given):
        check_classes(config)
    classes = {player.class_ or config.learner.class_ for player in config.players} or {config.learner.class_}
    if HAPPO in classes:
        return
    for key in given:
        if key[0] == "learner" and key[1] not in ("class", "settings", "skill", "critic_input"):
            raise ConfigError(
                key,
                f"{dotted(key)} = {given[key]}: is a setting of {HAPPO}, and learner.class is {config.learner.class_};"
                f" give its own as --learner.settings.{key[-1]}",
            )


def check_classes(config: "Config") -> None:
    """Raise ConfigError if a player would learn by a learner that was removed."""
    from agents.settings import REMOVED

    named = {("learner", "class"): config.learner.class_}
    named |= {("players", str(i), "class"): player.class_ or "" for i, player in enumerate(config.players)}
    for key, name in named.items():
        if name in REMOVED:
            raise refuse(key, name, REMOVED[name])


def as_flag(error: ConfigError) -> ConfigError:
    """Return the error with its key written as a flag."""
    name = dotted(error.key)
    if not name or not error.message.startswith(f"{name} "):
        return ConfigError(error.key, error.message)
    return ConfigError(error.key, _spelled(name) + error.message.removeprefix(name))


def _spelled(name: str) -> str:
    """Return the name of a setting as a flag, as --help writes it."""
    return f"--{name.replace('_', '-')}"
