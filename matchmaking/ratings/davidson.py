"""Davidson's model of wins, draws and losses: its likelihood over directed counts."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from matchmaking.ratings.likelihoods.penalised import Moments, PenalisedLikelihood
from matchmaking.ratings.likelihoods.priors import Prior
from matchmaking.ratings.payoff import Payoff


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
class Likelihood(PenalisedLikelihood):
    """Penalised likelihood of Davidson's model; parameters are θ (P), γ and log ν, of which `free` are fitted."""

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
        both = (payoff.home.any(1) & payoff.away.any(1)).any()  # as almost always: there is no need to search
        identifiable = sides and bool(both or not _is_potential(P, home[met], away[met]))
        free = np.append(np.ones(P, bool), np.array([identifiable, counts[:, 1].any()], bool))
        return cls(P, home, away, counts, prior, free)

    @property
    def even(self) -> np.ndarray:
        """Even are no side advantage, and as many draws as decided games between equals (ν/(2+ν) = ½)."""
        return np.array([0.0, math.log(2)])

    @property
    def weights(self) -> np.ndarray:
        """Games (D,) of each directed pair."""
        return self._games

    @cached_property
    def _games(self) -> np.ndarray:
        return self.counts.sum(1)

    def terms(self, x: np.ndarray) -> Outcome:
        """Return the model of each directed pair (D,)."""
        P = self.size
        d, log_nu = x[self.home] - x[self.away] + x[P], float(x[P + 1]) if self.free[P + 1] else -math.inf
        return davidson(d, log_nu)

    def of_games(self, terms: Outcome) -> float:
        """Return the log-likelihood of the games alone."""
        seen = self.counts.T > 0
        return float((self.counts.T[seen] * terms.log_likelihood[seen]).sum())

    def slope(self, terms: Outcome) -> np.ndarray:
        """Return the derivative (P + 2,): score minus expected score, draws minus expected draws."""
        residual = self.counts[:, 0] + self.counts[:, 1] / 2 - self.weights * terms.score
        draws = (self.counts[:, 1] - self.weights * terms.draw).sum()
        return np.append(self._signed_sums(self.home, self.away, residual), [residual.sum(), draws])

    def moments(self, terms: Outcome, dispersion: np.ndarray | None) -> Moments:
        """Return for each pair's games the variance of the score, and covariances with γ's statistic and draws."""
        n = self.weights if dispersion is None else self.weights * dispersion
        strength, mixed, drawn = n * terms.score_variance, n * terms.covariance, n * terms.draw_variance
        block = np.array([[strength.sum(), mixed.sum()], [mixed.sum(), drawn.sum()]])
        return Moments(strength, np.stack([strength, mixed], 1), block)


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
