"""Dark hex as an arena: the classical game of OpenSpiel, in which a player moves again after running into a stone.

The number of attempts so far is known to both, as in OpenSpiel's information states. What it adds to what a player sees
is how many of its own stones the other has run into.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.description import Part
from arenas.games.matrix.turns.match import TurnGame, Turns
from arenas.games.matrix.turns.settings import CELLS
from arenas.physics.engine import Physics

ALL = CELLS * CELLS


class Board(NamedTuple):
    """A game of dark hex."""

    stones: Array  # (cells,) int: 0 empty, 1 seat 0's, 2 seat 1's
    known: Array  # (cells,) bool: the other seat has run into the stone there
    seat: Array  # () int: the seat that acts


def _adjacency() -> np.ndarray:
    """Return (cells, cells) bool: cells that touch each other on a rhombic board, and each itself."""
    row, column = np.divmod(np.arange(ALL), CELLS)
    down, right = row[None] - row[:, None], column[None] - column[:, None]
    return (abs(down) <= 1) & (abs(right) <= 1) & (abs(down + right) <= 1)


class DarkHexGame(TurnGame):
    """Seat 0 connects the first row with the last, seat 1 the first column with the last."""

    most = 1.0

    def draw(self, key: Array) -> Array:
        """Return nothing: chance has no part in the game."""
        return jnp.zeros(0, jnp.int32)

    def start(self, outcomes: Array) -> Board:
        """Return the empty board."""
        return Board(jnp.zeros(ALL, jnp.int32), jnp.zeros(ALL, bool), jnp.zeros((), jnp.int32))

    def mover(self, hand: Board) -> Array:
        """Return the seat that acts."""
        return hand.seat

    def legal(self, hand: Board) -> Array:
        """Return the cells that the seat does not know to be taken."""
        return (hand.stones != hand.seat + 1) & ~hand.known

    def play(self, hand: Board, choice: Array) -> Board:
        """Return the board after an attempt."""
        taken = hand.stones[choice] > 0
        stone = jnp.where(taken, hand.stones[choice], hand.seat + 1)
        known = hand.known.at[choice].set(hand.known[choice] | taken)
        return Board(hand.stones.at[choice].set(stone), known, jnp.where(taken, hand.seat, 1 - hand.seat))

    def outcome(self, hand: Board) -> tuple[Array, Array]:
        """Return the end, and 1 if seat 0 has connected its sides, -1 if seat 1 has."""
        cells, touching = np.arange(ALL), jnp.asarray(_adjacency())
        sides = ((cells < CELLS, cells >= ALL - CELLS), (cells % CELLS == 0, cells % CELLS == CELLS - 1))
        connected = []
        for seat, (first, last) in enumerate(sides):
            own = hand.stones == seat + 1
            reached = own & first
            for _ in range(ALL - 1):
                reached = own & (touching & reached).any(axis=1)
            connected.append((reached & last).any())
        return connected[0] | connected[1], jnp.where(connected[0], 1.0, -1.0)

    def view(self, hand: Board, seat: int) -> Array:
        """Return the own stones, the other's that are known, and the number of own stones that the other knows."""
        own = hand.stones == seat + 1
        other = (hand.stones == 2 - seat) & hand.known
        heard = (own & hand.known).sum() / CELLS
        return jnp.concatenate([own, other, heard[None]]).astype(jnp.float32)

    def view_parts(self) -> tuple[Part, ...]:
        """Describe the view."""
        return (
            Part("own", ALL, "", "1 where a stone of its own lies, row by row"),
            Part("other", ALL, "", "1 where it has run into a stone of the other"),
            Part("heard", 1, "", "a third of the number of its own stones that the other has run into"),
        )

    def markers(self, physics: Physics, game: Turns) -> dict[str, Array]:
        """Return the latest attempt as a disc on the rhombic board."""
        row, column = game.choice // CELLS, game.choice % CELLS
        return {"choice": jnp.stack([1.0 - row, (row / 2 - column) + 0.5, jnp.float32(0.3)])}
