"""Dark hex: hex whose players see only their own stones and those that they have run into.

The rules are those of OpenSpiel's `dark_hex` by default: the *classical* game (`gameversion=cdh`), in which a player
whose cell turns out to be taken sees the stone there and moves again, and `obstype=reveal-nothing`. OpenSpiel's
information states hold the number of all attempts so far nevertheless, so a player hears how often the other one has
run into a stone; so they do here. Player 0 connects the first row with the last, player 1 the first column with the
last.
"""

from collections.abc import Hashable, Sequence
from functools import cache
from typing import NamedTuple

from matchmaking.extensive_games.game import TERMINAL


class Position(NamedTuple):
    """A state of dark hex; sets of cells are bits of a number. Only the order of moves is left out, unless recalled."""

    first: int  # cells with stones of player 0
    second: int  # of player 1
    known: int  # cells whose stone the other player has run into
    mover: int
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
        self.connected, self.cells_without = cache(self._connected), cache(self._cells_without)

    def start(self) -> Position:
        """Return the empty board."""
        return Position(0, 0, 0, 0, -1, ((), ()) if self.recall else ())

    def player(self, state: Position) -> int:
        """Return the player who acts."""
        return state.mover if state.winner < 0 else TERMINAL

    def legal(self, state: Position) -> Sequence[int]:
        """Return the cells that the player does not know to be taken."""
        return self.cells_without(state.known | (state.second if state.mover else state.first))

    def play(self, state: Position, action: int) -> Position:
        """Return the position after an attempt: a new stone, or a stone of the other player that is now known."""
        first, second, known, mover, _, moves = state
        if self.recall:
            own = (*moves[mover], action)
            moves = (own, moves[1]) if mover == 0 else (moves[0], own)
        cell = 1 << action
        if (first | second) & cell:
            return Position(first, second, known | cell, mover, -1, moves)
        if mover == 0:
            first |= cell
            return Position(first, second, known, 1, 0 if self.connected(0, first) else -1, moves)
        second |= cell
        return Position(first, second, known, 0, 1 if self.connected(1, second) else -1, moves)

    def gain(self, state: Position) -> float:
        """Return 1 if player 0 has connected its sides, else -1."""
        return 1.0 if state.winner == 0 else -1.0

    def information(self, state: Position, player: int) -> Hashable:
        """Return what the player sees and the number of attempts, with the order of its own if that is recalled.

        These are its own stones, the other's that it knows, and all attempts: every stone, and every one run into.
        """
        first, second, known, _, _, moves = state
        attempts = (first | second).bit_count() + known.bit_count()
        own, other = (second, first) if player else (first, second)
        return player, own, other & known, attempts, moves[player] if self.recall else ()

    def _cells_without(self, taken: int) -> list[int]:
        return [cell for cell in range(self.actions) if not taken >> cell & 1]

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
