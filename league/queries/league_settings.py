"""A league's settings in its store: text from which a query reads single values.

A whole configuration would need the arena, whose file may be missing on a machine that only reads the store.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar, get_args

from matchmaking.schedule import Kind, Schedule

if TYPE_CHECKING:
    from league.config.sections import Budget
    from matchmaking.roles import Role

R = TypeVar("R", int, float, str, list)


@dataclass(frozen=True)
class LeagueSettings:
    """The settings of a league."""

    league: str
    text: str

    def get(self, *key: str, otherwise: R) -> R:
        """Return a setting, e.g. `get("rating", "share", otherwise=0.1)`; `otherwise` if the text lacks it.

        The key and the text may use former names of settings.
        """
        from league.config.former_names import value_at
        from league.config.sections import section

        try:
            return type(otherwise)(value_at(self._table[key[0]], key[1:], section(key[0])))
        except (ValueError, KeyError, TypeError):
            return otherwise

    @cached_property
    def _table(self) -> Any:
        """All settings as a table; empty if the text is invalid."""
        import tomllib

        try:
            return tomllib.loads(self.text)
        except (ValueError, RecursionError):
            return {}

    @property
    def copies_after(self) -> int:
        """Environment steps after which players are compared and may copy each other; 0 if never."""
        return self.get("training", "pbt", "ready", otherwise=0)

    @property
    def rating_share(self) -> float:
        """Share of device time that rating matches may take while players learn."""
        from league.config.sections import Rating

        return self.get("rating", "share", otherwise=Rating().share)

    def roles(self) -> Callable[[str], "Role"]:
        """Return a function from names to roles, defaults filled in. Raises ConfigError for invalid settings."""
        from league.config import toml
        from league.config.build import build
        from matchmaking.opponents import Opponents
        from matchmaking.roles import Role, role_named

        settings = toml.parse(self.text, f"league {self.league}")
        declared = [build(Role, table) for table in settings.get("roles", ())]
        otherwise = build(Opponents, settings.get("training", {}).get("opponents", {}))
        return lambda name: role_named(name, declared, otherwise)

    def schedule(self) -> Schedule:
        """Return the schedule of the league's kind, with defaults for all other settings."""
        schedules = {kind: Schedule(kind) for kind in get_args(Kind)}
        return schedules.get(self.get("training", "schedule", "kind", otherwise=""), Schedule())

    def training_budget(self) -> "Budget":
        """Return the budget of training in time and in steps, without other rules that may end training."""
        from league.config.sections import Budget

        time, steps = self.get("budget", "training_time", otherwise=""), self.get("budget", "steps", otherwise=0)
        return Budget(time or None, steps or None)
