"""Results of games as columns, and a fast conversion of plain CSV text to columns. R is the number of rows."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import islice

import numpy as np

from league.config.schema import ConfigError
from storage.database.garbage_collection import paused_garbage_collection

CHUNK = 50_000
"""Lines that are split at once: lists of fields take twenty times the memory of their text."""
KINDS = (
    (("event", "player", "rank"), "rankings: give the file after --rankings"),
    (("side_a", "side_b", "wins_a", "draws", "wins_b"), "a match log: give the file without --rankings"),
)
"""Columns by which a file of the other kind is known, and what it is."""
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
    coded = {"arena": Words(), "name": Words(), "count": Counts(most), "seed": Words(empty=True)}
    kinds = {"arena": "arena", "side_a": "name", "side_b": "name", seeds: "seed"}
    coders = {name: coded[kinds.get(name, "count")] for name in places}
    column = coded_columns(text, separator, places, width, coders)
    if column is None or (column["side_a"] == column["side_b"]).any():
        return None
    games = np.stack([column[name] for name in ("wins_a", "draws", "wins_b")], 1)
    none = np.full(len(games), -1)
    return Columns(
        coded["arena"].words, coded["name"].words, coded["seed"].words, column["arena"], column["side_a"],
        column["side_b"], games, column.get(seeds, none),
    )  # fmt: skip


def coded_columns(
    text: str, separator: str, places: Mapping[str, int], width: int, coders: Mapping[str, "Words"]
) -> dict[str, np.ndarray] | None:
    """Return the columns (R,) of a CSV text below its first line as numbers.

    Return None if a row is wrong or anything is quoted.

    Args:
        text: the text with its first line.
        separator: the separator between fields.
        places: the index of each wanted column.
        width: number of fields of each line.
        coders: what makes numbers of each column's fields.
    """
    text = text.replace("\r\n", "\n")
    if any(mark in text for mark in ('"', "\r", "\0")):
        return None
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
            found = coders[name].of(columns[place])
            if found is None:
                return None
            parts[name].append(found)
    return {name: np.concatenate(some) if some else np.zeros(0, np.int64) for name, some in parts.items()}


def column_places(
    header: Sequence[str], source: str, columns: Sequence[str], optional: Sequence[str] = (), hint: str = ""
) -> dict[str, int]:
    """Return the index of each column in the first line. Raises ConfigError for one that is missing or there twice.

    `hint` says in messages what the optional columns are for.
    """
    if not any(header):
        raise ConfigError((), f"{source} is empty: its first line names the columns {','.join(columns)}")
    for name in columns:
        if name not in header:
            for others, what in KINDS:
                if set(others) <= set(header) and not set(others) <= set(columns):
                    raise ConfigError((), f"the columns are those of {what}", f"{source}:1: ")
            near = get_close_matches(name, [each for each in header if each not in columns], 1)
            meant = f" (is it {near[0]!r}?)" if near else ""
            needs = f"the first line names the columns {','.join(columns)}{hint}"
            raise ConfigError((), f"there is no column {name}{meant}: {needs}", f"{source}:1: ")
    for name in (*columns, *optional):
        if header.count(name) > 1:
            raise ConfigError((), f"there are {header.count(name)} columns {name}", f"{source}:1: ")
    return {name: header.index(name) for name in (*columns, *optional) if name in header}


def row_values(fields: Sequence[str], header: Sequence[str], places: Mapping[str, int], place: str) -> dict[str, str]:
    """Return the fields of a row by column, without spaces around them. Raises ConfigError for too many or too few."""
    if len(fields) != len(header):
        raise ConfigError((), f"{len(fields)} fields where the first line names {len(header)} columns", place)
    return {name: fields[at].strip() for name, at in places.items()}


def require_name(value: str, name: str, place: str) -> None:
    """Raise ConfigError unless the value of a column can be a name."""
    if not value:
        raise ConfigError((), f"{name} is empty: it must be a name", place)
    if len(value) > LONGEST:
        what = f"{name} has {len(value):,} characters: a name has at most {LONGEST}"
        raise ConfigError((), what, place)


class Words:
    """Numbers of words, in the order of their first appearance; spaces around them do not count."""

    dtype: type = np.int64

    def __init__(self, empty: bool = False):
        self.words: list[str] = []
        self._numbers: dict[str, int] = {}
        self._known: dict[str, float] = {}  # as written
        self._empty = empty

    def of(self, column: Sequence[str]) -> np.ndarray | None:
        """(R,) Numbers of the words, -1 for an empty word if allowed; None if a word is too long or wrongly empty."""
        for word in set(column).difference(self._known):
            number = self._new(word)
            if number is None:
                return None
            self._known[word] = number
        return np.fromiter(map(self._known.__getitem__, column), self.dtype, len(column))

    def _new(self, word: str) -> float | None:
        plain = word.strip()
        if not plain or len(word) > LONGEST:
            return -1 if self._empty and not plain else None
        number = _number(self._numbers, plain)
        if number == len(self.words):
            self.words.append(plain)
        return number


class Counts(Words):
    """Counts as numbers."""

    def __init__(self, most: int):
        super().__init__()
        self._most = most

    def _new(self, word: str) -> float | None:
        plain = word.strip()
        if not (plain.isascii() and plain.isdigit() and len(plain) <= 20 and int(plain) <= self._most):
            return None
        return int(plain)


class Ranks(Words):
    """Finite numbers."""

    dtype = float

    def _new(self, word: str) -> float | None:
        return rank_of(word)


def rank_of(word: str) -> float | None:
    """Return the finite number that a field is; None for anything else."""
    try:
        value = float(word)
    except ValueError:
        return None
    return value if math.isfinite(value) and "_" not in word else None


def _number(numbers: dict[str, int], word: str) -> int:
    return numbers.setdefault(word, len(numbers))
