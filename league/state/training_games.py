"""The log of a league's training games in columns: a quarter of the memory of its rows as records.

Managers and workers hold all training games, because a player that is reset or copied begins a new fold over some of
them (`league/scheduling/game_folds.py`). The log only grows, so what was folded once is kept beside it.
"""

from array import array
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from threading import Lock
from typing import Any, overload

import numpy as np

from storage.records import Meeting

COUNTS = ("iteration", "wins", "draws", "losses", "voids", "pool")
NARROW, WIDE = (np.dtype([("player", "i4"), ("opponent", "i4"), *((name, kind) for name in COUNTS), ("id", "i8"),
                          ("chance", "f8")]) for kind in ("i4", "i8"))  # fmt: skip
GROWTH = 1.125  # of the memory, where it is full
KEPT = 4  # folds of a player: win rates and qualities, each since it was reset and since its last snapshot


class TrainingGames(Sequence[Meeting]):
    """The training games of a league, in the order of the store: a value, although longer logs share its memory."""

    def __init__(self, games: Iterable[Meeting] = ()):
        self._log = _Log()
        self._log.add(games)
        self._size = self._log.size

    def extended(self, new: Sequence[Meeting]) -> "TrainingGames":
        """Return the log with further games. This one stays as it is."""
        if not new:
            return self
        longer = TrainingGames()
        longer._log = self._log if self._log.size == self._size else self._log.first(self._size)
        longer._log.add(new)
        longer._size = longer._log.size
        return longer

    @property
    def newest(self) -> int:
        """Return the number of the last game in the store; 0 without games."""
        return int(self._log.rows["id"][self._size - 1]) if self._size else 0

    @property
    def folds(self) -> "Folds":
        """Return what was folded over this log, or over a longer one that shares its memory."""
        return self._log.folds

    def number_of(self, player: str) -> int:
        """Return the number of games that a player has learnt from."""
        return len(self._places(player))

    def of_player(self, player: str, start: int = 0) -> np.ndarray:
        """Return the games (n,) that a player has learnt from, but its first `start`, as rows with named fields.

        Player and opponent are numbers; `name` returns their names.
        """
        return self._log.rows[self._places(player)[start:]]

    def name(self, number: int) -> str:
        """Return the name that a number in a row stands for."""
        return self._log.names[number]

    def _places(self, player: str) -> np.ndarray:
        found = np.array(self._log.places.get(self._log.numbers.get(player, -1), ()), np.int64)
        return found[: np.searchsorted(found, self._size)]

    def __len__(self) -> int:
        return self._size

    @overload
    def __getitem__(self, index: int) -> Meeting: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Meeting]: ...
    def __getitem__(self, index: int | slice) -> Meeting | Sequence[Meeting]:
        if isinstance(index, slice):
            return [self._log.game(i) for i in range(*index.indices(self._size))]
        return self._log.game(range(self._size)[index])

    def __iter__(self) -> Iterator[Meeting]:
        return map(self._log.game, range(self._size))


class Folds:
    """Results of folds over a log, of each player the newest by key. Whoever uses one holds `lock`."""

    def __init__(self) -> None:
        self.lock = Lock()
        self._kept: dict[str, dict[Any, Any]] = defaultdict(dict)

    def take(self, player: str, key: Any) -> Any:
        """Remove and return a fold; None without one."""
        return self._kept[player].pop(key, None)

    def keep(self, player: str, key: Any, fold: Any) -> None:
        """Keep a fold, and forget the one of this player that was not used for the longest time."""
        kept = self._kept[player]
        kept[key] = fold
        if len(kept) > KEPT:
            del kept[next(iter(kept))]


class _Log:
    """The memory that a log shares with those which it was extended to."""

    def __init__(self) -> None:
        self.rows, self.size, self.league = np.zeros(0, NARROW), 0, ""
        self.names: list[str] = []
        self.numbers: dict[str, int] = {}  # by name
        self.places: dict[int, array[int]] = defaultdict(lambda: array("q"))  # player -> of its games, in order
        self.folds = Folds()

    def first(self, size: int) -> "_Log":
        """Return a copy of the first games, without folds."""
        copied = _Log()
        copied.league, copied.names, copied.numbers = self.league, list(self.names), dict(self.numbers)
        copied._append(self.rows[:size])
        return copied

    def add(self, games: Iterable[Meeting]) -> None:
        """Append games."""
        new = list(games)
        found = [
            (self._number(g.player), self._number(g.opponent), g.iteration, g.wins, g.draws, g.losses, g.voids, g.pool,
             g.id, g.chance)
            for g in new
        ]  # fmt: skip
        if new:
            self.league = new[0].league
            try:
                self._append(np.array(found, self.rows.dtype))
            except OverflowError:  # a count beyond 31 bits
                self.rows = self.rows.astype(WIDE)
                self._append(np.array(found, WIDE))

    def game(self, place: int) -> Meeting:
        """Return one game as a record."""
        player, opponent, iteration, wins, draws, losses, voids, pool, id, chance = self.rows[place].item()
        names = self.names[player], iteration, self.names[opponent]
        return Meeting(self.league, *names, wins, draws, losses, voids, chance, pool, id)

    def _append(self, new: np.ndarray) -> None:
        start, self.size = self.size, self.size + len(new)
        if self.size > len(self.rows):
            kept = self.rows
            self.rows = np.zeros(max(self.size, int(GROWTH * len(kept))), kept.dtype)
            self.rows[:start] = kept[:start]
        self.rows[start : self.size] = new
        for place, player in enumerate(new["player"].tolist(), start):
            self.places[player].append(place)

    def _number(self, name: str) -> int:
        number = self.numbers.setdefault(name, len(self.names))
        if number == len(self.names):
            self.names.append(name)
        return number
