"""Results of games as columns, and a fast conversion of plain CSV text to columns. R is the number of rows."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from storage.database.garbage_collection import paused_garbage_collection

CHUNK = 50_000
"""Lines that are split at once: lists of fields take twenty times the memory of their text."""
LONGEST = 200
"""Most characters of a name: a longer name is a mistake, such as a quotation mark that is not closed."""


@dataclass(frozen=True, eq=False)
class Columns:
    """R rows of a log, each of any number of games in which the same player was on side A."""

    arenas: Sequence[str]
    names: Sequence[str]
    seeds: Sequence[str]
    arena: np.ndarray  # (R,) index of the arena
    a: np.ndarray  # (R,) index of the name
    b: np.ndarray  # (R,)
    games: np.ndarray  # (R, 3) wins, draws and losses of the player on side A
    seed: np.ndarray  # (R,) index of the seed; -1 if none was given

    @classmethod
    def of(cls, rows: Iterable[tuple[str, str, str, int, int, int, str]]) -> "Columns":
        """Convert rows of (arena, side A, side B, wins, draws, losses, seed pair)."""
        arenas, names, seeds = ({} for _ in range(3))
        found = [
            (_number(arenas, arena), _number(names, a), _number(names, b), wins, draws, losses,
             _number(seeds, seed) if seed else -1)
            for arena, a, b, wins, draws, losses, seed in rows
        ]  # fmt: skip
        table = np.array(found, np.int64).reshape(-1, 7)
        return cls([*arenas], [*names], [*seeds], table[:, 0], table[:, 1], table[:, 2], table[:, 3:6], table[:, 6])

    def only(self, arena: str) -> "Columns":
        """Return the rows of one arena."""
        own = self.arena == self.arenas.index(arena)
        return Columns(
            self.arenas, self.names, self.seeds, self.arena[own], self.a[own], self.b[own], self.games[own],
            self.seed[own],
        )  # fmt: skip


def quick(
    text: str, separator: str, places: Mapping[str, int], width: int, most: int, seeds: str = "seed_pair"
) -> Columns | None:
    """Parse the rows below the first line of a CSV text; return None if a row is wrong or anything is quoted.

    After None, the caller reads the text again row by row, which finds the line that is wrong.

    Args:
        text: the text with its first line.
        separator: the separator between fields.
        places: indices of the columns arena, side_a, side_b, wins_a, draws, wins_b, and of the seed pairs, if any.
        width: number of fields of each line.
        most: most games of one kind in a row.
        seeds: the name of the column of seed pairs.
    """
    text = text.replace("\r\n", "\n")
    if any(mark in text for mark in ('"', "\r", "\0")):
        return None
    coded = {"arena": _Words(), "name": _Words(), "count": _Counts(most), "seed": _Words(empty=True)}
    kinds = {"arena": "arena", "side_a": "name", "side_b": "name", seeds: "seed"}
    lines = iter(text.split("\n"))
    next(lines, None)
    parts: dict[str, list[np.ndarray]] = {name: [] for name in places}
    while chunk := list(islice(lines, CHUNK)):
        with paused_garbage_collection():
            rows = [line.split(separator) for line in chunk if line and not line.isspace()]
            if set(map(len, rows)) - {width}:
                return None
            columns = list(zip(*rows, strict=True)) or [()] * width
        for name, place in places.items():
            found = coded[kinds.get(name, "count")].of(columns[place])
            if found is None:
                return None
            parts[name].append(found)
    column = {name: np.concatenate(some) if some else np.zeros(0, np.int64) for name, some in parts.items()}
    if (column["side_a"] == column["side_b"]).any():
        return None
    games = np.stack([column[name] for name in ("wins_a", "draws", "wins_b")], 1)
    none = np.full(len(games), -1)
    return Columns(
        coded["arena"].words, coded["name"].words, coded["seed"].words, column["arena"], column["side_a"],
        column["side_b"], games, column.get(seeds, none),
    )  # fmt: skip


class _Words:
    """Numbers of words, in the order of their first appearance; spaces around them do not count."""

    def __init__(self, empty: bool = False):
        self.words: list[str] = []
        self._numbers: dict[str, int] = {}
        self._known: dict[str, int] = {}  # as written
        self._empty = empty

    def of(self, column: Sequence[str]) -> np.ndarray | None:
        """(R,) Numbers of the words, -1 for an empty word if allowed; None if a word is too long or wrongly empty."""
        for word in set(column).difference(self._known):
            number = self._new(word)
            if number is None:
                return None
            self._known[word] = number
        return np.fromiter(map(self._known.__getitem__, column), np.int64, len(column))

    def _new(self, word: str) -> int | None:
        plain = word.strip()
        if not plain or len(word) > LONGEST:
            return -1 if self._empty and not plain else None
        number = _number(self._numbers, plain)
        if number == len(self.words):
            self.words.append(plain)
        return number


class _Counts(_Words):
    """Counts as numbers."""

    def __init__(self, most: int):
        super().__init__()
        self._most = most

    def _new(self, word: str) -> int | None:
        plain = word.strip()
        if not (plain.isascii() and plain.isdigit() and len(plain) <= 20 and int(plain) <= self._most):
            return None
        return int(plain)


def _number(numbers: dict[str, int], word: str) -> int:
    return numbers.setdefault(word, len(numbers))
