"""Options that several commands share, and how a command's arguments become a dataclass."""

from dataclasses import dataclass
from typing import Literal, TypeVar

from league.query import Open
from storage.store import Store

T = TypeVar("T")
STORE = "league-data"


@dataclass(frozen=True)
class Where:
    """Which league."""

    store: str = STORE
    """The store: a folder, or a URL such as sqlite:///runs/league.db."""
    league: str | None = None
    """The league's name (default: the one that was run last)."""

    def open(self) -> Open:
        """The league, opened."""
        return Open(Store.open(self.store), self.league)


@dataclass(frozen=True)
class Listing(Where):
    """Which league, and how to print."""

    format: Literal["table", "json", "csv"] = "table"
    """table for people, json or csv for programs."""


def parse(cls: type[T], args: list[str], command: str, what: str, default: T | None = None) -> T:
    """A command's arguments as a dataclass; tyro prints help and errors, and exits with 2 after the latter."""
    import tyro

    prog = f"league {command}"
    if default is None:
        return tyro.cli(cls, prog=prog, description=what, args=args)
    return tyro.cli(cls, prog=prog, description=what, args=args, default=default)
