"""Matrix games: two players, a table of payoffs, no bodies."""

from arenas.games.matrix.settings import ARENAS

__all__ = ["ARENAS"]
