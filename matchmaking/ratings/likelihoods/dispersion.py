"""Dispersion of games that share a start: the variance of their scores relative to that of independent games.

The games of a cluster, such as the two of a seed pair or the rotations of a lineup from one seed, share a start, so
their scores are correlated. The residual of a cluster is its score minus the expected one; its mean square over the
clusters of two snapshots or of a lineup, divided by the model's variance, is their dispersion (as in quasi-likelihood,
McCullagh and Nelder 1989, section 4.5). Few clusters, or clusters with certain results, tell little of it: it is shrunk
to the dispersion pooled over the whole payoff, which is shrunk to 1 in the same way. Games outside clusters have
dispersion 1.
"""

from typing import NamedTuple

import numpy as np

from matchmaking.ratings.davidson import Outcome
from matchmaking.ratings.payoff import Payoff
from matchmaking.ratings.plackett_luce import PlackettLuce, RankingTerms
from matchmaking.ratings.rankings import ClusterBlock, Rankings
from matchmaking.ratings.scores import PAIR_SCORES

PRIOR = 2.0
"""Virtual variance, of four decisive seed pairs between equals, with the pooled dispersion."""


class Clusters(NamedTuple):
    """Games that share a start, so that their scores are correlated: M kinds of clusters between two snapshots."""

    edge: np.ndarray  # (M,) int: index of the payoff's pair
    home: np.ndarray  # (M,) games in which its first snapshot played team 0
    away: np.ndarray  # (M,) games in which its second snapshot did
    score: np.ndarray  # (M,) of its first, summed over the cluster
    number: np.ndarray  # (M,) clusters of this kind

    @classmethod
    def of(cls, payoff: Payoff) -> "Clusters":
        """Return the seed pairs of a payoff."""
        edge, score = np.nonzero(payoff.pairs)
        one = np.ones(len(edge))
        return cls(edge, one, one, 2 * PAIR_SCORES[score], payoff.pairs[edge, score].astype(float))


NO_CLUSTERS = Clusters(np.zeros(0, int), *(np.zeros(0) for _ in range(4)))


def of_pairs(payoff: Payoff, terms: Outcome, clusters: Clusters) -> np.ndarray:
    """Return the dispersion (D,) of the games of each (home, away) pair."""
    E, (edge, home, away, score, number) = len(payoff.first), clusters
    first, second = slice(None, E), slice(E, None)
    mean = home * terms.score[first][edge] + away * (1 - terms.score[second][edge])
    variance = home * terms.score_variance[first][edge] + away * terms.score_variance[second][edge]
    per_pair = _shrunk(np.bincount(edge, number * (score - mean) ** 2, E), np.bincount(edge, number * variance, E))
    clustered = np.concatenate([np.bincount(edge, number * n, E) for n in (home, away)])
    share = clustered / np.maximum(np.concatenate([payoff.home.sum(1), payoff.away.sum(1)]), 1)
    return 1 + share * (np.tile(per_pair, 2) - 1)


def of_rankings(problem: PlackettLuce, terms: RankingTerms, rankings: Rankings) -> np.ndarray:
    """Return the dispersion (R,) of each ranking, in the order of its blocks: that of the lineup that played it.

    The score of a lineup's cluster is a vector, the derivative of the log-likelihood by the strengths, and its square
    is the sum over players, halved: for two players that of either's score. The variance is the sum of the weights of
    all pairs, which is half the trace of the covariance.
    """
    if not rankings.clusters:
        return np.ones(sum(len(each.number) for each in rankings.blocks))
    lineups, place = _lineups(rankings)
    square, variance, clustered, episodes = np.zeros((4, len(lineups)))
    for block in rankings.clusters:
        at = np.array([lineups[tuple(sorted(row))] for row in block.players[:, 0].tolist()], int)
        residual, weight = problem.scores_of(terms, block.rankings)
        scores = _by_player(block, residual)
        np.add.at(square, at, block.number * (scores**2).sum(1) / 2)
        np.add.at(variance, at, block.number * weight.reshape(len(at), -1).sum(1))
        np.add.at(clustered, at, block.number * block.players.shape[1])
    np.add.at(episodes, place, np.concatenate([each.number for each in rankings.blocks]))
    share = clustered / np.maximum(episodes, 1)
    return (1 + share * (_shrunk(square, variance) - 1))[place]


def _shrunk(square: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return squares over variances, both (M,), shrunk to the pooled ratio, and that to 1."""
    pooled = (square.sum() + PRIOR) / (variance.sum() + PRIOR)
    return (square + PRIOR * pooled) / (variance + PRIOR)


def _lineups(rankings: Rankings) -> tuple[dict[tuple[int, ...], int], np.ndarray]:
    """Return a number for each set of players that met, and the number (R,) of each ranking's."""
    numbers: dict[tuple[int, ...], int] = {}
    place = [
        numbers.setdefault(tuple(row), len(numbers))
        for each in rankings.blocks
        for row in np.sort(each.players, 1).tolist()
    ]
    return numbers, np.array(place, int)


def _by_player(block: ClusterBlock, residual: np.ndarray) -> np.ndarray:
    """Return the sums (C, n) of residuals (C k, n) over a cluster, at each player's place in the ascending lineup."""
    C, k, n = block.players.shape
    ascending = np.sort(block.players[:, 0], 1)
    place = (ascending[:, None, None, :] < block.players[..., None]).sum(-1)  # equal ones are one player
    found = np.zeros((C, n))
    np.add.at(found, (np.arange(C)[:, None], place.reshape(C, k * n)), residual.reshape(C, k * n))
    return found
