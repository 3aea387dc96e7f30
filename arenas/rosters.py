"""What rosters an arena can have."""

import re
from collections.abc import Mapping, Sequence

from arenas.errors import ArenaError
from arenas.robots.robot import Robot

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")  # of teams: part of body names, paths in the viewer and names of players


def check_rosters(robots: Mapping[str, Sequence[Robot]]) -> None:
    """Raise ArenaError for teams without a proper name or robot, and for two robots of one kind that act unlike."""
    if not robots:
        raise ArenaError("an arena needs at least one team")
    for team, members in robots.items():
        if not NAME.fullmatch(team):
            raise ArenaError(f"team name {team!r}: use a letter, then letters, digits, - and _")
        if not members:
            raise ArenaError(f"team {team} has no robots")
    every = [robot for members in robots.values() for robot in members]
    for robot in every:
        sizes = {r.action_size for r in every if r.kind == robot.kind}
        if len(sizes) > 1:
            raise ArenaError(f"robots of kind {robot.kind} have {sorted(sizes)} actions: give them kinds of their own")
