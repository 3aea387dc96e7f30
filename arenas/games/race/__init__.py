"""Gate race: drones that race through gates, each a team of its own. Settings alone; nothing here loads jax."""

from arenas.games.race.settings import ARENAS, RaceReward, RaceRules, RaceSettings

__all__ = ["ARENAS", "RaceReward", "RaceRules", "RaceSettings"]
