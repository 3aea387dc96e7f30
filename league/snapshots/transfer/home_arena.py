"""The arena in which a policy learnt, as far as its settings can be built here: what its agents observed there."""

from functools import cache
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
