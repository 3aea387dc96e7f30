"""Games of turns and hidden information: Kuhn and Leduc poker, dark hex. No bodies."""

from arenas.games.matrix.turns.settings import ARENAS

__all__ = ["ARENAS"]
