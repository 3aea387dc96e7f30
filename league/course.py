"""Which stage of which curriculum a league is, by its name and what the store holds; reads settings as text alone."""

import tomllib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from storage.store import Store


class Course(NamedTuple):
    """A curriculum: the league that has the stages, and the names of these."""

    root: str
    stages: tuple[str, ...]


def course(store: Store, league: str) -> Course | None:
    """The curriculum that a league is, or is a stage of (`main.walk` of `main`); None for one on its own."""
    there = {each.name: each.config for each in store.leagues()}
    own = stages_of(there.get(league, ""))
    if own:
        return Course(league, own)
    for at, letter in reversed(list(enumerate(league))):
        root, name = league[:at], league[at + 1 :]
        if letter == "." and name in (stages := stages_of(there.get(root, ""))):
            return Course(root, stages)
    return None


def at_work(store: Store, league: str) -> str:
    """The league that a name stands for: a curriculum's own name for the stage that it is at, any other for itself."""
    there = {each.name: each.config for each in store.leagues()}
    begun = [f"{league}.{name}" for name in stages_of(there.get(league, "")) if f"{league}.{name}" in there]
    return begun[-1] if begun else league


def stages_of(text: str) -> tuple[str, ...]:
    """The names of the stages in a league's settings; none where it has none."""
    try:
        tables: Sequence[Mapping[str, Any]] = tomllib.loads(text).get("stages", ())
        return tuple(str(table["name"]) for table in tables)
    except (ValueError, RecursionError, KeyError, TypeError, AttributeError):
        return ()
