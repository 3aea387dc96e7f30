"""Sumo: matches of any robots, and the stages of HARL-A that lead to them. Settings alone; nothing here loads jax."""

from arenas.sumo import settings, stages
from arenas.sumo.settings import Defects, SumoReward, SumoRules, SumoSettings
from arenas.sumo.stages import (
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
