"""Arenas built from the settings of leagues to be described: in which a policy learnt, and what it observed there."""

import os
from functools import cache, lru_cache
from typing import TYPE_CHECKING, NamedTuple

from arenas.description import Part
from arenas.rosters import bare
from league.config import experiment

if TYPE_CHECKING:
    from arenas.arena import Arena


class HomeAgent(NamedTuple):
    """An agent of the team that a policy played where it learnt."""

    kind: str  # of robot
    action_size: int
    parts: tuple[Part, ...]  # of its observation; empty if its arena does not name them


class HomeTeam(NamedTuple):
    """The team that a policy played where it learnt."""

    arena: str
    config_hash: str  # of the arena as it is built now
    interval: float  # s between two decisions
    agents: tuple[HomeAgent, ...]


def described_arena(settings: str) -> tuple["Arena | None", str]:
    """Return the arena of a league's settings, for its description alone; else the first line of the reason why not."""
    os.environ.setdefault("JAX_PLATFORMS", "cpu")  # nothing is simulated, and opening a GPU would take seconds
    try:
        return _built(settings), ""
    except (Exception, SystemExit) as error:  # the arena may be a stranger's file
        return None, next(iter(str(error).splitlines()), "") or type(error).__name__


@lru_cache(maxsize=2)  # of a league, and of a policy that learnt elsewhere: seconds each
def _built(settings: str) -> "Arena":
    return experiment.loads(settings).arena.build(engine="c", threads=1)


@cache
def home_team(settings: str, roster: str) -> HomeTeam:
    """Return the team of this roster in the arena of these settings, a league's as TOML. The arena is built: seconds.

    Raises ValueError, one line, if the arena cannot be built or has no such team.
    """
    try:
        home = experiment.loads(settings).arena.build(engine="c", threads=1)
    except (Exception, SystemExit) as error:  # the arena may be a stranger's file
        raise ValueError(f"the arena in which it learnt cannot be built: {error}") from None
    return team_in(home, roster)


def team_in(home: "Arena", roster: str) -> HomeTeam:
    """Return the team of this roster in an arena. Raises ValueError, one line, if there is none."""
    team = next((each for each in home.teams if bare(each.roster) == bare(roster)), None)
    if team is None:
        raise ValueError(f"no team of {home.name}, where it learnt, is {roster}")
    agents = [
        HomeAgent(agent.kind, agent.action_size, tuple(home.observation_parts(agent.name))) for agent in team.agents
    ]
    return HomeTeam(home.name, home.config_hash, home.timing.decision_interval, tuple(agents))
