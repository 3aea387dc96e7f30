"""Soccer: matches of any robots, and the stages of HARL-A that lead to them. Settings alone; nothing here loads jax."""

from arenas.games.soccer import settings, stages
from arenas.games.soccer.rules import Ball, Defects
from arenas.games.soccer.settings import RewardDefects, SoccerReward, SoccerRules, SoccerSettings
from arenas.games.soccer.stages import DrillReward, DrillRules, DrillSettings, SoccerWalkSettings

ARENAS = (*stages.ARENAS, *settings.ARENAS)

__all__ = [
    "ARENAS",
    "Ball",
    "Defects",
    "DrillReward",
    "DrillRules",
    "DrillSettings",
    "RewardDefects",
    "SoccerReward",
    "SoccerRules",
    "SoccerSettings",
    "SoccerWalkSettings",
]
