"""The penalised likelihood of games: the part that all models share, which is the prior and the information matrix.

The parameters are the strengths θ of P snapshots and T shared ones. A model of games is an exponential family here, in
which the strengths enter by differences alone. So the information of the games is the Laplacian of weights of pairs of
snapshots, with a border for the shared parameters. Below D is the number of pairs with such a weight.
"""

import math
from abc import ABC, abstractmethod
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from matchmaking.ratings.likelihoods.information import Information, PairGraph, SolverNotConverged
from matchmaking.ratings.likelihoods.priors import Prior, even_log, even_variance

MAX_DENSE_FIT = 300
"""Maximum number of snapshots for which a step is solved in a table of all pairs; above, by the pairs that have met."""


STEP_TOLERANCE = 1e-6
"""Relative error of a step that is solved by pairs; the next step corrects it."""


class NotConverged(ArithmeticError):  # noqa: N818  (reads as what is wrong)
    """Newton's method has not converged; `x` is its last point."""

    def __init__(self, x: np.ndarray, why: str):
        super().__init__(f"the ratings' fit did not converge, though its objective is concave: {why}")
        self.x = x


class Moments(NamedTuple):
    """The information of the games, by pair of snapshots: covariances of the statistics that the model fits."""

    strength: np.ndarray  # (D,) weight of each pair
    shared: np.ndarray  # (D, T) of the pair's first with the shared parameters; its second has the opposite
    block: np.ndarray  # (T, T) of the shared parameters


class PenalisedLikelihood(ABC):
    """The log-likelihood of games and of the virtual games of a prior, with its derivatives.

    Without virtual games against the average it depends only on differences of strengths; `location` holds their sum at
    0. The parameters are θ (P), the side advantage γ, and logarithms of tie terms.
    """

    size: int  # P
    home: np.ndarray  # (D,) index of a pair's first snapshot
    away: np.ndarray  # (D,) index of its second
    prior: Prior
    free: np.ndarray  # (P + T,) bool: which parameters are fitted; the others are 0

    @property
    @abstractmethod
    def even(self) -> np.ndarray:
        """Values (T,) of the shared parameters that the prior calls even."""

    @abstractmethod
    def terms(self, x: np.ndarray) -> Any:
        """Return the model at parameters (P + T,), for the other methods."""

    @abstractmethod
    def of_games(self, terms: Any) -> float:
        """Return the log-likelihood of the games alone."""

    @abstractmethod
    def slope(self, terms: Any) -> np.ndarray:
        """Return the derivative (P + T,) of the log-likelihood of the games: statistics minus expected ones."""

    @abstractmethod
    def moments(self, terms: Any, dispersion: np.ndarray | None) -> Moments:
        """Return the information of the games.

        Each pair's games count times `dispersion` (D,) if given, or each ranking times that of its lineup (R,).
        """

    @property
    @abstractmethod
    def weights(self) -> np.ndarray:
        """Numbers (D,) of games of each pair, by which the solver forms groups."""

    def evaluate(self, x: np.ndarray) -> tuple[float, Any]:
        """Return the log-likelihood of the games and of the virtual games, and the model at x."""
        terms = self.terms(x)
        virtual = self.prior.games @ even_log(self._virtual(x)) + self._own_virtual_games @ even_log(self._from_even(x))
        return self.of_games(terms) + float(virtual), terms

    def gradient(self, x: np.ndarray, terms: Any) -> np.ndarray:
        """Return the derivative (P + T,) of the objective: score minus expected score, ties minus expected ties."""
        gradient = self.slope(terms)
        gradient[: self.size] -= self._signed_sums(
            self.prior.first, self.prior.second, self.prior.games * np.tanh(self._virtual(x) / 2) / 2
        )
        return np.where(self.free, gradient - self._own_virtual_games * np.tanh(self._from_even(x) / 2) / 2, 0)

    def information(self, x: np.ndarray, terms: Any, dispersion: np.ndarray | None = None) -> np.ndarray:
        """Return the Fisher information (P + T, P + T).

        Games count times `dispersion` if given, see `moments`, the prior's games once.
        """
        P, prior, moments = self.size, self.prior, self.moments(terms, dispersion)
        virtual = prior.games * even_variance(self._virtual(x))
        H = np.zeros((len(x), len(x)))
        met = np.bincount(self._table_places, np.concatenate([moments.strength, virtual]), P * P).reshape(P, P)
        np.add(met, met.T, out=H[:P, :P])
        diagonal = H[:P, :P].sum(1)
        np.negative(H[:P, :P], out=H[:P, :P])
        for column, weight in enumerate(moments.shared.T, start=P):
            H[:P, column] = self._signed_sums(self.home, self.away, weight)
        H[P:, :P] = H[:P, P:].T
        H[P:, P:] = moments.block
        H[~self.free] = H[:, ~self.free] = 0
        H[np.diag_indices(len(x))] += np.append(diagonal, np.zeros(len(x) - P))
        H[np.diag_indices(len(x))] += self._own_virtual_games * even_variance(self._from_even(x))
        return H

    def sparse_information(
        self, x: np.ndarray, terms: Any, dispersion: np.ndarray | None = None, located: bool = True
    ) -> Information:
        """Return the information, with `location` if `located`, stored as the pairs that met."""
        P, prior, (graph, place, sign) = self.size, self.prior, self._graph
        moments = self.moments(terms, dispersion)
        virtual = prior.games * even_variance(self._virtual(x))
        weight = np.bincount(place, np.concatenate([moments.strength, virtual]), len(graph.first))
        ties, free = self._own_virtual_games * even_variance(self._from_even(x)), self.free[P:]
        played, pairs = place[: len(sign)], len(graph.first)
        shared_terms = np.stack([np.bincount(played, sign * each, pairs) for each in moments.shared.T], 1) * free
        shared_block = moments.block * np.outer(free, free)
        unpinned = np.where(free | (self._own_virtual_games[P:] > 0) | (not located), 0.0, 1.0)
        constant = 1 / P if located and P and not prior.average else 0.0
        return Information(graph, weight, ties[:P], shared_terms, shared_block + np.diag(ties[P:] + unpinned), constant)

    def solve(self, x: np.ndarray, terms: Any, right: np.ndarray) -> np.ndarray:
        """Return the vector (P + T,) that the information, with `location`, maps to `right`.

        Raises LinAlgError or SolverNotConverged.
        """
        if self.is_dense:
            return np.linalg.solve(self.information(x, terms) + self.location, right)
        return self.sparse_information(x, terms).solver(STEP_TOLERANCE)(right[:, None])[:, 0]

    def start(self) -> np.ndarray:
        """Return parameters (P + T,) from which the maximum is sought."""
        return np.zeros(len(self.free))

    @property
    def is_dense(self) -> bool:
        """True if a step is solved in a table of all pairs."""
        return self.size <= MAX_DENSE_FIT

    @cached_property
    def _graph(self) -> tuple[PairGraph, np.ndarray, np.ndarray]:
        """Graph of the pairs with games or virtual games; the index of each directed or virtual pair in it; and signs.

        The sign of a directed pair is 1 if the pair's first is at home, else -1.
        """
        ends = np.append(self.home, self.prior.first), np.append(self.away, self.prior.second)
        graph, place = PairGraph.of(self.size, *ends, np.append(self.weights, self.prior.games))
        return graph, place, np.where(graph.first[place[: len(self.home)]] == self.home, 1.0, -1.0)

    @cached_property
    def location(self) -> np.ndarray:
        """Matrix (P + T, P + T) added to the information to solve with it: undetermined parameters stay at 0."""
        pinned = np.diag(np.where(self.free | (self._own_virtual_games > 0), 0.0, 1.0))
        if self.size and not self.prior.average:
            pinned[: self.size, : self.size] += 1 / self.size
        return pinned

    @cached_property
    def _table_places(self) -> np.ndarray:
        """Positions in a (P, P) table of each directed pair and then of each virtual one."""
        first, second = (
            np.concatenate(ends) for ends in ((self.home, self.prior.first), (self.away, self.prior.second))
        )
        return first * self.size + second

    @cached_property
    def _own_virtual_games(self) -> np.ndarray:
        """Virtual games (P + T,) of each parameter alone, at even odds."""
        return np.append(np.full(self.size, self.prior.average), np.full(len(self.even), self.prior.even))

    def _from_even(self, x: np.ndarray) -> np.ndarray:
        """Return each parameter's distance from even odds."""
        return x - np.append(np.zeros(self.size), self.even)

    def _virtual(self, x: np.ndarray) -> np.ndarray:
        return x[self.prior.first] - x[self.prior.second]

    def _signed_sums(self, plus: np.ndarray, minus: np.ndarray, weight: np.ndarray) -> np.ndarray:
        return np.bincount(plus, weight, self.size) - np.bincount(minus, weight, self.size)


def maximise(problem: PenalisedLikelihood, steps: int = 100) -> np.ndarray:
    """Return the maximum by Newton's method from `start`, halving each step until the objective does not fall.

    It is Fisher scoring here, since the models are exponential families. Without a maximum it ends far out, where the
    information vanishes (`matchmaking.ratings.likelihoods.undefeated` looks for that), or raises NotConverged.
    """
    x, decrement = problem.start(), math.inf
    value, terms = problem.evaluate(x)
    for _ in range(steps):
        gradient = problem.gradient(x, terms)
        try:
            step = problem.solve(x, terms, gradient)
        except (np.linalg.LinAlgError, SolverNotConverged) as error:
            raise NotConverged(x, str(error)) from error
        decrement, floor = gradient @ step, value - 1e-12 * abs(value)
        while not (trial := problem.evaluate(x + step))[0] >= floor:  # nor is it a number where a step goes far too far
            step = step / 2
        x, (value, terms) = x + step, trial
        if decrement < 1e-16 * (1 + abs(value)) or np.abs(step).max() < 1e-10:
            return x
    # Next to millions of games on one side, rounding keeps parameters of a few games from coming closer: √decrement
    # is the distance to the maximum in standard errors.
    if decrement < 1e-6:
        return x
    raise NotConverged(x, f"{steps} Newton steps were not enough")
