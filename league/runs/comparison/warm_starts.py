"""Warm starts as a setting of a cell: `after`, with names that are the same in all leagues of a cell.

A league's own forerunner differs with its seed as the league itself does: `match.s1` starts from `walk.s1`, `match.s2`
from `walk.s2`. Such names count as one; all others tell cells apart.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

from league.config.sections import POLICY_FILE
from league.queries.query import Open
from league.runs.sweeps.run_state import flat_settings
from league.state.curriculum_stage import course
from storage.store import Store

OWN = ("league", "seed", "workers", "storage")
"""Settings that do not make another cell."""


class WarmStarts:
    """The warm starts of the leagues of a comparison."""

    def __init__(self, leagues: Sequence[Open]):
        self._seeds = defaultdict[tuple[str, str], set[Any]](set)  # of the leagues that start from each league
        self._first: dict[str, dict[Any, str]] = {}  # by settings: the forerunners, by their seeds
        for each in leagues:
            settings = flat_settings(each.store.league(each.league).config)
            for name in settings.get("after", ()):
                self._seeds[each.store.where, _league(name)].add(settings.get("seed"))

    def of_cell(self, store: Store, league: str, passed: Sequence[str] = ()) -> Mapping[str, Any]:
        """Return the settings, by dotted key, that make the cell of a league.

        Args:
            store: the league's store.
            league: its name.
            passed: leagues that start from it, whose settings are asked for.
        """
        settings = flat_settings(store.league(league).config)
        own = {key: value for key, value in settings.items() if key.partition(".")[0] not in OWN}
        if after := settings.get("after"):
            found = course(store, league)
            stages = {f"{found.root}.{stage}": stage for stage in found.stages} if found else {}
            own["after"] = [
                stages[_league(name)] + name[len(_league(name)) :] if _league(name) in stages
                else self._named(store, name, settings.get("seed"), (*passed, league))
                for name in after
            ]  # fmt: skip
        return own

    def _named(self, store: Store, name: str, seed: Any, passed: Sequence[str]) -> str:
        """Return the name of a forerunner, which is that of the first such league if they differ by seeds alone.

        The forerunner is a league's own if it has the seed of all leagues that start from it.
        """
        league = _league(name)
        if league in passed or league not in {each.name for each in store.leagues()}:
            return name
        its_seed = flat_settings(store.league(league).config).get("seed")
        if {seed, *self._seeds[store.where, league]} != {its_seed}:
            return name
        settings = self.of_cell(store, league, passed)
        alike = self._first.setdefault(repr(sorted(settings.items())), {})
        if alike.setdefault(its_seed, league) != league:
            return name  # two leagues of one seed are two starts, which a comparison may be about
        return next(iter(alike.values())) + name[len(league) :]


def _league(name: str) -> str:
    """Return the league in a name of `after`, which may be that of a snapshot, LEAGUE/SNAPSHOT, or of a file."""
    return name if name.endswith(POLICY_FILE) else name.partition("/")[0]
