"""Worlds that do not live on from one turn to the next, and what follows for the episodes that count.

Episodes count once their world has run for the longest of them (`agents/rollout/new_worlds.py`). Where worlds begin
anew every turn and turns are shorter, none would ever count.
"""

from league.config.experiment import Config
from league.config.sections import named_players


def renewal(config: Config) -> str:
    """Return in words why worlds begin anew with nearly every turn; "" if they live on.

    A worker keeps the worlds of a group of players until another worker does a turn of it. With more groups than
    workers the groups move from worker to worker. Workers of other hosts are not known here.
    """
    if config.deterministic:
        return "in a deterministic league worlds begin anew every turn"
    groups, workers = len({player.group for player in named_players(config.players)}), config.workers.train
    if 1 < workers < groups:
        return (
            f"{groups} groups of players move between {workers} train workers and worlds begin anew nearly every turn"
        )
    return ""


def settles(config: Config, longest: int) -> bool:
    """Return whether episodes of new worlds do not count at first; `longest` are the decisions of the longest one."""
    return config.training.stagger and (not renewal(config) or config.training.outlasts(longest))
