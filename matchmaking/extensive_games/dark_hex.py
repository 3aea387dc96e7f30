"""Dark hex: hex whose players see only their own stones and those that they have run into.

The rules are those of OpenSpiel's `dark_hex` by default: the *classical* game (`gameversion=cdh`), in which a player
whose cell turns out to be taken sees the stone there and moves again, and `obstype=reveal-nothing`. OpenSpiel's
information states hold the number of all attempts so far nevertheless, so a player hears how often the other one has
run into a stone; so they do here. Player 0 connects the first row with the last, player 1 the first column with the
last.
"""

from collections.abc import Hashable
from functools import cache
from typing import NamedTuple

from matchmaking.extensive_games.game import TERMINAL

EMPTY, UNSEEN, SEEN = 0, 1, 2


class Position(NamedTuple):
    """A state of dark hex. Players are merged where only the order of their moves differs, unless `moves` has it."""

    stones: tuple[int, ...]  # of each cell: 0 empty, 1 player 0's, 2 player 1's
    known: tuple[int, ...]  # of each cell: 1 if the other player has run into the stone there
    mover: int
    attempts: int
    winner: int  # -1: none yet
    moves: tuple[tuple[int, ...], ...]  # cells that each player has tried, in order; () if policies forget them


class DarkHex:
    """Dark hex on a board of some rows and columns.

    `recall`: information states hold the order of a player's own attempts, as OpenSpiel's do. Otherwise they hold what
    the player sees and the number of attempts, which is what a policy without memory can use; best responses recall
    everything all the same.
    """

    def __init__(self, rows: int = 3, columns: int = 3, recall: bool = False):
        self.name = f"dark-hex-{rows}" if rows == columns else f"dark-hex-{rows}x{columns}"
        self.rows, self.columns, self.recall = rows, columns, recall
        self.actions = rows * columns
        self.longest = 2 * self.actions - 1
        self.neighbours = tuple(_neighbours(cell, rows, columns) for cell in range(self.actions))
        self.connected = cache(self._connected)

    def start(self) -> Position:
        """Return the empty board."""
        empty = (0,) * self.actions
        return Position(empty, empty, 0, 0, -1, ((), ()) if self.recall else ())

    def player(self, state: Position) -> int:
        """Return the player who acts."""
        return TERMINAL if state.winner >= 0 else state.mover

    def legal(self, state: Position) -> list[int]:
        """Return the cells that the player does not know to be taken."""
        own = state.mover + 1
        return [c for c, (stone, known) in enumerate(zip(*state[:2], strict=True)) if stone != own and not known]

    def play(self, state: Position, action: int) -> Position:
        """Return the position after an attempt: a new stone, or a stone of the other player that is now known."""
        mover, moves = state.mover, state.moves
        if self.recall:
            own = (*moves[mover], action)
            moves = (own, moves[1]) if mover == 0 else (moves[0], own)
        if state.stones[action]:
            known = (*state.known[:action], 1, *state.known[action + 1 :])
            return Position(state.stones, known, mover, state.attempts + 1, -1, moves)
        stones = (*state.stones[:action], mover + 1, *state.stones[action + 1 :])
        mask = sum(1 << c for c, stone in enumerate(stones) if stone == mover + 1)
        winner = mover if self.connected(mover, mask) else -1
        return Position(stones, state.known, 1 - mover, state.attempts + 1, winner, moves)

    def gain(self, state: Position) -> float:
        """Return 1 if player 0 has connected its sides, else -1."""
        return 1.0 if state.winner == 0 else -1.0

    def information(self, state: Position, player: int) -> Hashable:
        """Return the board as the player sees it and the number of attempts, with the order of its own if recalled."""
        seen = tuple(
            stone if stone == player + 1 or known else 0 for stone, known in zip(state.stones, state.known, strict=True)
        )
        return player, seen, state.attempts, state.moves[player] if self.recall else ()

    def _connected(self, player: int, mask: int) -> bool:
        """Tell whether stones (a bit for each cell) connect a player's two sides."""
        first = range(self.columns) if player == 0 else range(0, self.actions, self.columns)
        reached = [c for c in first if mask >> c & 1]
        found = set(reached)
        while reached:
            cell = reached.pop()
            row, column = divmod(cell, self.columns)
            if (row == self.rows - 1) if player == 0 else (column == self.columns - 1):
                return True
            new = [c for c in self.neighbours[cell] if mask >> c & 1 and c not in found]
            found.update(new)
            reached += new
        return False


def _neighbours(cell: int, rows: int, columns: int) -> tuple[int, ...]:
    """Return the six neighbours of a cell of a rhombic board, fewer at its edges."""
    row, column = divmod(cell, columns)
    steps = ((-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0))
    places = [(row + down, column + right) for down, right in steps]
    return tuple(r * columns + c for r, c in places if 0 <= r < rows and 0 <= c < columns)
