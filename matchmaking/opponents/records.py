"""Records of a learner's own games against its opponents: decaying win rates, and OpenAI Five's quality scores.

Both are folded over the log of its games, turn by turn in order, and hold no other state: all readers of the log get
the same numbers, even after a restart.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

DECAY = 0.99
"""Factor by which each later game reduces the weight of a game."""

SHRINKAGE = 10.0
"""Virtual draws at the start of a record."""


@dataclass(frozen=True, slots=True)
class WinRecord:
    """Results against one opponent. Older games count less, and the record starts with virtual draws.

    So the win rate is one half at first and stays near it until there are enough games; the virtual draws decay like
    any result. (Vinyals et al. 2019 also decay by 0.99 per game, and take one half without games.)
    """

    score: float  # decayed sum: win 1, draw ½
    games: float  # decayed number

    @classmethod
    def new(cls, shrinkage: float = SHRINKAGE) -> "WinRecord":
        """Return a record of `shrinkage` virtual draws."""
        return cls(shrinkage / 2, shrinkage)

    @property
    def rate(self) -> float:
        """Win rate, a draw counting half; one half without games."""
        return self.score / self.games if self.games else 0.5

    def after(self, wins: float, draws: float, losses: float, decay: float = DECAY) -> "WinRecord":
        """Return the record after a batch of games. Their order is unknown, so each counts as their mean."""
        n = wins + draws + losses
        if not n:
            return self
        kept = decay**n
        counted = n if decay == 1 else (1 - kept) / (1 - decay)
        return WinRecord(self.score * kept + (wins + draws / 2) / n * counted, self.games * kept + counted)


@dataclass
class WinRecords:
    """A learner's row of the win rates: its record against every opponent that it has met.

    For an opponent that it has not met, the record against the opponent's parent counts, the snapshot from which that
    one continued, or against the parent's parent: it is the most similar.
    """

    decay: float = DECAY
    shrinkage: float = SHRINKAGE
    parents: Mapping[str, str | None] = field(default_factory=dict)  # snapshot -> its parent
    row: dict[str, WinRecord] = field(default_factory=dict)
    met: dict[str, int] = field(default_factory=dict)  # games in total, without decay
    inherited: dict[str, str] = field(default_factory=dict)  # opponent -> whose record it continued

    def note(self, opponent: str, wins: int, draws: int, losses: int) -> None:
        """Add a batch of games; void ones do not count."""
        if opponent not in self.row and (source := self.source(opponent)):
            self.inherited[opponent] = source
        self.row[opponent] = self.against(opponent).after(wins, draws, losses, self.decay)
        self.met[opponent] = self.met.get(opponent, 0) + wins + draws + losses

    def against(self, opponent: str) -> WinRecord:
        """Return the record against an opponent, its own or inherited, or one of virtual draws alone."""
        return self.row.get(self.source(opponent) or "", WinRecord.new(self.shrinkage))

    def source(self, opponent: str) -> str | None:
        """Return the snapshot whose record stands for the opponent's: itself or its nearest ancestor; or None."""
        return _nearest(opponent, self.row, self.parents)

    def holds_for(self, parents: Mapping[str, str | None]) -> bool:
        """Return whether the same games give the same records with other parents.

        They do unless an opponent would continue another record when it is met first. That may change for a player,
        whose parent is its newest snapshot.
        """
        met = set[str]()
        for opponent in self.row:  # in the order in which they were met first
            if _nearest(opponent, met, parents) != self.inherited.get(opponent):
                return False
            met.add(opponent)
        return True

    def copy(self) -> "WinRecords":
        """Return the same records, which further games of this object leave as they are."""
        own = dict(self.row), dict(self.met), dict(self.inherited)
        return WinRecords(self.decay, self.shrinkage, self.parents, *own)

    def rates(self, opponents: Sequence[str]) -> np.ndarray:
        """Return win rates (n,) against those opponents."""
        return np.array([self.against(name).rate for name in opponents])

    def games(self, opponents: Sequence[str]) -> np.ndarray:
        """Return games (n,) played against them, without void ones."""
        return np.array([self.met.get(name, 0) for name in opponents], int)


def _nearest(opponent: str, known: Collection[str], parents: Mapping[str, str | None]) -> str | None:
    """Return the first of an opponent and its ancestors that is known; or None."""
    seen: set[str] = set()
    at: str | None = opponent
    while at is not None and at not in known and at not in seen:
        seen.add(at)
        at = parents.get(at)
    return at if at is not None and at in known else None


@dataclass
class Qualities:
    """OpenAI Five's quality scores of past opponents (Berner et al. 2019).

    A new opponent starts with the largest existing quality. For each game that the learner wins against i, drawn with
    probability p_i out of N: q_i ← q_i - η / (N p_i); a lost game changes nothing. A draw counts as half a win here,
    because otherwise it would count as a loss; their game has none.

    Their opponents are drawn game by game. Here one draw holds for a group of worlds for a whole turn, and an opponent
    of small p_i that is drawn nevertheless has a large share of the turn's games at once: p_i is then that share
    (truncated importance weights, Ionides 2008), so that one turn of G games lowers a quality by at most η G / N.
    """

    rate: float = 0.01  # η
    q: dict[str, float] = field(default_factory=dict)

    def add(self, opponents: Iterable[str]) -> None:
        """Add opponents that may be drawn from now on."""
        if new := [name for name in opponents if name not in self.q]:
            self.q |= dict.fromkeys(new, max(self.q.values(), default=0.0))

    def note(self, turn: Sequence[tuple[str, float, float, float]], pool: int) -> None:
        """Add a turn: for each opponent (name, wins + half the draws, games, p), out of `pool` opponents."""
        total = sum(games for _, _, games, _ in turn)
        self.add(name for name, *_ in turn)
        for name, won, games, chance in turn:
            if games:
                self.q[name] -= self.rate * won / (pool * max(chance, games / total))

    def of(self, opponents: Sequence[str]) -> np.ndarray:
        """Return their qualities (n,); unknown opponents are added."""
        self.add(opponents)
        return np.array([self.q[name] for name in opponents])
