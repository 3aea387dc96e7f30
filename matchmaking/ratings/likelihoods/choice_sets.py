"""Plackett and Luce's model with ties for rankings of n players: its value and derivatives.

A ranking is a sequence of choices: of all players the best one, or a group of tied best ones, then the next of those
that are left. Of the alternatives A a group T of k players is chosen with probability δ_k (Π_{i∈T} α_i)^{1/k} / Z
(Turner, van Etten, Firth and Kosmidis 2020, "Modelling rankings in R: the PlackettLuce package"), where δ_1 = 1 and Z
is the sum over all groups of the sizes that occur. With β_i = α_i^{1/k} the sum over groups of size k is δ_k times the
elementary symmetric polynomial e_k(β). The alternatives of later choices are the last players of the ranking, so one
pass from its end gives all sums.

Each choice is a multinomial logit with the statistics x_i = 1/k for i in T, and an indicator of k for each size. The
derivative by θ_i = log α_i is x_i minus its mean, and the information is the covariance of the statistics. The means
need e_{k-1} of the alternatives without one player, and the covariances e_{k-2} without two, which follow from those of
all by division by 1 + β z. What its differences lose in digits is small beside the term of the best single player,
which is part of Z. Below R is the number of rankings, K that of tie orders, C that of pairs of positions.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from matchmaking.ratings.rankings import Block, chunks, tied

LOWEST = -600.0
"""Log odds below the best of a ranking under which a strength counts as this: exp would be 0."""


class Values(NamedTuple):
    """The model at some strengths and tie terms, of R rankings of n players."""

    log_likelihood: float
    strength: np.ndarray  # (R, n) θ minus the best one's
    log_delta: np.ndarray  # (K + 1,) log δ of the orders, of which the first is 1


class Derivatives(NamedTuple):
    """Statistics and covariances, summed over the choices of each ranking."""

    residual: np.ndarray  # (R, n) statistics of θ minus their means, times the number of games
    ties: np.ndarray  # (K,) expected numbers of ties of each order
    pairs: np.ndarray  # (R, C) minus the covariances of two players' statistics
    flows: np.ndarray  # (R, C, K) differences whose sums are the covariances of the first one's with the ties
    tie_covariance: np.ndarray  # (K, K)


class ChoiceSets:
    """The choices of R rankings of n players."""

    def __init__(self, block: Block, orders: Sequence[int]):
        """Prepare the rankings; `orders` are the sizes of tied groups that may be chosen, of which the first is 1."""
        self.players, ranks, count = block
        self.orders = orders
        n = self.n = ranks.shape[1]
        size, position = tied(ranks), np.arange(n)
        chosen = (ranks - 1 == position) & (position < n - 1)  # whoever is left alone is not chosen
        self.choices = np.where(chosen, count[:, None], 0.0)
        self.share = np.where(ranks < n, count[:, None] / size, 0.0)  # of each player in its group's statistic
        self.ties = np.array([self.choices[chosen & (size == k)].sum() for k in orders[1:]])
        self.ahead, self.behind = np.triu_indices(n, 1)

    def evaluate(self, theta: np.ndarray, log_delta: np.ndarray) -> Values:
        """Return the model at strengths (P,) and logarithms (K + 1,) of the tie terms."""
        strength = theta[self.players]
        strength = np.maximum(strength - strength.max(1, keepdims=True), LOWEST)
        value = float((self.share * strength).sum() + self.ties @ log_delta[1:])
        for rows in chunks(len(strength), self.n * sum(self.orders)):
            z = self._normaliser(self._sums(strength[rows]), log_delta)
            value -= float((self.choices[rows] * np.log(z)).sum())
        return Values(value, strength, log_delta)

    def derive(self, values: Values, rows: slice) -> Derivatives:
        """Return the derivatives of some rankings."""
        n, orders, choices = self.n, self.orders, self.choices[rows]
        strength, a, b = values.strength[rows], self.ahead, self.behind
        sums = self._sums(strength)
        z = self._normaliser(sums, values.log_delta)
        weights = [np.exp(log) / z for log in values.log_delta]  # of a group in each choice, (R, n)
        alternatives = np.triu(np.ones((n, n)))  # [choice, player]
        included, tie, mean = [], [], np.zeros((len(strength), n, n))
        for k, weight, e in zip(orders, weights, sums, strict=True):
            beta = np.exp(strength / k)[:, None, :]
            without = np.ones_like(mean)
            for q in range(1, k):
                without = e[q][:, :, None] - beta * without
            chance = weight[:, :, None] * beta * without * alternatives
            included.append(chance)
            tie.append(weight * e[k])
            mean += chance / k
        pairs = np.matmul(mean.transpose(0, 2, 1), choices[:, :, None] * mean)[:, a, b]
        flows = np.zeros((len(strength), len(a), len(orders) - 1))
        left = n - np.arange(n)
        for place, (k, weight, e) in enumerate(zip(orders, weights, sums, strict=True)):
            if k == 1:
                continue
            pairs -= self._both(np.exp(strength / k), choices * weight, e, k)
            mixed = choices[:, :, None] * (included[place] / k - mean * tie[place][:, :, None]) * alternatives
            running = np.cumsum(mixed / left[:, None], 1)
            flows[:, :, place - 1] = running[:, a, a] - running[:, a, b]
        ties = np.stack(tie[1:]) if len(tie) > 1 else np.zeros((0, *choices.shape))
        expected = (choices * ties).sum((1, 2))
        covariance = np.diag(expected) - np.einsum("kri,lri->kl", choices * ties, ties)
        residual = self.share[rows] - np.einsum("ri,ria->ra", choices, mean)
        return Derivatives(residual, expected, pairs, flows, covariance)

    def _both(self, beta: np.ndarray, weight: np.ndarray, e: np.ndarray, k: int) -> np.ndarray:
        """Return (R, C): the mean of two players' x_a x_b in groups of k, summed over the choices that both are in."""
        a, b = self.ahead, self.behind
        one, other = -beta[:, a], -beta[:, b]
        complete = [np.ones_like(one)]  # homogeneous symmetric polynomials of -β_a and -β_b, which divide both out
        for power in range(1, k - 1):
            complete.append(one * complete[-1] + other**power)
        found = np.zeros_like(one)
        for q in range(k - 1):
            found += np.cumsum(weight * e[q], 1)[:, a] * complete[k - 2 - q]
        return one * other * found / k**2

    def _sums(self, strength: np.ndarray) -> list[np.ndarray]:
        """Return for each order k the polynomials e_0 to e_k (k + 1, R, n) of the players from each position on."""
        found = []
        for k in self.orders:
            beta = np.exp(strength / k)
            e = np.zeros((k + 1, *strength.shape))
            e[0] = 1
            below = np.zeros((k + 1, len(strength)))
            below[0] = 1
            for i in range(self.n - 1, -1, -1):
                below[1:] = below[1:] + beta[:, i] * below[:-1]
                e[1:, :, i] = below[1:]
            found.append(e)
        return found

    def _normaliser(self, sums: Sequence[np.ndarray], log_delta: np.ndarray) -> np.ndarray:
        return np.sum([np.exp(log) * e[k] for k, log, e in zip(self.orders, log_delta, sums, strict=True)], 0)
