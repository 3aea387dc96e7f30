"""A command line as settings: every key of a file is a flag, `--learner.lr 3e-4`, and a flag's text is read as a value.

    --key VALUE, --key=VALUE    a value; lists with commas, `--rating.milestones 10s,1m`, or as in a file
    --switch, --no-switch       true and false, as are --switch=yes and --switch=no

`-` and `_` are alike in a key. Whatever else stands on the line is a positional word, wherever it stands.
"""

import difflib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import Field
from typing import Any, NamedTuple

from league.config.build import TRUTHS, from_text, inner_table
from league.config.schema import ConfigError, Key, dotted, hints, required, settings

Given = Mapping[Key, str]
"""The text of flags by their keys."""

_NEGATIVE = re.compile(r"-\.?\d")


class Words(NamedTuple):
    """A command line, taken apart."""

    given: dict[Key, str]
    rest: list[str]  # positional words
    help: bool


def split(args: Iterable[str], is_switch: Callable[[Key], bool | None]) -> Words:
    """Take a command line apart; `is_switch` says whether a flag may stand without a value, None if that is not known.

    Of a flag that is given twice the last one counts. Raises ConfigError for a flag without its value.
    """
    words, found = list(args), Words({}, [], False)
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
            key, text = _flag(word, words, is_switch)
            found.given[key] = text  # the last one wins, as everywhere
    return found


def _flag(word: str, words: list[str], is_switch: Callable[[Key], bool | None]) -> tuple[Key, str]:
    """The key and text of a flag; takes its value off the words that follow."""
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
        return key, ""  # whose it is shows when it is known, or it never is
    if follows is None:
        raise ConfigError(key, f"--{name} needs a value: --help tells what it may be")
    return key, words.pop(0)


def find(key: Key, cls: type, base: Any = None) -> Any:
    """The type of the setting with that key, None if there is none; `base` as for `build`."""
    for depth, name in enumerate(key):
        field = next((each for each in settings(cls) if option(each) == name), None)
        if field is None:
            return None
        inner, default = inner_table(cls, field, base)
        if depth == len(key) - 1:
            return type(default) if default is not None else hints(cls)[field.name]
        if inner is None:
            return None
        cls, base = inner, default
    return None


def option(field: Field) -> str:
    """A field's name as a flag: its own, unless it says another one."""
    return field.metadata.get("flag", field.name)


def is_switch(key: Key, cls: type, base: Any = None) -> bool | None:
    """Whether the setting with that key is true or false; None if there is no such setting."""
    hint = find(key, cls, base)
    return None if hint is None else required(hint)[0] is bool


def values(given: Given, cls: type, base: Any = None) -> dict[str, Any]:
    """Flags as the nested tables that a file would hold. Raises ConfigError for one that does not exist."""
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
    """Say that there is no such flag, and which one was probably meant."""
    names = list(options)
    near = [name for name in names if name.rpartition(".")[2] == key[-1]]  # without its table, or in a wrong one
    near = near or difflib.get_close_matches(".".join(key), names, 1)
    meant = f"did you mean {' or '.join(map(_spelled, near))}? " if near else ""
    return ConfigError(key, f"unknown option {_spelled(dotted(key))}: {meant}(--help lists all)")


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
    """The tables of a file with those of flags laid over them."""
    both = dict(table)
    for name, value in over.items():
        below = both.get(name)
        if isinstance(value, Mapping):
            if below is None or isinstance(below, Mapping):
                both[name] = merged(below or {}, value)  # else the file holds no table here, which `build` refuses
        else:
            both[name] = value
    return both


def is_of(key: Key, given: Given) -> bool:
    """Whether the setting with that key, or a table round it, was given as a flag."""
    return any(key[: len(each)] == each for each in given)


def as_flag(error: ConfigError) -> ConfigError:
    """The error with its key written as a flag."""
    name = dotted(error.key)
    if not name or not error.message.startswith(f"{name} "):
        return ConfigError(error.key, error.message)
    return ConfigError(error.key, _spelled(name) + error.message.removeprefix(name))


def _spelled(name: str) -> str:
    """A setting as a flag, as --help writes it."""
    return f"--{name.replace('_', '-')}"
