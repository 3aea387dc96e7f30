"""The sequence form of a game (Koller, Megiddo and von Stengel 1996): policies as vectors, returns as products.

A sequence of a player is an action in one of its information states, with all that it did before. The plan of a policy
has for each sequence the product of the policy's probabilities along it. The expected return of two plans is bilinear,
and the mean of plans is the plan of a mixture of whole policies, of which one is drawn before the game.
"""

from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np

from matchmaking.extensive_games.game import CHANCE, TERMINAL, ExtensiveGame, Table

Plans = tuple[np.ndarray, np.ndarray]  # of the players 0 and 1, (sequences,) each; the first is 1, for no action yet


class SequenceForm:
    """The sequences of both players, and the returns of each pair of them."""

    def __init__(self, game: ExtensiveGame):
        """Walk through the game. Raises ValueError where a player forgets what it did or knew (no perfect recall)."""
        self.game = game
        # Of each player: information state -> (the sequence that leads there, its first own sequence, legal actions).
        self.turns: tuple[dict[Hashable, tuple[int, int, tuple[int, ...]]], ...] = ({}, {})
        self.sizes = [1, 1]
        self._rows: list[int] = []
        self._columns: list[int] = []
        self._gains: list[float] = []  # of player 0, times the probability of chance's outcomes
        self._walk(game.start(), (0, 0), 1.0)
        self.rows, self.columns, self.gains = map(np.array, (self._rows, self._columns, self._gains))

    def _walk(self, state: Any, sequences: tuple[int, int], chance: float) -> None:
        """Add all sequences and returns from a state that these sequences of the players lead to."""
        game, player = self.game, self.game.player(state)
        if player == TERMINAL:
            self._rows.append(sequences[0])
            self._columns.append(sequences[1])
            self._gains.append(chance * game.gain(state))
            return
        legal = tuple(game.legal(state))
        if player == CHANCE:
            for outcome in legal:
                self._walk(game.play(state, outcome), sequences, chance / len(legal))
            return
        turns, key = self.turns[player], game.information(state, player)
        if key not in turns:
            turns[key] = sequences[player], self.sizes[player], legal
            self.sizes[player] += len(legal)
        before, first, _ = turns[key]
        if before != sequences[player]:
            raise ValueError(f"{game.name}: a player forgets how it came to the information state {key}")
        for i, action in enumerate(legal):
            after = (first + i, sequences[1]) if player == 0 else (sequences[0], first + i)
            self._walk(game.play(state, action), after, chance)

    def plans(self, table: Table) -> Plans:
        """Return the plans of both players for a policy."""
        found = []
        for turns, size in zip(self.turns, self.sizes, strict=True):
            plan = np.ones(size)
            for key, (before, first, legal) in turns.items():  # what leads to an information state was added before it
                plan[first : first + len(legal)] = plan[before] * table[key][list(legal)]
            found.append(plan)
        return found[0], found[1]

    def table(self, plans: Plans) -> dict[Hashable, np.ndarray]:
        """Return the policy of these plans; uniform where it never comes."""
        found = {}
        for turns, plan in zip(self.turns, plans, strict=True):
            for key, (before, first, legal) in turns.items():
                row = np.zeros(self.game.actions)
                reached = plan[before] > 0
                row[list(legal)] = plan[first : first + len(legal)] / plan[before] if reached else 1 / len(legal)
                found[key] = row / row.sum()
        return found

    def mixture(self, plans: Sequence[Plans], weights: np.ndarray) -> Plans:
        """Return the plans of the mixture of policies with these weights, which sum to 1."""
        first, second = (np.stack(each) for each in zip(*plans, strict=True))
        return weights @ first, weights @ second

    def payoffs(self, ours: Sequence[Plans], theirs: Sequence[Plans]) -> np.ndarray:
        """Return the mean return over both seats of each policy of `ours` against each of `theirs`."""
        a, b = ([np.stack(each) for each in zip(*plans, strict=True)] for plans in (ours, theirs))
        as_first = (a[0][:, self.rows] * self.gains) @ b[1][:, self.columns].T
        as_second = (a[1][:, self.columns] * self.gains) @ b[0][:, self.rows].T
        return (as_first - as_second) / 2

    def exploitability(self, plans: Plans) -> float:
        """Return the exploitability of plans: the mean of what best responses to them gain in both seats.

        It is that of `best_response.exploitability` on their policy, by one pass over the sequences.
        """
        against_second = np.bincount(self.rows, self.gains * plans[1][self.columns], self.sizes[0])
        against_first = np.bincount(self.columns, -self.gains * plans[0][self.rows], self.sizes[1])
        total = 0.0
        for turns, values in zip(self.turns, (against_second, against_first), strict=True):
            for before, first, legal in reversed(turns.values()):
                values[before] += values[first : first + len(legal)].max()
            total += values[0]
        return float(total / 2)
