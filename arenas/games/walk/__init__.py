"""Walking to a point, for any robot with feet. Settings alone; nothing here loads jax."""

from arenas.games.walk.settings import ARENAS, RobotWalkSettings

__all__ = ["ARENAS", "RobotWalkSettings"]
