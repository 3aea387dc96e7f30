"""The leagues of a comparison, and their cells: leagues whose settings are the same but for the seed."""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any

from league.config.schema import ConfigError
from league.matches.exploitability import INFIX
from league.queries.query import Open
from league.runs.comparison.warm_starts import WarmStarts
from league.state.curriculum_stage import course
from matchmaking.roles import FIXED
from storage.errors import UnknownName
from storage.store import Store

SHOWN = 4  # most settings of a cell that its text names
CROSS_PLAY = "cross-play"
"""The beginning of the names of leagues that hold the matches of comparisons; patterns leave them out."""


@dataclass(frozen=True)
class Member:
    """A league of a comparison."""

    opened: Open
    name: str  # as it is shown: the league's name, or STORE#LEAGUE
    settings: Mapping[str, Any]  # by dotted key, those that make a cell


@dataclass(frozen=True)
class Cell:
    """Leagues that differ by their seeds alone."""

    text: str  # the settings by which it differs from the other cells
    settings: Mapping[str, Any]  # the same, by dotted key
    members: Sequence[Member]


def members(names: Sequence[str], sweep: str | None, store: Store, until: ExitStack) -> list[Member]:
    """Open the leagues that are named: by name, by a pattern such as lr.*, as STORE#LEAGUE, or of a sweep.

    Other stores are closed with `until`. Raises ConfigError or StorageError, one line, if there is none of a name.
    """
    found: list[Member] = []
    for name in [*names, *([f"{sweep}.*"] if sweep else [])]:
        where, other, league = name.rpartition("#")
        opened = until.enter_context(Store.open(where)) if other else store
        own = list(_matching(opened, league if other else name))
        if not own and sweep and name == f"{sweep}.*":
            raise UnknownName("sweep", sweep, _sweeps(opened))
        if not own:
            raise UnknownName("league", name, [each.name for each in opened.leagues()])
        found += [Member(Open(opened, each), f"{where}#{each}" if other else each, {}) for each in own]
    unique = list({(m.opened.store.where, m.opened.league): m for m in found}.values())
    if not unique:
        raise ConfigError((), "league compare needs leagues: names, patterns such as 'lr.*', or --sweep NAME")
    starts = WarmStarts([m.opened for m in unique])
    return [replace(m, settings=starts.of_cell(m.opened.store, m.opened.league)) for m in unique]


def cells(found: Sequence[Member]) -> list[Cell]:
    """Return the cells of leagues, in the order of their first leagues."""
    groups: dict[str, list[Member]] = {}
    for member in found:
        groups.setdefault(repr(sorted(member.settings.items())), []).append(member)
    keys = list(dict.fromkeys(key for group in groups.values() for key in group[0].settings))
    differ = [key for key in keys if len({repr(g[0].settings.get(key)) for g in groups.values()}) > 1]
    return [_cell(group, differ) for group in groups.values()]


def _cell(group: Sequence[Member], differ: Sequence[str]) -> Cell:
    own = {key: group[0].settings.get(key) for key in differ}
    text = ", ".join(f"{key.rpartition('.')[2]} = {value}" for key, value in [*own.items()][:SHOWN])
    text += f", and {len(own) - SHOWN} more" if len(own) > SHOWN else ""
    if not own:
        text = "all"
    elif len(own) > SHOWN:
        text = group[0].name  # too many differences to be told: not a cell of a sweep
    return Cell(text, own, group)


def _matching(store: Store, pattern: str) -> Iterator[str]:
    """Yield the leagues that a name or a pattern means; a pattern means no stages, no cross-play and no attacks.

    A pattern with the infix of attacks means these.
    """
    for league in store.leagues():
        if league.name == pattern:
            yield league.name
        elif INFIX in league.name and INFIX not in pattern:
            continue  # a league of `league exploit` has the settings of one attack: it would be a cell of its own
        elif any(c in pattern for c in "*?[") and fnmatchcase(league.name, pattern):
            of = course(store, league.name)
            own = of is None and not league.name.startswith(CROSS_PLAY) and not holds_copies(store, league.name)
            if own or (of is not None and of.root == league.name):
                yield league.name


def holds_copies(store: Store, league: str) -> bool:
    """Return whether a league holds the matches of comparisons: all its players are copies from other leagues."""
    found = store.players(league)
    return bool(found) and all(p.role == FIXED.name and p.name.startswith(f"{p.group}.") for p in found)


def _sweeps(store: Store) -> list[str]:
    """Return the sweeps of a store, from the names of their runs, such as lr.lr-0.001.s1."""
    names = (league.name for league in store.leagues())
    return list(dict.fromkeys(name.partition(".")[0] for name in names if re.search(r"\.s\d+$", name)))
