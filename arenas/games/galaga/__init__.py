"""3D Galaga: tanks that aim against drones that fly, and the stages that lead there. Settings; nothing loads jax."""

from arenas.games.galaga import settings, stages
from arenas.games.galaga.settings import Area, Defects, GalagaReward, GalagaRules, GalagaSettings
from arenas.games.galaga.stages import AimReward, AimRules, AimSettings, FlyReward, FlyRules, FlySettings

ARENAS = (*stages.ARENAS, *settings.ARENAS)

__all__ = [
    "ARENAS",
    "AimReward",
    "AimRules",
    "AimSettings",
    "Area",
    "Defects",
    "FlyReward",
    "FlyRules",
    "FlySettings",
    "GalagaReward",
    "GalagaRules",
    "GalagaSettings",
]
