"""Win rates and qualities of a learner, folded once over its training games: each plan adds only the new games.

A fold goes over parts of the log, one after another: the games of a learner, after those of the player that it was
copied from. It is kept with the log (`league/state/training_games.py`) and continued only where the result is that of
folding all games again, to the last bit. Otherwise all are folded again: when a reset, a copy or a new snapshot has
changed from whom an opponent inherits, or which snapshots there were, and when games came in an earlier part.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from league.state.training_games import TrainingGames
from matchmaking.opponents import Qualities, WinRecords

Ancestry = Mapping[str, str | None]  # snapshot -> its parent, and player -> its newest snapshot


class Part(NamedTuple):
    """A player's games of some iterations."""

    player: str
    after: int = -1  # the last iteration before
    until: int | None = None  # the last one; None: all that come


class Fold(ABC):
    """A fold over parts of the log, and how far it has read."""

    def __init__(self, parts: Sequence[Part]):
        self.parts = parts
        self._read = [0] * len(parts)  # games of the part's player that were looked at
        self._taken = [0] * len(parts)  # of these, the games that are of the part

    def advance(self, games: TrainingGames) -> bool:
        """Add the games that are new; False if the fold must begin again, because they are not the last ones."""
        for i, part in enumerate(self.parts):
            number = games.number_of(part.player)
            if number < self._read[i]:
                return False  # a shorter log than that which was folded
            rows = games.of_player(part.player, self._read[i])
            rows = rows[rows["iteration"] > part.after]
            rows = rows if part.until is None else rows[rows["iteration"] <= part.until]
            if len(rows) and any(self._taken[i + 1 :]):
                return False
            self._read[i], self._taken[i] = number, self._taken[i] + len(rows)
            self._add(rows, games)
        return True

    @abstractmethod
    def _add(self, rows: np.ndarray, games: TrainingGames) -> None:
        """Add games."""


class WinRateFold(Fold):
    """The records against each opponent."""

    def __init__(self, parts: Sequence[Part], decay: float, shrinkage: float):
        super().__init__(parts)
        self.known = WinRecords(decay, shrinkage)

    def holds_for(self, parents: Ancestry) -> bool:
        """Return whether the games so far give the same records with these parents, which count from now on."""
        holds = parents is self.known.parents or self.known.holds_for(parents)
        self.known.parents = parents
        return holds

    def _add(self, rows: np.ndarray, games: TrainingGames) -> None:
        columns = (rows[name].tolist() for name in ("opponent", "wins", "draws", "losses"))
        for opponent, wins, draws, losses in zip(*columns, strict=True):
            self.known.note(games.name(opponent), wins, draws, losses)


class Game(NamedTuple):
    """A learner's games of a turn against a snapshot that was drawn."""

    iteration: int
    opponent: str
    won: float  # a draw counts half
    games: int
    chance: float
    pool: int


class QualityFold(Fold):
    """OpenAI Five's qualities. The last turn is not folded before another begins, since it may get further games."""

    def __init__(self, parts: Sequence[Part], rate: float):
        super().__init__(parts)
        self._known = Qualities(rate)
        self._turn: list[Game] = []  # the last one
        self._names: Sequence[str] = ()  # of all snapshots that may have been met, in order of creation
        self._pool = 0  # the largest of a turn: as many of the names have been read
        self._past: set[str] = set()
        self._met = set[str](), set[str]()  # opponents that were not among the names, and those that were

    def holds_for(self, names: Sequence[str]) -> bool:
        """Return whether the games so far give the same qualities with these names, which count from now on."""
        past, (others, met) = set(names), self._met
        holds = names[: self._pool] == self._names[: self._pool] and met <= past and others.isdisjoint(past)
        self._names, self._past = names, past
        return holds

    def of(self, names: Sequence[str]) -> np.ndarray:
        """Return their qualities (n,)."""
        known = Qualities(self._known.rate, dict(self._known.q))
        self._end_turn(known)
        return known.of(names)

    def _add(self, rows: np.ndarray, games: TrainingGames) -> None:
        columns = ("iteration", "opponent", "wins", "draws", "losses", "chance", "pool")
        drawn = rows[rows["pool"] != 0]
        for at, number, wins, draws, losses, chance, pool in zip(*(drawn[c].tolist() for c in columns), strict=True):
            opponent = games.name(number)
            self._met[opponent in self._past].add(opponent)
            if opponent not in self._past:
                continue
            if self._turn and self._turn[0].iteration != at:
                self._end_turn(self._known)
                self._turn = []
            self._turn.append(Game(at, opponent, wins + draws / 2, wins + draws + losses, chance, pool))
            self._pool = max(self._pool, self._turn[0].pool)

    def _end_turn(self, known: Qualities) -> None:
        if self._turn:
            pool = self._turn[0].pool
            known.add(self._names[:pool])  # the snapshots of that time are the oldest ones
            known.note([(g.opponent, g.won, g.games, g.chance) for g in self._turn], pool)


def win_records(
    games: TrainingGames, player: str, parts: Sequence[Part], parents: Ancestry, decay: float, shrinkage: float
) -> WinRecords:
    """Return the records of all games of those parts."""
    key = "win rate", tuple(parts), decay, shrinkage

    def use(fold: WinRateFold) -> WinRecords | None:
        return fold.known.copy() if fold.holds_for(parents) and fold.advance(games) else None

    return _folded(games, player, key, lambda: WinRateFold(parts, decay, shrinkage), use)


def quality_scores(
    games: TrainingGames, player: str, parts: Sequence[Part], names: Sequence[str], rate: float
) -> np.ndarray:
    """(n,) Return the qualities after all games of those parts.

    `names` are those of `opponent_sampling.qualities`, in order of creation.
    """
    key = "quality", tuple(parts), rate

    def use(fold: QualityFold) -> np.ndarray | None:
        return fold.of(names) if fold.holds_for(tuple(names)) and fold.advance(games) else None

    return _folded(games, player, key, lambda: QualityFold(parts, rate), use)


F = TypeVar("F", bound=Fold)
R = TypeVar("R")


def _folded(games: TrainingGames, player: str, key: tuple, begin: Callable[[], F], use: Callable[[F], R | None]) -> R:
    """Return the result of the kept fold, or of a new one where that cannot be continued."""
    with games.folds.lock:
        fold = games.folds.take(player, key)
        found = None if fold is None else use(fold)
        if found is None:
            fold = begin()
            found = use(fold)
        assert found is not None  # a new fold has read nothing that could have changed
        games.folds.keep(player, key, fold)
        return found
