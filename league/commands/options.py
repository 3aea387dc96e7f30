"""Options that several commands share, and the conversion of a command's arguments to a dataclass.

A command's options are a frozen dataclass in the style of `league/config/schema.py`: each field has its note, type and
bounds. In a field's metadata, `positional` marks a word without a flag, with `many` all such words that are left;
`flag` is a name that Python does not allow.
"""

import difflib
import shlex
import sys
from collections.abc import Sequence
from dataclasses import MISSING, Field, dataclass, field
from typing import Any, Literal, TypeVar

from league.config import flags
from league.config.build import build, from_text
from league.config.schema import ConfigError, hints, settings
from league.queries.query import Open
from matchmaking.ratings.sprt import SequentialTest
from storage.database.urls import display_location
from storage.store import Store

T = TypeVar("T")
STORE = "league-data"


def place_flags(store: str, blobs: str | None = None, league: str | None = None) -> str:
    """Return the flags with which another command finds this store and, if given, the league, without passwords.

    The default store needs none.
    """
    given = [("--store", display_location(store))] if store != STORE else []
    given += [("--blobs", display_location(blobs))] if blobs else []
    given += [("--league", league)] if league else []
    return shlex.join(word for pair in given for word in pair)


@dataclass(frozen=True)
class Where:
    """The store, and the league in it."""

    store: str = STORE
    """The store: a folder, or a URL such as sqlite:///runs/league.db or postgresql://host/league."""
    league: str | None = None
    """The league's name (none: the one that was run last)."""
    blobs: str | None = None
    """Place of the store's policies and recordings (none: ROBOT_LEAGUE_BLOBS if set, else beside a SQLite store)."""

    def open(self) -> Open:
        """Open the league."""
        return Open(Store.open(self.store, blobs=self.blobs), self.league)


@dataclass(frozen=True)
class Listing(Where):
    """The league, and the format of the output."""

    format: Literal["table", "json", "csv"] = "table"
    """table for people, json or csv for programs."""


@dataclass(frozen=True, kw_only=True)
class HypothesesOptions:
    """A test of two hypotheses: elo0, and elo1 above it."""

    elo0: float = 0.0
    """The Elo difference by which A is not better."""
    elo1: float = 20.0
    """The Elo difference by which A is better."""
    alpha: float = field(default=0.05, metadata={"above": 0.0, "below": 1.0})
    """Maximum probability of accepting if elo0 is true."""
    beta: float = field(default=0.05, metadata={"above": 0.0, "below": 1.0})
    """Maximum probability of rejecting if elo1 is true."""
    model: Literal["logistic", "normalized"] = "logistic"
    """Scale of elo0 and elo1: logistic Elo, or Elo normalised by the standard deviation of a game's score."""

    def __post_init__(self) -> None:
        """Raise an error for a test that cannot decide anything."""
        self.test()

    def test(self) -> SequentialTest:
        """The test."""
        return SequentialTest(self.elo0, self.elo1, self.alpha, self.beta, self.model)


def positional(default: object = MISSING, **metadata: object) -> Any:
    """Return a field that is given as a word without a flag, at any place; it is required if it has no default."""
    return field(default=default, metadata={"positional": True, **metadata})


def parse(cls: type[T], args: Sequence[str], command: str, what: str) -> T:
    """Convert a command's arguments to its options, checked. For `--help`, print the help and exit with 0.

    Raises ConfigError, one line, for arguments that the command does not take.
    """
    split = flags.split(args, lambda key: flags.is_switch(key, cls))
    if split.help:
        from league.commands import help

        print(help.page(command, what, cls))
        sys.exit(0)
    return options(cls, split, command)


def options(cls: type[T], split: flags.SplitArguments, command: str) -> T:
    """Convert a split command line to options. Raises ConfigError."""
    places = [f for f in settings(cls) if f.metadata.get("positional")]
    many = places.pop() if places and places[-1].metadata.get("many") else None
    table = flags.values(split.given, cls)
    if many is not None and many.name not in table:
        table[many.name] = split.rest[len(places) :]
    elif len(split.rest) > len(places):
        raise _too_many(split.rest, places, command)
    for place, word in zip(places, split.rest, strict=False):
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
        problem = ConfigError(given, message)
        raise (flags.as_flag(problem) if flags.is_of(given, split.given) else problem) from None


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
    """Return the arguments with the short form -o replaced by the option that it stands for."""
    return ["--output" if word == "-o" else word for word in args]


def without_settings(args: Sequence[str], *sections: str, cls: type | None = None) -> tuple[list[str], flags.Given]:
    """Return the arguments without the flags of settings in these sections, such as `arena`, and these flags.

    `cls` has the settings and says which of them are switches; without it none is.
    """
    own, given, words = [], {}, list(args)
    starts = tuple(f"--{no}{section}." for section in sections for no in (("",) if cls is None else ("", "no-")))
    while words:
        word = words.pop(0)
        if word.startswith(starts):
            key, text = flags.take(word, words, lambda key: False if cls is None else flags.is_switch(key, cls))
            given[key] = text
        else:
            own.append(word)
    return own, given
