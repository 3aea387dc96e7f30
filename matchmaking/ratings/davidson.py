"""Davidson's model of wins, draws and losses: its likelihood over directed counts, and the maximum of that."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from matchmaking.ratings.information import Information, PairGraph, SolverNotConverged
from matchmaking.ratings.payoff import Payoff
from matchmaking.ratings.priors import Prior, even_log, even_variance

MAX_DENSE_FIT = 300
"""Maximum number of snapshots for which a step is solved in a table of all pairs; above, by the pairs that have met."""


STEP_TOLERANCE = 1e-6
"""Relative error of a step that is solved by pairs; the next step corrects it."""


class NotConverged(ArithmeticError):  # noqa: N818  (reads as what is wrong)
    """Newton's method has not converged; `x` is its last point."""

    def __init__(self, x: np.ndarray, why: str):
        super().__init__(f"the ratings' fit did not converge, though its objective is concave: {why}")
        self.x = x


class Outcome(NamedTuple):
    """Davidson's model at some strength differences: probabilities and moments of one game, arrays of one shape."""

    log_likelihood: np.ndarray  # (3, ...) of a win, a draw, a loss
    score: np.ndarray  # expected score
    draw: np.ndarray  # probability of a draw
    score_variance: np.ndarray
    covariance: np.ndarray  # of the score with a draw's indicator
    draw_variance: np.ndarray


def davidson(d: np.ndarray, log_nu: float) -> Outcome:
    """Return the model for win, draw, loss as exp(d/2) : ν : exp(-d/2) (Davidson 1970), d in log odds.

    `log_nu` is -inf if there are no draws.
    """
    logits = np.stack([d / 2, np.full_like(d, log_nu), -d / 2])
    top = logits.max(0)
    log_p = logits - (top + np.log(np.exp(logits - top).sum(0)))
    win, draw, loss = np.exp(log_p)
    # Written without differences of nearly equal numbers, so that certain results keep a positive variance.
    variance = win * loss + draw * (win + loss) / 4
    return Outcome(log_p, win + draw / 2, draw, variance, draw * (loss - win) / 2, draw * (win + loss))


def expected_score(d: np.ndarray, nu: float) -> np.ndarray:
    """Return only the score of `davidson`: win, draw, loss are 1 : νh : h², h = exp(-|d|/2)."""
    h = np.exp(-np.abs(d) / 2)
    stronger = (1 + nu / 2 * h) / (1 + nu * h + h * h)
    return np.where(d < 0, 1 - stronger, stronger)


@dataclass(frozen=True, eq=False)
class Likelihood:
    """Penalised likelihood; parameters are θ (P), γ and log ν, of which `free` are fitted.

    Without virtual games against the average it depends only on differences of strengths; `location` holds their sum at
    0.
    """

    size: int
    home: np.ndarray  # (D,) index of the snapshot that played team 0
    away: np.ndarray  # (D,)
    counts: np.ndarray  # (D, 3) wins, draws, losses of home
    prior: Prior
    free: np.ndarray  # (P + 2,) bool

    @classmethod
    def of(cls, payoff: Payoff, prior: Prior, sides: bool = True) -> "Likelihood":
        """Return the likelihood of a payoff's directed counts. Without `sides` there is no side advantage γ.

        γ is fitted only if it can be distinguished from strength: not if some strengths, one apart for each game
        between home and away, would have the same effect. ν is fitted only if a game was drawn.
        """
        P = len(payoff.names)
        home = np.concatenate([payoff.first, payoff.second])
        away = np.concatenate([payoff.second, payoff.first])
        counts = np.concatenate([payoff.home, payoff.away[:, ::-1]]).astype(float)
        met = counts.any(1)
        identifiable = sides and not _is_potential(P, home[met], away[met])
        free = np.append(np.ones(P, bool), np.array([identifiable, counts[:, 1].any()], bool))
        return cls(P, home, away, counts, prior, free)

    def linear(self, x: np.ndarray) -> tuple[np.ndarray, float]:
        """Return strength differences d (D,) with the side advantage, and log ν."""
        P = self.size
        return x[self.home] - x[self.away] + x[P], float(x[P + 1]) if self.free[P + 1] else -math.inf

    def evaluate(self, x: np.ndarray) -> tuple[float, Outcome]:
        """Return the log-likelihood of the games and of the virtual games, and the model at x."""
        terms = davidson(*self.linear(x))
        virtual = self.prior.games @ even_log(self._virtual(x)) + self._own_virtual_games @ even_log(self._from_even(x))
        return self.of_games(terms) + float(virtual), terms

    def of_games(self, terms: Outcome) -> float:
        """Return the log-likelihood of the games alone."""
        seen = self.counts.T > 0
        return float((self.counts.T[seen] * terms.log_likelihood[seen]).sum())

    def gradient(self, x: np.ndarray, terms: Outcome) -> np.ndarray:
        """Return the derivative (P + 2,) of the objective: score minus expected score, draws minus expected draws."""
        residual = self.counts[:, 0] + self.counts[:, 1] / 2 - self._games * terms.score
        gradient = np.zeros(self.size + 2)
        gradient[:-2] = self._signed_sums(self.home, self.away, residual)
        gradient[:-2] -= self._signed_sums(
            self.prior.first, self.prior.second, self.prior.games * np.tanh(self._virtual(x) / 2) / 2
        )
        gradient[-2:] = residual.sum(), (self.counts[:, 1] - self._games * terms.draw).sum()
        return np.where(self.free, gradient - self._own_virtual_games * np.tanh(self._from_even(x) / 2) / 2, 0)

    def information(self, x: np.ndarray, terms: Outcome, dispersion: np.ndarray | None = None) -> np.ndarray:
        """Return the Fisher information (P + 2, P + 2).

        Each pair's games count times `dispersion` (D,) if given, the prior's games once.
        """
        P, prior, (strength, mixed, drawn) = self.size, self.prior, self._moments(terms, dispersion)
        virtual = prior.games * even_variance(self._virtual(x))
        H = np.zeros((P + 2, P + 2))
        met = np.bincount(self._table_places, np.concatenate([strength, virtual]), P * P).reshape(P, P)
        np.add(met, met.T, out=H[:P, :P])
        diagonal = H[:P, :P].sum(1)
        np.negative(H[:P, :P], out=H[:P, :P])
        for column, weight in ((P, strength), (P + 1, mixed)):
            H[:P, column] = self._signed_sums(self.home, self.away, weight)
        H[P:, :P] = H[:P, P:].T
        H[P:, P:] = [[strength.sum(), mixed.sum()], [mixed.sum(), drawn.sum()]]
        H[~self.free] = H[:, ~self.free] = 0
        H[np.diag_indices(P + 2)] += np.append(diagonal, [0, 0]) + self._own_virtual_games * even_variance(
            self._from_even(x)
        )
        return H

    def sparse_information(
        self, x: np.ndarray, terms: Outcome, dispersion: np.ndarray | None = None, located: bool = True
    ) -> Information:
        """Return the information, with `location` if `located`, stored as the pairs that met."""
        P, prior, (graph, place, sign) = self.size, self.prior, self._graph
        strength, mixed, drawn = self._moments(terms, dispersion)
        virtual = prior.games * even_variance(self._virtual(x))
        weight = np.bincount(place, np.concatenate([strength, virtual]), len(graph.first))
        ties, free = self._own_virtual_games * even_variance(self._from_even(x)), self.free[P:]
        played, pairs = place[: len(sign)], len(graph.first)
        shared_terms = np.stack([np.bincount(played, sign * each, pairs) for each in (strength, mixed)], 1) * free
        shared_block = np.array([[strength.sum(), mixed.sum()], [mixed.sum(), drawn.sum()]]) * np.outer(free, free)
        unpinned = np.where(free | (self._own_virtual_games[P:] > 0) | (not located), 0.0, 1.0)
        constant = 1 / P if located and P and not prior.average else 0.0
        return Information(graph, weight, ties[:P], shared_terms, shared_block + np.diag(ties[P:] + unpinned), constant)

    def _moments(self, terms: Outcome, dispersion: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return for a pair's games (D,) the variance of the score, its covariance with draws, and their variance."""
        n = self._games if dispersion is None else self._games * dispersion
        return n * terms.score_variance, n * terms.covariance, n * terms.draw_variance

    def solve(self, x: np.ndarray, terms: Outcome, right: np.ndarray) -> np.ndarray:
        """Return the vector (P + 2,) that the information, with `location`, maps to `right`.

        Raises LinAlgError or SolverNotConverged.
        """
        if self.size <= MAX_DENSE_FIT:
            return np.linalg.solve(self.information(x, terms) + self.location, right)
        return self.sparse_information(x, terms).solver(STEP_TOLERANCE)(right[:, None])[:, 0]

    @cached_property
    def _graph(self) -> tuple[PairGraph, np.ndarray, np.ndarray]:
        """Graph of the pairs with games or virtual games; the index of each directed or virtual pair in it; and signs.

        The sign of a directed pair is 1 if the pair's first is at home, else -1.
        """
        ends = np.append(self.home, self.prior.first), np.append(self.away, self.prior.second)
        graph, place = PairGraph.of(self.size, *ends, np.append(self._games, self.prior.games))
        return graph, place, np.where(graph.first[place[: len(self.home)]] == self.home, 1.0, -1.0)

    @cached_property
    def location(self) -> np.ndarray:
        """Matrix (P + 2, P + 2) added to the information to solve with it: undetermined parameters stay at 0."""
        pinned = np.diag(np.where(self.free | (self._own_virtual_games > 0), 0.0, 1.0))
        if self.size and not self.prior.average:
            pinned[:-2, :-2] += 1 / self.size
        return pinned

    @cached_property
    def _table_places(self) -> np.ndarray:
        """Positions in a (P, P) table of each directed pair and then of each virtual one."""
        first, second = (
            np.concatenate(ends) for ends in ((self.home, self.prior.first), (self.away, self.prior.second))
        )
        return first * self.size + second

    @cached_property
    def _games(self) -> np.ndarray:
        return self.counts.sum(1)

    @cached_property
    def _own_virtual_games(self) -> np.ndarray:
        """Virtual games (P + 2,) of each parameter alone, at even odds."""
        return np.append(np.full(self.size, self.prior.average), [self.prior.even, self.prior.even])

    def _from_even(self, x: np.ndarray) -> np.ndarray:
        """Return each parameter's distance from even odds; draws are even at ν = 2 (probability ν/(2+ν))."""
        return x - np.append(np.zeros(self.size + 1), math.log(2))

    def _virtual(self, x: np.ndarray) -> np.ndarray:
        return x[self.prior.first] - x[self.prior.second]

    def _signed_sums(self, plus: np.ndarray, minus: np.ndarray, weight: np.ndarray) -> np.ndarray:
        return np.bincount(plus, weight, self.size) - np.bincount(minus, weight, self.size)


def maximise(problem: Likelihood, steps: int = 100) -> np.ndarray:
    """Return the maximum by Newton's method from even odds, halving each step until the objective does not fall.

    It is Fisher scoring here, since Davidson's model is an exponential family. Without a maximum it ends far out, where
    the information vanishes (`matchmaking.ratings.undefeated` looks for that), or raises NotConverged.
    """
    x, decrement = np.zeros(problem.size + 2), math.inf
    value, terms = problem.evaluate(x)
    for _ in range(steps):
        gradient = problem.gradient(x, terms)
        try:
            step = problem.solve(x, terms, gradient)
        except (np.linalg.LinAlgError, SolverNotConverged) as error:
            raise NotConverged(x, str(error)) from error
        decrement, floor = gradient @ step, value - 1e-12 * abs(value)
        while (trial := problem.evaluate(x + step))[0] < floor:
            step = step / 2
        x, (value, terms) = x + step, trial
        if decrement < 1e-16 * (1 + abs(value)) or np.abs(step).max() < 1e-10:
            return x
    # Next to millions of games on one side, rounding keeps parameters of a few games from coming closer: √decrement
    # is the distance to the maximum in standard errors.
    if decrement < 1e-6:
        return x
    raise NotConverged(x, f"{steps} Newton steps were not enough")


def _is_potential(size: int, home: np.ndarray, away: np.ndarray) -> bool:
    """Return True if numbers exist that are 1 larger at home than away, for all the directed pairs."""
    if np.isin(home * size + away, away * size + home).any():
        return False
    neighbours: list[list[tuple[int, int]]] = [[] for _ in range(size)]
    for i, j in zip(home.tolist(), away.tolist(), strict=True):
        neighbours[i].append((j, -1))
        neighbours[j].append((i, 1))
    level: dict[int, int] = {}
    for start in range(size):
        waiting = [] if start in level else [start]
        level.setdefault(start, 0)
        while waiting:
            i = waiting.pop()
            for j, step in neighbours[i]:
                if j not in level:
                    level[j] = level[i] + step
                    waiting.append(j)
                elif level[j] != level[i] + step:
                    return False
    return True
