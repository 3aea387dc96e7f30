"""What a learner's own games say of its opponents: win rates that forget, and OpenAI Five's quality scores.

Both are folded over the log of its games, turn by turn in their order, and hold no other state: whoever reads the log
gets the same figures, after a restart too.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

DECAY = 0.99
"""What a game counts less for each game after it."""

SHRINKAGE = 10.0
"""Virtual draws with which a record begins."""


@dataclass(frozen=True)
class Record:
    """Results against one opponent. Old ones count less, and those before the first game were virtual draws.

    So the win rate is one half at first, and stays near it until there are enough games; the virtual draws decay like
    any result. (Vinyals et al. 2019 decay by 0.99 for each game too, and take one half where there is none.)
    """

    score: float  # decayed sum: win 1, draw ½
    games: float  # decayed number

    @classmethod
    def new(cls, shrinkage: float = SHRINKAGE) -> "Record":
        """One of so many virtual draws."""
        return cls(shrinkage / 2, shrinkage)

    @property
    def rate(self) -> float:
        """The win rate, a draw counting half; one half where nothing is known."""
        return self.score / self.games if self.games else 0.5

    def after(self, wins: float, draws: float, losses: float, decay: float = DECAY) -> "Record":
        """The record after a batch of games. In what order they ended nobody knows: each counts as their mean does."""
        n = wins + draws + losses
        if not n:
            return self
        kept = decay**n
        counted = n if decay == 1 else (1 - kept) / (1 - decay)
        return Record(self.score * kept + (wins + draws / 2) / n * counted, self.games * kept + counted)


@dataclass
class Records:
    """A learner's row of the win rates: its record against every opponent that it has met.

    An opponent that it has not met inherits the record against its parent, the snapshot from which it goes on, or
    against that one's parent: it is most like it.
    """

    decay: float = DECAY
    shrinkage: float = SHRINKAGE
    parents: Mapping[str, str | None] = field(default_factory=dict)  # snapshot -> the one it goes on from
    row: dict[str, Record] = field(default_factory=dict)
    met: dict[str, int] = field(default_factory=dict)  # games in all, as they were counted

    def note(self, opponent: str, wins: int, draws: int, losses: int) -> None:
        """Take a batch of games into account; void ones are none."""
        self.row[opponent] = self.against(opponent).after(wins, draws, losses, self.decay)
        self.met[opponent] = self.met.get(opponent, 0) + wins + draws + losses

    def against(self, opponent: str) -> Record:
        """The record against an opponent, its own or inherited, else one of virtual draws alone."""
        return self.row.get(self.source(opponent) or "", Record.new(self.shrinkage))

    def source(self, opponent: str) -> str | None:
        """Whose record stands for the opponent's: its own, or that of the nearest one it goes on from; None without."""
        seen: set[str] = set()
        at: str | None = opponent
        while at is not None and at not in self.row and at not in seen:
            seen.add(at)
            at = self.parents.get(at)
        return at if at in self.row else None

    def rates(self, opponents: Sequence[str]) -> np.ndarray:
        """(n,) Win rates against those opponents."""
        return np.array([self.against(name).rate for name in opponents])

    def games(self, opponents: Sequence[str]) -> np.ndarray:
        """(n,) Games played against them, void ones not counted."""
        return np.array([self.met.get(name, 0) for name in opponents], int)


@dataclass
class Qualities:
    """OpenAI Five's quality scores of past opponents (Berner et al. 2019).

    A new opponent begins with the largest quality there is. For each game that the learner wins against i, drawn with
    probability p_i out of N: q_i ← q_i - η / (N p_i); a lost game changes nothing. A draw is half a win here, else it
    would count as a loss; their game has none.

    Their opponents are drawn game by game. Here one draw is for a group of worlds for a whole turn, and an opponent of
    small p_i that was drawn all the same has a large share of the turn's games at once: p_i is then that share
    (truncated importance weights, Ionides 2008), so that one turn of G games takes η G / N from a quality at most.
    """

    rate: float = 0.01  # η
    q: dict[str, float] = field(default_factory=dict)

    def add(self, opponents: Iterable[str]) -> None:
        """Opponents that may be drawn from now on."""
        for name in opponents:
            self.q.setdefault(name, max(self.q.values(), default=0.0))

    def note(self, turn: Sequence[tuple[str, float, float, float]], pool: int) -> None:
        """Take a turn into account: for each opponent (name, wins + half the draws, games, p), out of `pool`."""
        total = sum(games for _, _, games, _ in turn)
        self.add(name for name, *_ in turn)
        for name, won, games, chance in turn:
            if games:
                self.q[name] -= self.rate * won / (pool * max(chance, games / total))

    def of(self, opponents: Sequence[str]) -> np.ndarray:
        """(n,) Their qualities; those that were never added come in now."""
        self.add(opponents)
        return np.array([self.q[name] for name in opponents])
