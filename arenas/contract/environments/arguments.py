"""Checks of what users give to environments, and the spaces that they get. Every error is one line."""

import math
import random
from typing import Any

import numpy as np
from gymnasium import spaces

from arenas.arena import Arena
from arenas.errors import ArenaError
from arenas.state import OBSERVATION_LIMIT

SEEDS = 2**32  # seeds are below it


def observation_box(size: int) -> spaces.Box:
    """Return the space of `size` numbers of observations."""
    return spaces.Box(-OBSERVATION_LIMIT, OBSERVATION_LIMIT, (size,), np.float32)


def action_box(size: int, limit: float) -> spaces.Box:
    """Return the space of `size` numbers of actions within ±`limit`."""
    return spaces.Box(-limit, limit, (size,), np.float32)


def team_index(arena: Arena, team: str) -> int:
    """Return the number of a team. Raises ArenaError, which lists the teams."""
    names = [each.name for each in arena.teams]
    if team not in names:
        raise ArenaError(f"arena {arena.name} has no team {team!r}; it has {', '.join(names)}")
    return names.index(team)


def number(name: str, value: Any, above: float | None = None) -> float:
    """Return a number that must be finite, at least 0 or, if given, greater than `above`."""
    good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    if not good or (value < 0 if above is None else value <= above):
        raise ArenaError(
            f"{name}={value!r:.40}: give a number {'of 0 or more' if above is None else f'above {above:g}'}"
        )
    return float(value)


def whole(name: str, value: Any) -> int:
    """Return a whole number of at least 1."""
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < 1:
        raise ArenaError(f"{name}={value!r:.40}: give a whole number of 1 or more")
    return int(value)


def seed_of(seed: Any) -> int:
    """Return a seed for `jax.random.key`; one from the system's entropy if None."""
    if seed is None:
        return random.SystemRandom().randrange(SEEDS)
    if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or not 0 <= seed < SEEDS:
        raise ArenaError(f"seed={seed!r:.40}: give a whole number from 0 to {SEEDS - 1}, or None")
    return int(seed)


def no_rendering(render_mode: Any) -> None:
    """Refuse every render mode: pictures are made from recordings of matches, which arenas do not know."""
    if render_mode is not None:
        raise ArenaError(
            f"render_mode={render_mode!r:.40}: environments draw nothing; `league play` records a match of two"
            " policies, and `league watch` shows it"
        )
