"""Consequences of the length of an arena's longest episode.

Rewards are averaged over one of them at least. Episodes count once their world has run for the longest of them
(`agents/rollout/new_worlds.py`); where worlds begin anew every turn and turns are shorter, none would ever count.
"""

import math

from arenas.arena_settings import Timing
from league.config.experiment import Config

UNKNOWN_DECISIONS = 1000
"""Decisions of the longest episode where the arena's settings do not tell: those of most environments of Gymnasium."""


def longest_episode(config: Config) -> int:
    """Return the decisions of the longest episode of the arena."""
    timing = getattr(config.arena, "timing", None)  # settings of an arena of your own need not have one
    return timing.decisions if isinstance(timing, Timing) else UNKNOWN_DECISIONS


def averaged_iterations(config: Config) -> int:
    """Return the learning iterations over which rewards and successes of training are averaged; 0: none needed.

    Rewards are averaged over one longest episode at least: within less time only short episodes may end.
    """
    if config.budget.reward is None:
        return config.budget.window
    return max(config.budget.window, math.ceil(longest_episode(config) / config.training.rollout_length))


def settles(config: Config, longest: int) -> bool:
    """Return whether episodes of new worlds do not count at first; `longest` are the decisions of the longest one.

    In a deterministic league worlds begin anew every turn. Elsewhere they live on while one worker trains their group,
    for several of the longest episodes (`turn_scheduler.continued_turn`).
    """
    return config.training.stagger and (not config.deterministic or config.training.outlasts(longest))
