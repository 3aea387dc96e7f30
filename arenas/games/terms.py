"""Settings of terms that a file of functions adds to a game's rewards and observations. Loads neither jax nor mujoco.

`arenas.games.added_terms` has the functions' arguments and builds them in. An arena of your own takes terms if its
settings inherit from `WithTerms`, its reward from `RewardTerms`, and its `build` returns `with_terms(arena, self)`.
"""

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

from arenas.arena_settings import Table

if TYPE_CHECKING:
    from arenas.arena import Arena

A = TypeVar("A", bound="Arena")
KEYS = ("function", "weight", "shaping")


class TermSpec(NamedTuple):
    """A term as settings describe it."""

    name: str
    file: Path
    function: str
    weight: float = 1.0
    shaping: bool = False  # a learner anneals it

    @property
    def where(self) -> str:
        """The function as settings name it."""
        return f"{self.file}:{self.function}"


def check_reward_terms(table: Mapping[str, Any]) -> None:
    """Raise ValueError, one line, for a table that describes no reward terms."""
    term_specs(table)


def check_observation_terms(table: Mapping[str, Any]) -> None:
    """Raise ValueError, one line, for a table that describes no observation terms, which have no weight."""
    term_specs(table, ("function",))


def term_specs(table: Mapping[str, Any], keys: tuple[str, ...] = KEYS) -> list[TermSpec]:
    """Return the terms in a table: name -> file.py:function, or a table of a function and its weight.

    Raises ValueError, one line, for an entry of another form.
    """
    return [_spec(name, value, keys) for name, value in table.items()]


def _spec(name: str, value: Any, keys: tuple[str, ...]) -> TermSpec:
    given = value if isinstance(value, Mapping) else {"function": value}
    if unknown := [key for key in given if key not in keys]:
        raise ValueError(f"{name}: unknown key {unknown[0]} (keys: {', '.join(keys)})")
    where, weight, shaping = given.get("function"), given.get("weight", 1.0), given.get("shaping", False)
    if not isinstance(where, str) or not re.search(r"\.py:\w+$", where):
        raise ValueError(f"{name}: must name a function in a file, such as my/terms.py:{name.replace('-', '_')}")
    if isinstance(weight, bool) or not isinstance(weight, int | float):
        raise ValueError(f"{name}: its weight must be a number")
    if not isinstance(shaping, bool):
        raise ValueError(f"{name}: shaping must be true or false")
    file, _, function = where.rpartition(":")
    return TermSpec(name, Path(file), function, float(weight), shaping)


@dataclass(frozen=True)
class RewardTerms:
    """A game's reward, with terms of functions in files."""

    terms: Table = field(default_factory=Table, kw_only=True, metadata={"valid": check_reward_terms})
    """Terms of your own, which are added or replace those of their names: name = "file.py:function", or {function =
    "file.py:function", weight = 0.5, shaping = true}, where shaping is annealed like the dense reward."""

    ENDINGS: ClassVar[tuple[str, ...]] = ()
    """Names of the weights that an episode's end may cost a team."""

    @property
    def worst_ending(self) -> float:
        """Cost of an episode's worst end to a team, at least 1: breaking the physics must cost no less."""
        return max([1.0, *(abs(getattr(self, name)) for name in self.ENDINGS)])


@dataclass(frozen=True)
class WithTerms:
    """Settings of a game, with observations of functions in files."""

    observation_terms: Table = field(default_factory=Table, kw_only=True, metadata={"valid": check_observation_terms})
    """Numbers of your own, which follow an agent's observation or replace its part of that name: name =
    "file.py:function"."""


def weights_of(reward: RewardTerms) -> dict[str, Any]:
    """Return a reward's weights by name, without the terms of functions."""
    return {name: weight for name, weight in asdict(reward).items() if name != "terms"}  # type: ignore[arg-type]


def with_terms(arena: A, settings: Any) -> A:
    """Return the arena with the terms of its settings built in. Raises ArenaError, one line, for one that fails."""
    rewards, observations = settings.reward.terms, settings.observation_terms
    if rewards or observations:
        from arenas.games.added_terms import add_terms

        add_terms(arena, term_specs(rewards), term_specs(observations))
    return arena
