"""Swarm: many pucks against few rovers that guard a zone. Settings alone; nothing here loads jax."""

from arenas.games.pursuit.swarm.settings import ARENAS, SwarmReward, SwarmRules, SwarmSettings

__all__ = ["ARENAS", "SwarmReward", "SwarmRules", "SwarmSettings"]
