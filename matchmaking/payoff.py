"""Payoff: who beat whom, how often, summed from the match log; and the interval of a score.

Below P is the number of snapshots and E the number of pairs of snapshots that met.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from storage.errors import StorageError
from storage.records import COUNTS, ArenaKey, Match, Totals

PAIR_SCORES = np.array([0.0, 0.25, 0.5, 0.75, 1.0])  # mean score of a seed pair's two games: LL, LD, DD or WL, DW, WW


class Contradiction(StorageError, ValueError):  # noqa: N818
    """A row of a match log cannot be, whatever was played; the store that has it is damaged."""


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
    last: np.ndarray  # (P,) when its newest match was written, in seconds since the epoch; 0 without one
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
        wins, draws, losses, *pairs = self.against(a, others)
        low, high = score_interval(wins, draws, losses, np.array(pairs), confidence)
        n = wins + draws + losses
        return Score((wins + draws / 2) / n if n else float("nan"), float(low), float(high), n)

    def against(self, a: str, others: Iterable[str]) -> tuple[int, ...]:
        """Wins, draws, losses and the five pair counts of a against all of `others`; named twice counts once."""
        i, counts = self.index(a), np.zeros(8, np.int64)
        for j in map(self.index, dict.fromkeys(others)):
            edge = self._edges.get((min(i, j), max(i, j)))
            if edge is not None:
                games, pairs = self.home[edge] + self.away[edge], self.pairs[edge]
                counts += np.append(games, pairs) if i < j else np.append(games[::-1], pairs[::-1])
        return tuple(counts.tolist())

    @cached_property
    def _edges(self) -> dict[tuple[int, int], int]:
        ends = zip(self.first.tolist(), self.second.tolist(), strict=True)
        return {end: edge for edge, end in enumerate(ends)}

    def _square(self, forward: np.ndarray, backward: np.ndarray) -> np.ndarray:
        """Per-pair counts as a (P, P) matrix: `forward` for (first, second), `backward` for (second, first)."""
        square = np.zeros((len(self.names), len(self.names)), np.int64)
        square[self.first, self.second] = forward
        square[self.second, self.first] = backward
        return square


def tally(matches: Sequence[Match] | Totals, players: Iterable[str] = (), onto: Payoff | None = None) -> Payoff:
    """Sum a match log into a Payoff.

    Args:
        matches: rows of one ArenaKey, or their sums. A snapshot's matches against itself say nothing of strength and
            are left out; those without an opponent, from an arena of one team, are counted as `trials`.
        players: names of snapshots that shall have a place even if they have not played yet.
        onto: what earlier rows of the same log were summed into; the result is the same as of all rows together.

    Raises:
        ValueError: matches of several ArenaKeys, which cannot be compared, or a row whose counts contradict each other.
    """
    arenas = _arenas(matches) | ({onto.arena} if onto and onto.arena else set())
    if len(arenas) > 1:
        raise ValueError(f"matches of {len(arenas)} arenas cannot be compared; choose one of {sorted(arenas)}")
    of_a, of_b, counts, created = _columns(matches)
    names = tuple(sorted({*players, *of_a, *of_b, *(onto.names if onto else ())} - {None}))
    place: dict[str | None, int] = {name: i for i, name in enumerate(names)}
    a, b = (np.array([place.get(name, -1) for name in of], np.int64) for of in (of_a, of_b))
    alone, met = b < 0, (b >= 0) & (a != b)
    table = _of_first(a[met], b[met], counts[met])
    trials, last = np.zeros((len(names), 4), np.int64), np.zeros(len(names))
    wins, draws, losses, voids, voids_a = counts[alone][:, [0, 1, 2, 11, 12]].T
    np.add.at(trials, a[alone], np.stack([wins, draws + losses, voids, voids_a], 1))
    for who, when in ((a, created), (b[~alone], created[~alone])):
        np.maximum.at(last, who, when)
    if onto is not None:
        now = np.array([place[name] for name in onto.names], np.int64)
        before = (onto.home, onto.away, onto.pairs, onto.voids, onto.culprits)
        table = np.concatenate([table, np.column_stack([now[onto.first], now[onto.second], *before])])
        trials[now] += onto.trials
        last[now] = np.maximum(last[now], onto.last)
    # Pairs are numbered by place, so sums do not depend on the order of rows (and integers add exactly).
    keys, edge = np.unique(table[:, 0] * len(names) + table[:, 1], return_inverse=True)
    sums = np.zeros((len(keys), 14), np.int64)
    np.add.at(sums, edge, table[:, 2:])
    first, second = np.divmod(keys, max(len(names), 1))
    home, away, pairs, void, culprits = np.split(sums, [3, 6, 11, 12], axis=1)
    return Payoff(names, first, second, home, away, pairs, void[:, 0], culprits, trials, last, next(iter(arenas), None))


def _arenas(matches: Sequence[Match] | Totals) -> set[ArenaKey]:
    return {matches.arena} if isinstance(matches, Totals) else {match.arena for match in matches}


def _columns(
    matches: Sequence[Match] | Totals,
) -> tuple[Sequence[str], Sequence[str | None], np.ndarray, np.ndarray]:
    """A log's columns: a, b, counts (rows, 14) in the order of COUNTS, when the row was written."""
    if not isinstance(matches, Totals):
        matches = Totals(
            ArenaKey("", "", ""), [m.a for m in matches], [m.b for m in matches], [_counts(m) for m in matches],
            [m.created for m in matches], 0,
        )  # fmt: skip
    try:
        counts = np.array(matches.counts, np.int64).reshape(-1, len(COUNTS))
        created = np.array(matches.created, float)
    except (ValueError, TypeError, OverflowError) as error:
        raise Contradiction(f"the log of matches is damaged: {str(error)[:80]}") from None
    _check(matches.a, matches.b, counts)
    return matches.a, matches.b, counts, created


def _counts(m: Match) -> tuple[int, ...]:
    sides = (m.side_wins, m.side_draws, m.side_losses)
    return (m.wins, m.draws, m.losses, *sides, *m.pairs, m.voids, m.voids_a, m.voids_b)


def _check(a: Sequence[str], b: Sequence[str | None], counts: np.ndarray) -> None:
    """Refuse a row whose counts contradict each other."""
    home, pairs, voids = counts[:, 3:6], counts[:, 6:11], counts[:, 11]
    away = counts[:, :3] - home
    wrong = (counts < 0).any(1) | (away < 0).any(1) | (counts[:, 12:].sum(1) > voids)
    wrong |= pairs.sum(1) > np.minimum(home.sum(1), away.sum(1))
    for i in np.flatnonzero(wrong)[:1]:
        against = f" against {b[i]}" if b[i] else ""
        raise Contradiction(
            f"a match of {a[i]}{against} contradicts itself: side counts must not exceed the totals, each seed pair"
            " needs a valid game on either side, and a void has one culprit at most"
        )


def _of_first(a: np.ndarray, b: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """(rows, 16) first, second, home ×3, away ×3, pairs ×5, voids, culprits ×2, seen from the first by name."""
    home, pairs, voids, culprits = counts[:, 3:6], counts[:, 6:11], counts[:, 11:12], counts[:, 12:]
    away, turned = counts[:, :3] - home, (a > b)[:, None]
    # B's away games are those in which A played team 0, and A's losses are B's wins.
    return np.column_stack([
        np.minimum(a, b), np.maximum(a, b),
        np.where(turned, away[:, ::-1], home), np.where(turned, home[:, ::-1], away),
        np.where(turned, pairs[:, ::-1], pairs), voids, np.where(turned, culprits[:, ::-1], culprits),
    ])  # fmt: skip


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
