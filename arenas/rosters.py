"""Rosters: the check of an arena's teams, and the text form of a roster, which a policy must fit. Loads nothing heavy.

The text names the agents of a team with their sizes, e.g. `leatherback:38:2+leatherback:38:2`. Teams of equal
agents have one roster if the arena declares them exchangeable. Otherwise each has a roster of its own, which ends with
its side, e.g. `puck:6:2@chaser`, so that comparing rosters treats such teams as unlike.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from arenas.errors import ArenaError

if TYPE_CHECKING:
    from arenas.robots.robot import Robot

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")  # of teams: part of body names, of paths in the viewer and of player names
MOST_TEAMS = 8  # as many team colours can be told apart


class AgentSizes(NamedTuple):
    """Kind and sizes of one agent of a roster."""

    kind: str
    observation_size: int  # numbers in its observation
    action_size: int  # numbers in its action


def roster_text(agents: Iterable[AgentSizes], side: str = "") -> str:
    """Format the roster of these agents, in order; `side` is the team's name if equal teams are not exchangeable."""
    described = "+".join(f"{kind}:{observation_size}:{action_size}" for kind, observation_size, action_size in agents)
    return f"{described}@{side}" if side else described


def roster_side(roster: str) -> str:
    """Return the side at the end of a roster, or an empty string."""
    last = roster.rpartition(":")[2]
    return last.partition("@")[2]


def bare(roster: str) -> str:
    """Return a roster without its side, which is all that a network must fit."""
    side = roster_side(roster)
    return roster.removesuffix(f"@{side}") if side else roster


def roster_agents(roster: str) -> list[str]:
    """Return the agents of a roster as text, e.g. `leatherback:38:2`, in their order."""
    return bare(roster).split("+")


def matching_roster(roster: str, sides: Iterable[str]) -> str | None:
    """Return the one of `sides` that a policy of this roster can play; None if there is none or the choice is
    ambiguous.

    A policy that was trained on a named side can play that side, or exchangeable teams of equal agents. A policy whose
    roster names no side could belong to any of several named sides.
    """
    known = list(dict.fromkeys(sides))
    if roster in known:
        return roster
    return bare(roster) if roster_side(roster) and bare(roster) in known else None


def check_rosters(robots: "Mapping[str, Sequence[Robot]]") -> None:
    """Raise ArenaError for too few or too many teams, an invalid name, an empty team, or one kind with two action
    sizes.
    """
    if not robots:
        raise ArenaError("an arena needs at least one team")
    if len(robots) > MOST_TEAMS:
        named = ", ".join(map(str, robots))
        raise ArenaError(f"{len(robots)} teams ({named}): an arena has at most {MOST_TEAMS}; leave some out")
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
        if len({r.identity for r in every if r.kind == robot.kind}) > 1:
            raise ArenaError(f"two robot files are named {robot.kind}: give one of them another name")
