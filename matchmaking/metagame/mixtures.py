"""Payoff tables under uncertainty: scores of pairs that have not met, and intervals of mixtures.

Below U is the number of snapshots, N the number of a table's rows, M that of its columns.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from matchmaking.metagame.nash import Equilibrium
from matchmaking.ratings.davidson import expected_score
from matchmaking.ratings.fit import ELO, Ratings
from matchmaking.ratings.payoff import Payoff

SEED = 1
"""Seed of sampled tables: the same games give the same intervals."""


@dataclass(frozen=True, eq=False)
class PayoffPosterior:
    """Knowledge of the scores between U snapshots: from their games, and from ratings where they have not met."""

    scores: np.ndarray  # (U, U) mean score of the row, nan for pairs that have not met, ½ on the diagonal
    effective: np.ndarray  # (U, U) equivalent number of decisive games, see `Payoff.effective_scores`
    strength: np.ndarray  # (U,) in Elo
    ratings: Ratings  # of all snapshots
    chosen: np.ndarray  # (U,) int: positions of these in the ratings
    side: float  # Elo advantage of playing team 0
    draw: float  # Davidson's ν

    @classmethod
    def of(cls, payoff: Payoff, ratings: Ratings, names: Sequence[str]) -> "PayoffPosterior":
        """Return the posterior for some snapshots of a payoff. Raises ValueError for unknown names."""
        chosen = np.array([payoff.index(name) for name in names], int)
        place = np.full(len(payoff.names), -1)
        place[chosen] = np.arange(len(chosen))
        both = (place[payoff.first] >= 0) & (place[payoff.second] >= 0)
        met = np.flatnonzero(both & (payoff.home + payoff.away).any(1))
        ends = payoff.first[met], payoff.second[met]
        _, scores, effective = payoff.effective_scores(*ends, np.arange(len(met)), len(met))
        first, second = (place[end] for end in ends)
        table, weight = np.full((len(chosen),) * 2, np.nan), np.zeros((len(chosen),) * 2)
        np.fill_diagonal(table, 0.5)
        table[first, second], table[second, first] = scores, 1 - scores
        weight[first, second] = weight[second, first] = effective
        return cls(
            table, weight, ratings.strength[chosen], ratings, chosen, ratings.side_advantage, ratings.draw,
        )  # fmt: skip

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance (U, U) of the strengths, in Elo²; computed on first use, because it is slow for thousands."""
        return self.ratings.covariances_of(self.chosen)

    def expected(self, strength: np.ndarray | None = None) -> np.ndarray:
        """Return the expected score (U, U) of the row by the ratings, or by other strengths, averaged over sides."""
        strength = self.strength if strength is None else strength
        first = expected_score((strength[:, None] - strength + self.side) / ELO, self.draw)
        return (first + 1 - first.T) / 2

    def completed(self) -> np.ndarray:
        """Return the scores (U, U), with the ratings' expectation for pairs that have not met."""
        return np.where(np.isnan(self.scores), self.expected(), self.scores)

    def variances(self) -> np.ndarray:
        """Return the variance (U, U) of each pair's score under `sample_tables`; nan for pairs that have not met."""
        mean = (self.scores * self.effective + 0.5) / (self.effective + 1)
        return mean * (1 - mean) / (self.effective + 2)

    def sample_tables(self, count: int, seed: int = SEED) -> Iterator[np.ndarray]:
        """Yield tables (U, U) of true scores, sampled given the games.

        A pair's score is sampled from its posterior under Jeffreys' prior: a beta distribution with half a win and half
        a loss in addition to the effective games. The score of a pair that has not met is the expectation of ratings
        that are sampled from the normal distribution of the fit.
        """
        rng, (i, j) = np.random.default_rng(seed), np.triu_indices(len(self.strength), 1)
        met = ~np.isnan(self.scores[i, j])
        scores, n = self.scores[i, j][met], self.effective[i, j][met]
        for _ in range(count):
            strength = rng.multivariate_normal(self.strength, self.covariance, check_valid="ignore", method="eigh")
            table = self.expected(strength)
            sample_tables = table[i, j]
            sample_tables[met] = rng.beta(scores * n + 0.5, (1 - scores) * n + 0.5)
            table[i, j], table[j, i] = sample_tables, 1 - sample_tables
            yield table


class MixtureInterval(NamedTuple):
    """Intervals of 95 % for a mixture's masses and its value, and the mean of the masses."""

    mean: np.ndarray  # (N,)
    low: np.ndarray  # (N,)
    high: np.ndarray  # (N,)
    value: tuple[float, float]


def mixture_interval(solve: Callable[[np.ndarray], Equilibrium], tables: Iterable[np.ndarray]) -> MixtureInterval:
    """Return the central 95 % of the mixtures of sampled tables (N, M), strategy by strategy; at least one table."""
    solved = [solve(table) for table in tables]
    masses = np.array([each.mass for each in solved])
    low, high = np.quantile(masses, [0.025, 0.975], axis=0)
    return MixtureInterval(
        masses.mean(0), low, high, tuple(np.quantile([each.value for each in solved], [0.025, 0.975]).tolist())
    )
