"""Payoff: who beat whom, how often, summed from the match log; and the interval of a score.

Below P is the number of snapshots and E the number of pairs of snapshots that met.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from storage.records import ArenaKey, Match

PAIR_SCORES = np.array([0.0, 0.25, 0.5, 0.75, 1.0])  # mean score of a seed pair's two games: LL, LD, DD or WL, DW, WW


class Score(NamedTuple):
    """A snapshot's mean score against others (win 1, draw ½, loss 0) or its success rate alone, with its interval."""

    score: float  # nan where nothing was played
    low: float
    high: float
    games: int


@dataclass(frozen=True, eq=False)
class Payoff:
    """Counts of all games between P snapshots, kept per pair that met (`first` < `second`, indices into `names`).

    All counts are from `first`'s point of view. Nothing here depends on the order of matches, nor on which of the two
    snapshots a match called A.
    """

    names: tuple[str, ...]  # (P,) of snapshots, sorted
    first: np.ndarray  # (E,) int
    second: np.ndarray  # (E,) int
    home: np.ndarray  # (E, 3) int: wins, draws, losses of first while it played team 0
    away: np.ndarray  # (E, 3) int: the same while second played team 0
    pairs: np.ndarray  # (E, 5) int: seed pairs by first's score: LL, LD, DD or WL, DW, WW
    voids: np.ndarray  # (E,) int: episodes that count for nobody
    culprits: np.ndarray  # (E, 2) int: those of them in which only first's robots went bad, or only second's
    trials: np.ndarray  # (P, 4) int, in arenas of one team: successes, failures, voids, those of them that are its own
    arena: ArenaKey | None = None  # of the matches; None without any

    @cached_property
    def positions(self) -> dict[str, int]:
        """Where each snapshot stands in `names`."""
        return {name: i for i, name in enumerate(self.names)}

    def index(self, name: str) -> int:
        """Position of a snapshot in `names`; ValueError if it is not there."""
        if name not in self.positions:
            raise ValueError(f"snapshot {name!r} is not among the {len(self.names)} of this payoff; see Payoff.names")
        return self.positions[name]

    @cached_property
    def wins(self) -> np.ndarray:
        """(P, P) games that i won against j; its transpose holds the losses."""
        return self._square(self.home[:, 0] + self.away[:, 0], self.home[:, 2] + self.away[:, 2])

    @cached_property
    def draws(self) -> np.ndarray:
        """(P, P) games drawn between i and j, symmetric."""
        drawn = self.home[:, 1] + self.away[:, 1]
        return self._square(drawn, drawn)

    @property
    def losses(self) -> np.ndarray:
        """(P, P) games that i lost against j."""
        return self.wins.T

    @cached_property
    def games(self) -> np.ndarray:
        """(P, P) valid games between i and j, symmetric."""
        return self.wins + self.draws + self.losses

    @cached_property
    def episodes(self) -> np.ndarray:
        """(P, P) episodes played between i and j, void ones included: the effort spent, symmetric."""
        return self.games + self._square(self.voids, self.voids)

    def scores(self) -> np.ndarray:
        """(P, P) mean score of i against j, nan where they never met."""
        with np.errstate(invalid="ignore"):
            return (self.wins + 0.5 * self.draws) / self.games

    def score(self, a: str, *others: str, confidence: float = 0.95) -> Score:
        """Mean score of a over its games against all of `others`, with the interval of `score_interval`.

        Raises ValueError for an unknown name. Named twice counts once.
        """
        i, them = self.index(a), [self.index(b) for b in dict.fromkeys(others)]
        wins, draws, losses = (int(counts[i, them].sum()) for counts in (self.wins, self.draws, self.losses))
        ahead, behind = ((x == i) & np.isin(y, them) for x, y in self._both_ways)
        pairs = self.pairs[ahead].sum(0) + self.pairs[behind].sum(0)[::-1]
        low, high = score_interval(wins, draws, losses, pairs, confidence)
        n = wins + draws + losses
        return Score((wins + draws / 2) / n if n else float("nan"), float(low), float(high), n)

    @property
    def _both_ways(self) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
        return (self.first, self.second), (self.second, self.first)

    def _square(self, forward: np.ndarray, backward: np.ndarray) -> np.ndarray:
        """Per-pair counts as a (P, P) matrix: `forward` for (first, second), `backward` for (second, first)."""
        square = np.zeros((len(self.names), len(self.names)), np.int64)
        square[self.first, self.second] = forward
        square[self.second, self.first] = backward
        return square


def tally(matches: Sequence[Match], players: Iterable[str] = (), onto: Payoff | None = None) -> Payoff:
    """Sum a match log into a Payoff.

    Args:
        matches: rows of one ArenaKey. A snapshot's matches against itself say nothing of strength and are left out;
            those without an opponent, from an arena of one team, are counted as `trials`.
        players: names of snapshots that shall have a place even if they have not played yet.
        onto: what earlier rows of the same log were summed into; the result is the same as of all rows together.

    Raises:
        ValueError: matches of several ArenaKeys, which cannot be compared, or a row whose counts contradict each other.
    """
    arenas = {match.arena for match in matches} | ({onto.arena} if onto and onto.arena else set())
    if len(arenas) > 1:
        raise ValueError(f"matches of {len(arenas)} arenas cannot be compared; choose one of {sorted(arenas)}")
    for match in matches:
        _check(match)
    seen = {name for m in matches for name in (m.a, m.b) if name is not None}
    names = tuple(sorted({*players, *seen, *(onto.names if onto else ())}))
    place = {name: i for i, name in enumerate(names)}
    table = np.array([_row(m, m.b, place) for m in matches if m.b not in (None, m.a)], np.int64).reshape(-1, 16)
    trials = np.zeros((len(names), 4), np.int64)
    for m in matches:
        if m.b is None:
            trials[place[m.a]] += m.wins, m.draws + m.losses, m.voids, m.voids_a
    if onto is not None:
        now = np.array([place[name] for name in onto.names], np.int64)
        counts = (onto.home, onto.away, onto.pairs, onto.voids, onto.culprits)
        table = np.concatenate([table, np.column_stack([now[onto.first], now[onto.second], *counts])])
        trials[now] += onto.trials
    # Pairs are numbered by place, so sums do not depend on the order of rows (and integers add exactly).
    keys, edge = np.unique(table[:, 0] * len(names) + table[:, 1], return_inverse=True)
    sums = np.zeros((len(keys), 14), np.int64)
    np.add.at(sums, edge, table[:, 2:])
    first, second = np.divmod(keys, max(len(names), 1))
    home, away, pairs, voids, culprits = np.split(sums, [3, 6, 11, 12], axis=1)
    return Payoff(names, first, second, home, away, pairs, voids[:, 0], culprits, trials, next(iter(arenas), None))


def _check(match: Match) -> None:
    """Refuse a row whose counts contradict each other."""
    home = (match.side_wins, match.side_draws, match.side_losses)
    away = (match.wins - home[0], match.draws - home[1], match.losses - home[2])
    blamed = (match.voids_a, match.voids_b)
    if (
        min(*home, *away, *match.pairs, match.voids, *blamed) < 0
        or sum(match.pairs) > min(sum(home), sum(away))
        or sum(blamed) > match.voids
    ):
        against = f" against {match.b}" if match.b else ""
        raise ValueError(
            f"match {match.id} ({match.a}{against}) contradicts itself: side counts must not exceed the totals, each"
            " seed pair needs a valid game on either side, and a void has one culprit at most"
        )


def _row(match: Match, b: str, place: dict[str, int]) -> tuple[int, ...]:
    """A match as (first, second, home ×3, away ×3, pairs ×5, voids, culprits ×2), seen from the first by name."""
    home = (match.side_wins, match.side_draws, match.side_losses)
    away = (match.wins - home[0], match.draws - home[1], match.losses - home[2])
    pairs, culprits = tuple(match.pairs), (match.voids_a, match.voids_b)
    if match.a > b:  # B's away games are those in which A played team 0, and A's losses are B's wins
        home, away, pairs, culprits = away[::-1], home[::-1], pairs[::-1], culprits[::-1]
    i, j = sorted((place[match.a], place[b]))
    return (i, j, *home, *away, *pairs, match.voids, *culprits)


def score_interval(wins, draws, losses, pairs=None, confidence: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """Interval of a mean score s = (w + d/2)/n that knows of draws and of seed pairs.

    It is Wilson's (1927) score interval, which never leaves [0, 1], at an effective number of games (the idea of Korn
    and Graubard 1998 for surveys) in place of n:

        n* = n² / (4 m r_pair + u r_game),   r = (k v/(s(1-s)) + z²) / (k + z²)

    with m seed pairs, u games outside pairs, v the empirical variance about s of a pair's mean score (of a single
    game's score for r_game) and k the number of pairs (games) it comes from. s(1-s) is the largest variance that a
    score in [0, 1] can have, so r = 1 means "every pair (game) is decisive". Adding z² such pseudo-pairs, as many as
    Wilson's interval adds to its centre, keeps outcomes without variance from giving a width of zero: after m pairs
    that all were won the width is Wilson's for m independent games.

    Args:
        wins: (...) games won; draws and losses broadcast with it, and all three count every valid game.
        draws: (...) games drawn.
        losses: (...) games lost.
        pairs: (..., 5) counts of complete seed pairs among those games, or None.
        confidence: coverage of the two-sided interval, between 0 and 1.

    Returns:
        low, high: arrays (...) in [0, 1]; (0, 1) where nothing was played.
    """
    z2 = quantile(confidence) ** 2
    wins, draws, losses = np.broadcast_arrays(*(np.asarray(x, float) for x in (wins, draws, losses)))
    pairs = np.zeros((*wins.shape, 5)) if pairs is None else np.asarray(pairs, float)
    n, m = wins + draws + losses, pairs.sum(-1)
    s = (wins + draws / 2) / np.maximum(n, 1)
    limit = s * (1 - s)
    square_game = wins * (1 - s) ** 2 + draws * (0.5 - s) ** 2 + losses * s**2
    square_pair = (pairs * (PAIR_SCORES - s[..., None]) ** 2).sum(-1)
    certain = limit == 0  # nothing but wins or nothing but losses
    safe = np.where(certain, 1, limit)
    r_game = np.where(certain, 1, (square_game / safe + z2) / (n + z2))
    r_pair = np.where(certain, 1, (square_pair / safe + z2) / (m + z2))
    effective = n**2 / np.where(n > 0, 4 * m * r_pair + (n - 2 * m) * r_game, 1)
    centre = (effective * s + z2 / 2) / (effective + z2)
    half = np.sqrt(z2 * (effective * limit + z2 / 4)) / (effective + z2)
    return np.clip(centre - half, 0, 1), np.clip(centre + half, 0, 1)


def quantile(confidence: float) -> float:
    """Two-sided quantile z of the standard normal law, e.g. 1.96 for 0.95; ValueError outside (0, 1)."""
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is {confidence}; it must lie between 0 and 1, e.g. 0.95")
    return NormalDist().inv_cdf((1 + confidence) / 2)
