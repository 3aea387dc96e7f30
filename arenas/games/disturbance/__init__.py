"""A walk that nature disturbs: by forces on the walker's bodies, or by its masses and friction. Settings alone."""

from arenas.games.disturbance.settings import ARENAS, DisturbanceSettings

__all__ = ["ARENAS", "DisturbanceSettings"]
