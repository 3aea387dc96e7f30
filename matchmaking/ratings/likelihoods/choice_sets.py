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

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from matchmaking.ratings.rankings import Block, chunks, tied

LOWEST = -600.0
"""Log odds below the best of a ranking under which a strength counts as this: exp would be 0."""


class Values(NamedTuple):
    """The model at some strengths and tie terms."""

    log_likelihood: float
    strength: np.ndarray  # (n, R) θ minus the best one's
    log_delta: np.ndarray  # (K + 1,) log δ of the orders, of which the first is 1


class Derivatives(NamedTuple):
    """Statistics and covariances, summed over the choices of each ranking."""

    residual: np.ndarray  # (n, R) statistics of θ minus their means, times the number of games
    ties: np.ndarray  # (K,) expected numbers of ties of each order
    pairs: np.ndarray  # (C, R) minus the covariances of two players' statistics
    flows: np.ndarray  # (K, C, R) differences whose sums are the covariances of the first one's with the ties
    tie_covariance: np.ndarray  # (K, K)


class ChoiceSets:
    """The choices of R rankings of n players. Rankings are the last axis of arrays, which numpy passes through fast."""

    def __init__(self, block: Block, orders: Sequence[int]):
        """Prepare the rankings; `orders` are the sizes of tied groups that may be chosen, of which the first is 1."""
        ranks, number = block.ranks, block.number
        self.players, self.orders = np.ascontiguousarray(block.players.T), orders
        n = self.n = ranks.shape[1]
        size, position = tied(ranks), np.arange(n)
        chosen = (ranks - 1 == position) & (position < n - 1)  # whoever is left alone is not chosen
        self.choices = np.ascontiguousarray(np.where(chosen, number[:, None], 0.0).T)
        # of each player in its group's statistic
        self.share = np.ascontiguousarray(np.where(ranks < n, number[:, None] / size, 0.0).T)
        self.ties = np.array([self.choices.T[chosen & (size == k)].sum() for k in orders[1:]])
        sizes = self.choices.sum(1)  # of the choices among n, n - 1, ... players
        self.tie_odds = [
            sum(c * math.comb(n - i, k) / (n - i) for i, c in enumerate(sizes.tolist())) for k in orders[1:]
        ]
        self.ahead, self.behind = np.triu_indices(n, 1)

    def parts(self) -> list[slice]:
        """Return slices of rankings that are small enough for the arrays of `derive`."""
        return chunks(self.players.shape[1], self.n**2 * len(self.orders), 1_000_000)

    def evaluate(self, theta: np.ndarray, log_delta: np.ndarray) -> Values:
        """Return the model at strengths (P,) and logarithms (K + 1,) of the tie terms."""
        strength = theta[self.players]
        strength = np.maximum(strength - strength.max(0), LOWEST)
        value = float((self.share * strength).sum() + self.ties @ log_delta[1:])
        for rows in self.parts():
            z = self._normaliser(self._sums(strength[:, rows]), log_delta)
            value -= float((self.choices[:, rows] * np.log(z)).sum())
        return Values(value, strength, log_delta)

    def derive(self, values: Values, rows: slice) -> Derivatives:
        """Return the derivatives of some rankings."""
        n, orders, choices = self.n, self.orders, self.choices[:, rows]
        strength, a, b = values.strength[:, rows], self.ahead, self.behind
        sums = self._sums(strength)
        z = self._normaliser(sums, values.log_delta)
        weights = [np.exp(log) / z for log in values.log_delta]  # of a group in each choice, (n, R)
        included = [
            self._included(k, *each, strength) for k, each in zip(orders, zip(weights, sums, strict=True), strict=True)
        ]
        tie = np.stack([weight * e[k] for k, weight, e in zip(orders[1:], weights[1:], sums[1:], strict=True)] or [z])
        mean = sum((chance / k for k, chance in zip(orders, included, strict=True)), np.zeros(()))
        weighted = choices[:, None] * mean  # [choice, player, ranking]
        product = np.matmul(
            np.ascontiguousarray(mean.transpose(2, 1, 0)), np.ascontiguousarray(weighted.transpose(2, 0, 1))
        )
        pairs = np.ascontiguousarray(product[:, a, b].T)
        flows = np.zeros((len(orders) - 1, *pairs.shape))
        left = (n - np.arange(n))[:, None, None]
        for place, k in enumerate(orders[1:]):
            pairs -= self._both(np.exp(strength / k), choices * weights[place + 1], sums[place + 1], k)
            mixed = choices[:, None] * included[place + 1] / k - weighted * tie[place][:, None]
            mixed *= np.triu(np.ones((n, n)))[:, :, None] / left
            running = np.cumsum(mixed, 0)
            flows[place] = running[a, a] - running[a, b]
        ties = tie if len(orders) > 1 else np.zeros((0, *choices.shape))
        expected = (choices * ties).sum((1, 2))
        covariance = np.diag(expected) - np.einsum("kir,lir->kl", choices * ties, ties)
        return Derivatives(self.share[:, rows] - weighted.sum(0), expected, pairs, flows, covariance)

    def _included(self, k: int, weight: np.ndarray, e: np.ndarray, strength: np.ndarray) -> np.ndarray:
        """Return the chance (n, n, R) that a choice is a group of k with this player: [choice, player, ranking]."""
        beta = np.exp(strength / k)[None]
        without = np.ones_like(beta)
        for q in range(1, k):
            without = e[q][:, None] - beta * without
        return np.triu(np.ones((self.n, self.n)))[:, :, None] * weight[:, None] * (beta * without)

    def _both(self, beta: np.ndarray, weight: np.ndarray, e: np.ndarray, k: int) -> np.ndarray:
        """Return (C, R): the mean of two players' x_a x_b in groups of k, summed over the choices that both are in."""
        a, b = self.ahead, self.behind
        one, other = -beta[a], -beta[b]
        complete = [np.ones_like(one)]  # homogeneous symmetric polynomials of -β_a and -β_b, which divide both out
        for power in range(1, k - 1):
            complete.append(one * complete[-1] + other**power)
        found = np.zeros_like(one)
        for q in range(k - 1):
            found += np.cumsum(weight * e[q], 0)[a] * complete[k - 2 - q]
        return one * other * found / k**2

    def _sums(self, strength: np.ndarray) -> list[np.ndarray]:
        """Return for each order k the polynomials e_0 to e_k (k + 1, n, R) of the players from each position on."""
        found = []
        for k in self.orders:
            beta = np.exp(strength / k)
            e = np.zeros((k + 1, self.n + 1, strength.shape[1]))
            e[0] = 1
            for i in range(self.n - 1, -1, -1):
                e[1:, i] = e[1:, i + 1] + beta[i] * e[:-1, i + 1]
            found.append(e[:, :-1])
        return found

    def _normaliser(self, sums: Sequence[np.ndarray], log_delta: np.ndarray) -> np.ndarray:
        return np.sum([np.exp(log) * e[k] for k, log, e in zip(self.orders, log_delta, sums, strict=True)], 0)
