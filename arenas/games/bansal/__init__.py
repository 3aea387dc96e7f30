"""The games of Bansal et al. 2018 between two bodies. Settings alone; nothing here loads jax."""

from arenas.games.bansal.settings import (
    ARENAS,
    KickAndDefendSettings,
    RingSumoSettings,
    RunToGoalSettings,
    YouShallNotPassSettings,
)

__all__ = ["ARENAS", "KickAndDefendSettings", "RingSumoSettings", "RunToGoalSettings", "YouShallNotPassSettings"]
