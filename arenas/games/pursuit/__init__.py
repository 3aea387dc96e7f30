"""Pursuit: slow predators against quicker prey among obstacles. Settings alone; nothing here loads jax."""

from arenas.games.pursuit.settings import ARENAS, PursuitReward, PursuitRules, PursuitSettings

__all__ = ["ARENAS", "PursuitReward", "PursuitRules", "PursuitSettings"]
