"""Exact best responses and exploitability of tabular policies in extensive-form games.

A best response is computed over the responder's information states (Johanson et al. 2011, "Accelerating best response
calculation in large extensive games"). With perfect recall they form a forest: what the responder knows at its next
turn contains what it knew and did before. A place in the forest is represented by its belief: the states of the game
that the responder cannot tell apart there, and the probability with which chance and the opponent play towards each.

In a game like dark hex, states drop the order of moves, and then many places of the forest share one information state
and have beliefs over the same states. They are rows of one matrix, and an action takes all of them to their successors
by one product. Thus the opponent's policy may forget as much as its information states do, and the response forgets
nothing.

NashConv is the sum over both players of what a best response gains; with zero sum it is the sum of the values of both
best responses. Exploitability is half of it (Lanctot et al. 2017, "A unified game-theoretic approach to multiagent
reinforcement learning").
"""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from matchmaking.extensive_games.game import CHANCE, TERMINAL, ExtensiveGame, Table

AT_ONCE = 20_000_000  # numbers in the beliefs that are held at once at each depth of the forest
Columns = dict[Hashable, dict[Any, int]]  # information state -> its states -> their column in beliefs
Beliefs = Mapping[Hashable, np.ndarray]  # information state -> (places, states) probabilities


class Exploitability(NamedTuple):
    """The result for a policy of both players."""

    nash_conv: float
    exploitability: float
    best_response_values: tuple[float, float]  # of player 0 against the policy's player 1, and the reverse


def exploitability(game: ExtensiveGame, table: Table) -> Exploitability:
    """Return NashConv, exploitability and the values of best responses to a tabular policy.

    Raises ValueError for probabilities that are not finite, are negative or do not sum to 1.
    """
    check_table(table)
    first, second = (best_response_value(game, table, player) for player in (0, 1))
    return Exploitability(first + second, (first + second) / 2, (first, second))


def best_response_value(game: ExtensiveGame, table: Table, responder: int) -> float:
    """Return the expected return of a best response by player `responder` to the other player's policy."""
    return _Response(game, table, responder).value()


def check_table(table: Table) -> None:
    """Raise ValueError unless every row holds probabilities."""
    for key, row in table.items():
        if not np.isfinite(row).all():
            raise ValueError(f"the policy is not finite in the information state {key}")
        if (row < 0).any() or abs(row.sum() - 1) > 1e-6:
            raise ValueError(f"the policy's probabilities in the information state {key} are {row.tolist()}")


class _Reached(NamedTuple):
    """Result of a state until the responder's next turn."""

    gain: float  # the responder's expected return from games that end before
    turns: dict[Any, float]  # state at the responder's turn -> probability


class _Step(NamedTuple):
    """Successors of an information state, for all of the responder's actions."""

    gains: np.ndarray  # (states, actions) the responder's expected return from games that end before its next turn
    move: np.ndarray  # (states, all states that may follow) probabilities
    parts: Sequence[tuple[int, Hashable, slice]]  # action, information state that follows, columns of its states


class _Response:
    """The best response of one player: the successors of all information states, and its value."""

    def __init__(self, game: ExtensiveGame, table: Table, responder: int):
        self.game, self.table, self.responder = game, table, responder
        self.steps: dict[Hashable, _Step] = {}
        self.first = self._follow(game.start())
        self.columns = turn = self._by_information(self.first.turns)
        while turn:  # the responder's first, second, ... turn
            turn = self._add_steps(turn)

    def value(self) -> float:
        """Return the value of the game to the responder."""
        first = {key: np.array([[self.first.turns[state] for state in states]]) for key, states in self.columns.items()}
        return float(self.first.gain + sum(values.sum() for values in self._values(first).values()))

    # Successors ------------------------------------------------------------------------------------------------------

    def _follow(self, start: Any) -> _Reached:
        """Let chance and the opponent play from a state until the responder's next turn."""
        game, sign = self.game, 1.0 if self.responder == 0 else -1.0
        gain, turns, waiting = 0.0, {}, [(start, 1.0)]
        while waiting:
            state, weight = waiting.pop()
            player = game.player(state)
            if player == TERMINAL:
                gain += sign * weight * game.gain(state)
            elif player == self.responder:
                turns[state] = turns.get(state, 0.0) + weight
            else:
                legal = game.legal(state)
                if player == CHANCE:
                    shares = np.full(len(legal), 1 / len(legal))
                else:
                    shares = self.table[game.information(state, player)][legal]
                waiting += [(game.play(state, a), weight * p) for a, p in zip(legal, shares.tolist(), strict=True) if p]
        return _Reached(gain, turns)

    def _by_information(self, states: Iterable[Any]) -> Columns:
        """Return the states at the responder's turn by what it knows there, each with its column."""
        found: Columns = {}
        for state in states:
            columns = found.setdefault(self.game.information(state, self.responder), {})
            columns.setdefault(state, len(columns))
        return found

    def _add_steps(self, turn: Columns) -> Columns:
        """Add the steps of one turn of the responder; return the states at its next turn."""
        game, known = self.game, {}
        after: dict[Hashable, list[list[_Reached]]] = {}  # information state -> for each action and state
        for key, states in turn.items():
            legal = game.legal(next(iter(states)))
            after[key] = []
            for action in legal:
                reached = [game.play(state, action) for state in states]
                known |= {state: self._follow(state) for state in reached if state not in known}
                after[key].append([known[state] for state in reached])
        columns = self._by_information(state for reached in known.values() for state in reached.turns)
        self.steps |= {key: self._step(by_action, columns) for key, by_action in after.items()}
        return columns

    def _step(self, by_action: list[list[_Reached]], columns: Columns) -> _Step:
        """Return one information state's step; `columns` are those of all that may follow."""
        gains = np.array([[each.gain for each in reached] for reached in by_action]).T
        blocks, parts, width = [np.zeros((len(gains), 0))], [], 0
        for action, reached in enumerate(by_action):
            for then in self._by_information(state for each in reached for state in each.turns):
                block = np.zeros((len(gains), len(columns[then])))
                for row, each in enumerate(reached):
                    for state, share in each.turns.items():
                        if (column := columns[then].get(state)) is not None:
                            block[row, column] = share
                blocks.append(block)
                parts.append((action, then, slice(width, width + block.shape[1])))
                width += block.shape[1]
        return _Step(gains, np.concatenate(blocks, axis=1), parts)

    # Values ----------------------------------------------------------------------------------------------------------

    def _values(self, beliefs: Beliefs) -> dict[Hashable, np.ndarray]:
        """Return the values (places,) of beliefs after equally many turns of the responder, some at a time."""
        found: dict[Hashable, list[np.ndarray]] = {}
        batch: dict[Hashable, np.ndarray] = {}
        size = 0
        for key, rows in beliefs.items():
            width = max(self.steps[key].move.shape[1], 1)
            most = max(AT_ONCE // width, 1)
            for part in (rows[at : at + most] for at in range(0, len(rows), most)):
                if key in batch or size + part.shape[0] * width > AT_ONCE:
                    self._add_best(batch, found)
                    batch, size = {}, 0
                batch[key] = part
                size += part.shape[0] * width
        self._add_best(batch, found)
        return {key: np.concatenate(parts) for key, parts in found.items()}

    def _add_best(self, beliefs: Beliefs, found: dict[Hashable, list[np.ndarray]]) -> None:
        """Append the values (places,) of the best action in each place of these beliefs."""
        following: dict[Hashable, list[np.ndarray]] = {}
        for key, rows in beliefs.items():
            moved = rows @ self.steps[key].move
            for _, then, columns in self.steps[key].parts:
                following.setdefault(then, []).append(moved[:, columns])
        later = self._values({k: np.concatenate(parts) for k, parts in following.items()}) if following else {}
        taken = dict.fromkeys(later, 0)
        for key, rows in beliefs.items():
            options = rows @ self.steps[key].gains
            for action, then, _ in self.steps[key].parts:
                options[:, action] += later[then][taken[then] : taken[then] + len(rows)]
                taken[then] += len(rows)
            found.setdefault(key, []).append(options.max(axis=1))
