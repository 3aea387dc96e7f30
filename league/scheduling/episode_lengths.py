"""Consequences of the length of an arena's longest episode.

Rewards are averaged over one of them at least. Episodes count once their world has run for the longest of them
(`agents/rollout/new_worlds.py`); where worlds begin anew every turn and turns are shorter, none would ever count.
"""

import math

from arenas.arena_settings import Timing
from league.config.experiment import Config
from league.config.sections import named_players

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


def renewal(config: Config) -> str:
    """Return in words why worlds begin anew with nearly every turn; "" if they live on.

    A worker keeps the worlds of a group of players until another worker does a turn of it. With more groups than
    workers the groups move from worker to worker. How many workers other hosts have is not known here; where all are
    there, they count as too few.
    """
    if config.deterministic:
        return "in a deterministic league worlds begin anew every turn"
    groups, workers = len({player.group for player in named_players(config.players)}), config.workers.train
    if groups < 2 or workers == 1 or workers >= groups:
        return ""
    between = f"{workers} train workers" if workers else "the workers of other hosts"
    return f"{groups} groups of players move between {between} and worlds begin anew nearly every turn"


def settles(config: Config, longest: int) -> bool:
    """Return whether episodes of new worlds do not count at first; `longest` are the decisions of the longest one."""
    return config.training.stagger and (not renewal(config) or config.training.outlasts(longest))
