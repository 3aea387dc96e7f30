"""Sumo: matches of any robots, and the stages of HARL-A that lead to them. Settings alone; nothing here loads jax."""

from arenas.games.sumo import settings, stages
from arenas.games.sumo.settings import Defects, SumoReward, SumoRules, SumoSettings
from arenas.games.sumo.stages import (
    BlockPushReward,
    BlockPushRules,
    BlockPushSettings,
    WalkReward,
    WalkRules,
    WalkSettings,
)

ARENAS = (*stages.ARENAS, *settings.ARENAS)

__all__ = [
    "ARENAS",
    "BlockPushReward",
    "BlockPushRules",
    "BlockPushSettings",
    "Defects",
    "SumoReward",
    "SumoRules",
    "SumoSettings",
    "WalkReward",
    "WalkRules",
    "WalkSettings",
]
