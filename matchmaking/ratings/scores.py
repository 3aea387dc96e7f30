"""Scores and their intervals, from wins, draws, losses and seed pairs."""

from statistics import NormalDist
from typing import NamedTuple

import numpy as np

PAIR_SCORES = np.array([0.0, 0.25, 0.5, 0.75, 1.0])  # mean score of a seed pair's two games: LL, LD, DD or WL, DW, WW
SUSPECT = 0.1
"""Void episodes as a share of the games above which a score is marked wherever it is printed."""


def is_suspect(games: int, voids: int) -> bool:
    """Return True if so many void episodes next to so many games make a score suspect, see Score.suspect."""
    return voids > SUSPECT * games


class Score(NamedTuple):
    """A snapshot's mean score against others (win 1, draw ½, loss 0) or its success rate alone, with its interval."""

    score: float  # nan without games
    low: float
    high: float
    games: int
    voids: int = 0  # episodes besides them that do not count

    @property
    def suspect(self) -> bool:
        """True if there are more void episodes than a tenth of the games: then the games are a biased selection."""
        return is_suspect(self.games, self.voids)


def score_interval(wins, draws, losses, pairs=None, confidence: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """Return the interval of a mean score s = (w + d/2)/n, taking account of draws and seed pairs.

    It is Wilson's (1927) score interval, which never leaves [0, 1], with an effective number of games (the idea of Korn
    and Graubard 1998 for surveys) instead of n:

        n* = n² / (4 m r_pair + u r_game),   r = (k v/(s(1-s)) + z²) / (k + z²)

    with m seed pairs, u games outside pairs, v the empirical variance about s of a pair's mean score (of a single
    game's score for r_game) and k the number of pairs (games) that it comes from. s(1-s) is the largest variance that a
    score in [0, 1] can have, so r = 1 means "every pair (game) is decisive". Adding z² such pseudo-pairs, as many as
    Wilson's interval adds to its centre, keeps outcomes without variance from giving a width of zero: after m pairs
    that were all won the width is Wilson's for m independent games.

    Args:
        wins: (...) games won; draws and losses broadcast with it, and all three count every valid game.
        draws: (...) games drawn.
        losses: (...) games lost.
        pairs: (..., 5) counts of complete seed pairs among those games, or None.
        confidence: coverage of the two-sided interval, between 0 and 1.

    Returns:
        low, high: arrays (...) in [0, 1]; (0, 1) without games.
    """
    return wilson(*effective_games(wins, draws, losses, pairs, confidence), confidence)


def mean_interval(wins, draws, losses, pairs, confidence: float = 0.95) -> tuple[float, float, float]:
    """Return the mean of scores against K opponents, each with the same weight, and its interval.

    The interval is Wilson's for K² / Σ 1/n*_k games: it takes s (1-s) as the variance of the games against every
    opponent. Their own variances are smaller on average, by the variance of the scores among opponents, so the interval
    is too wide rather than too narrow, also where all games against some were won.

    Args:
        wins: (K,) games won; draws and losses too, at least one of the three for each opponent.
        draws: (K,) games drawn.
        losses: (K,) games lost.
        pairs: (K, 5) counts of complete seed pairs among those games.
        confidence: coverage of the two-sided interval, between 0 and 1.
    """
    s, effective = effective_games(wins, draws, losses, pairs, confidence)
    low, high = wilson(s.mean(), len(s) ** 2 / (1 / effective).sum(), confidence)
    return float(s.mean()), float(low), float(high)


def wilson(s, effective, confidence: float) -> tuple[np.ndarray, np.ndarray]:
    """Return Wilson's interval of a mean score s from so many decisive games."""
    z2, limit = quantile(confidence) ** 2, s * (1 - s)
    centre = (effective * s + z2 / 2) / (effective + z2)
    half = np.sqrt(z2 * (effective * limit + z2 / 4)) / (effective + z2)
    return np.clip(centre - half, 0, 1), np.clip(centre + half, 0, 1)


def effective_games(wins, draws, losses, pairs=None, confidence: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """Return a mean score s and n*, the equivalent number of decisive games; see `score_interval`."""
    z2 = quantile(confidence) ** 2
    wins, draws, losses = np.broadcast_arrays(*(np.asarray(x, float) for x in (wins, draws, losses)))
    pairs = np.zeros((*wins.shape, 5)) if pairs is None else np.asarray(pairs, float)
    n, m = wins + draws + losses, pairs.sum(-1)
    s = (wins + draws / 2) / np.maximum(n, 1)
    limit = s * (1 - s)
    square_game = wins * (1 - s) ** 2 + draws * (0.5 - s) ** 2 + losses * s**2
    square_pair = (pairs * (PAIR_SCORES - s[..., None]) ** 2).sum(-1)
    certain = limit == 0  # only wins or only losses
    safe = np.where(certain, 1, limit)
    r_game = np.where(certain, 1, (square_game / safe + z2) / (n + z2))
    r_pair = np.where(certain, 1, (square_pair / safe + z2) / (m + z2))
    effective = n**2 / np.where(n > 0, 4 * m * r_pair + (n - 2 * m) * r_game, 1)
    return s, effective


class SeedScores(NamedTuple):
    """Weighted scores of G groups of games, as M rows, by kinds of seed clusters and of single episodes.

    The games of a cluster, or of an episode of several teams, are correlated: those of one kind and group, in several
    rows where there are several opponents, are a unit.
    """

    group: np.ndarray  # (M,) int
    kind: np.ndarray  # (M,) int
    weight: np.ndarray  # (M,) sum of the weights of these games of one unit
    points: np.ndarray  # (M,) scored in these games of one unit, times their weights
    number: np.ndarray  # (U,) how often each kind occurred
    effect: np.ndarray  # (U,) largest variance of the units of a kind, in that of as many independent ones


def effective_seeds(scores: SeedScores, groups: int, confidence: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """Return mean scores s (G,) and n* (G,), the equivalent numbers of decisive games; 0 and 0 without games.

    Of weights w whose sum over a group's units is 1, and with the mean score y of a unit:

        n* = 1 / (r Σ f w²),   r = (Σ f w² (y - s)²/(s(1-s)) + z² a) / (Σ f w² + z² a),   a = Σ f w² / Σ 1/f

    with f the kind's `effect`, so units that may all be copies in groups of f count as so many fewer. For seed pairs
    alone this is n* of `effective_games`. The variance of the scores among opponents counts as chance, so the interval
    of a mean over several is too wide rather than too narrow.
    """
    U, z2 = max(len(scores.number), 1), quantile(confidence) ** 2
    unit, place = np.unique(scores.group * U + scores.kind, return_inverse=True)
    group, kind = np.divmod(unit, U)
    weight, points = (np.bincount(place, each, len(unit)) for each in (scores.weight, scores.points))
    number, effect = scores.number[kind], scores.effect[kind]

    def total(each: np.ndarray) -> np.ndarray:
        return np.bincount(group, number * each, groups)

    whole = total(weight)
    weight, points = (each / whole[group] for each in (weight, points))
    s = np.clip(total(points), 0, 1)
    limit, squares = s * (1 - s), total(effect * (points - weight * s[group]) ** 2)
    spread, units = total(effect * weight**2), total(1 / effect)
    played, certain = units > 0, limit < 1e-12  # only wins or only losses
    pseudo = z2 * spread / np.where(played, units, 1)
    r = np.where(certain, 1, (squares / np.where(certain, 1, limit) + pseudo) / np.where(played, spread + pseudo, 1))
    return s, np.where(played, 1 / np.where(played, r * spread, 1), 0)


def quantile(confidence: float) -> float:
    """Return the two-sided quantile z of the standard normal distribution, e.g.

    1.96 for 0.95; ValueError outside (0, 1).
    """
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is {confidence}; it must lie between 0 and 1, e.g. 0.95")
    return NormalDist().inv_cdf((1 + confidence) / 2)
