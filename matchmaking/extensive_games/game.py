"""The interface of a two-player zero-sum game in extensive form, and a walk over its information states.

Players are 0 and 1. A state is a hashable value that holds all that the rest of the game depends on. Rules, the order
of players and of chance, actions and returns are those of OpenSpiel (Lanctot et al. 2019, "OpenSpiel: a framework for
reinforcement learning in games"), so that values can be compared.
"""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

CHANCE, TERMINAL = -1, -2
Table = Mapping[Hashable, np.ndarray]
"""A tabular policy of both players: information state -> probabilities (actions,), 0 for illegal ones."""


class ExtensiveGame(Protocol):
    """Rules of a game. `play` also takes the outcomes of chance, which are numbered as actions are."""

    name: str
    actions: int
    """Number of actions of a player."""
    longest: int
    """Maximum number of actions of both players in a game."""

    def start(self) -> Any:
        """Return the first state."""
        ...

    def player(self, state: Any) -> int:
        """Return the player who acts, or CHANCE, or TERMINAL."""
        ...

    def legal(self, state: Any) -> Sequence[int]:
        """Return the legal actions of the player who acts, or the outcomes of chance, all equally likely."""
        ...

    def play(self, state: Any, action: int) -> Any:
        """Return the state after an action."""
        ...

    def gain(self, state: Any) -> float:
        """Return player 0's return in a terminal state, which player 1 loses."""
        ...

    def information(self, state: Any, player: int) -> Hashable:
        """Return what a policy of this player may depend on: its information state."""
        ...


class Situation(NamedTuple):
    """An information state of the player who acts in it, and the first history that leads to it."""

    player: int
    legal: tuple[int, ...]
    chance: tuple[int, ...]  # outcomes of chance in that history
    played: tuple[int, ...]  # actions of both players in that history


def situations(game: ExtensiveGame) -> dict[Hashable, Situation]:
    """Return all information states in which a player acts, each with one history of those that lead to it."""
    found: dict[Hashable, Situation] = {}
    visited = set()
    waiting: list[tuple[Any, tuple[int, ...], tuple[int, ...]]] = [(game.start(), (), ())]
    while waiting:
        state, chance, played = waiting.pop()
        if state in visited:  # another order of the same moves
            continue
        visited.add(state)
        player = game.player(state)
        if player == TERMINAL:
            continue
        legal = tuple(game.legal(state))
        if player == CHANCE:
            waiting += [(game.play(state, each), (*chance, each), played) for each in legal]
            continue
        found.setdefault(game.information(state, player), Situation(player, legal, chance, played))
        waiting += [(game.play(state, each), chance, (*played, each)) for each in legal]
    return found


def uniform_table(known: Mapping[Hashable, Situation], actions: int) -> dict[Hashable, np.ndarray]:
    """Return the policy that takes every legal action with equal probability."""
    return {key: masked(np.ones(actions), each.legal) for key, each in known.items()}


def masked(weights: np.ndarray, legal: Iterable[int]) -> np.ndarray:
    """Return weights (actions,) of the legal actions, scaled to probabilities."""
    kept = np.zeros(len(weights))
    places = list(legal)
    kept[places] = weights[places]
    return kept / kept.sum()
