"""Options that several commands share, and how a command's arguments become a dataclass.

A command's options are a frozen dataclass in the manner of `league/config/schema.py`: note, type and bounds stand with
the field. In a field's metadata, `positional` marks a word without a flag, and `flag` a name that Python cannot have.
"""

import difflib
import sys
from collections.abc import Sequence
from dataclasses import MISSING, Field, dataclass, field
from typing import Any, Literal, TypeVar, get_args, get_origin

from league.config import flags
from league.config.build import build, from_text
from league.config.schema import ConfigError, hints, required, settings
from league.query import Open
from storage.store import Store

T = TypeVar("T")
STORE = "league-data"


@dataclass(frozen=True)
class Where:
    """Which league."""

    store: str = STORE
    """The store: a folder, or a URL such as sqlite:///runs/league.db or postgresql://host/league."""
    league: str | None = None
    """The league's name (none: the one that was run last)."""
    blobs: str | None = None
    """Where the store keeps policies and recordings (none: ROBOT_LEAGUE_BLOBS if set, else beside a SQLite store)."""

    def open(self) -> Open:
        """The league, opened."""
        return Open(Store.open(self.store, blobs=self.blobs), self.league)


@dataclass(frozen=True)
class Listing(Where):
    """Which league, and how to print."""

    format: Literal["table", "json", "csv"] = "table"
    """table for people, json or csv for programs."""


def positional(default: object = MISSING, **metadata: object) -> Any:
    """A field that is given as a word without a flag, wherever it stands; required where there is no default."""
    return field(default=default, metadata={"positional": True, **metadata})


def parse(cls: type[T], args: Sequence[str], command: str, what: str) -> T:
    """A command's arguments as its options, checked. After `--help` it prints that and exits with 0.

    Raises ConfigError, one line, for what the command does not take.
    """
    words = flags.split(args, lambda key: flags.is_switch(key, cls))
    if words.help:
        from league.commands import help

        print(help.page(command, what, cls))
        sys.exit(0)
    return options(cls, words, command)


def options(cls: type[T], words: flags.Words, command: str) -> T:
    """A command line that was taken apart, as options. Raises ConfigError."""
    places = [f for f in settings(cls) if f.metadata.get("positional")]
    if len(words.rest) > len(places):
        raise _too_many(words.rest, places, command)
    table = flags.values(words.given, cls)
    for place, word in zip(places, words.rest, strict=False):
        if place.name in table:
            raise ConfigError((place.name,), f"{place.name} is given twice, as {table[place.name]} and as {word}")
        table[place.name] = from_text(word, hints(cls)[place.name], (place.name,))
    for place in places:
        if place.name not in table and place.default is MISSING:
            raise ConfigError(
                (place.name,), f"league {command} needs {place.name.upper()}: see league {command} --help"
            )
    try:
        return build(cls, {_field(cls, name): value for name, value in table.items()})
    except ConfigError as error:
        names = {f.name: flags.option(f) for f in settings(cls)}
        given = (names.get(error.key[0], error.key[0]),) if error.key else ()
        message = given[0] + error.message.removeprefix(error.key[0]) if given else error.message
        told = ConfigError(given, message)
        raise (flags.as_flag(told) if flags.is_of(given, words.given) else told) from None


def _field(cls: type, name: str) -> str:
    return next(f.name for f in settings(cls) if flags.option(f) == name)


def _too_many(rest: Sequence[str], places: Sequence[Field], command: str) -> ConfigError:
    extra = rest[len(places)]
    near = difflib.get_close_matches(extra, ("--help", "--debug"), 1)
    takes = " ".join(place.name.upper() for place in places) or "no word without a flag"
    hint = f"did you mean {near[0]}? " if near else "a list is written with commas, as in 64,64; "
    return ConfigError(
        (), f"what is {extra!r}? league {command} takes {takes}; {hint}league {command} --help tells more"
    )


def spelt(args: Sequence[str]) -> list[str]:
    """The arguments with -o, which is what people type, as the option that it stands for."""
    return ["--output" if word == "-o" else word for word in args]


def shown(hint: Any) -> str:
    """What stands for a value of that type in a help page."""
    kind, _ = required(hint)
    if get_origin(kind) is Literal:
        return "|".join(map(str, get_args(kind)))
    if get_origin(kind) is tuple:
        return f"{shown(get_args(kind)[0])},..."
    return {int: "N", float: "X", bool: ""}.get(kind, "TEXT")
