"""Ratings: one fit of all matches on the Elo scale, with intervals. Pure functions of a Payoff.

Below P is the number of snapshots, D the number of (home, away) pairs that met, home being the one that played team 0.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from matchmaking.payoff import Payoff, quantile

ELO = 400 / math.log(10)  # Elo points per unit of log odds: 400 points are odds of 10 wins to 1 loss
TIE = 0.01  # virtual games against the average, as a share of `prior`: holds together what never met
DISPERSION_PRIOR = 2.0  # virtual variance, as of four decisive seed pairs between equals, with the pooled dispersion


@dataclass(frozen=True, eq=False)
class Ratings:
    """What the fit says of P snapshots, in the order of the payoff."""

    names: tuple[str, ...]  # (P,) of snapshots
    elo: np.ndarray  # (P,)
    low: np.ndarray  # (P,) interval of the difference to the anchors' mean, put at anchor_elo
    high: np.ndarray  # (P,)
    games: np.ndarray  # (P,) valid games
    score: np.ndarray  # (P,) mean score over those games, nan without any
    draw: float  # Davidson's ν: draws per √(win · loss); between equals a game is drawn with chance ν/(2+ν)
    side_advantage: float  # of playing team 0, in Elo
    covariance: np.ndarray  # (P, P) in Elo², of the differences to the anchors' mean

    def index(self, name: str) -> int:
        """Position of a snapshot; ValueError if it was not rated."""
        if name not in self.names:
            raise ValueError(f"snapshot {name!r} is not among the {len(self.names)} that are rated; see Ratings.names")
        return self.names.index(name)

    def expected(self, a: str, b: str) -> float:
        """Expected score of a against b, sides swapped halfway; in [0, 1]."""
        return float(self._expected(self.elo[self.index(a)] - self.elo[self.index(b)]))

    def expected_scores(self) -> np.ndarray:
        """(P, P) expected score of i against j, sides swapped halfway."""
        return self._expected(self.elo[:, None] - self.elo)

    def variances(self) -> np.ndarray:
        """(P, P) variance of the difference between i and j, in Elo²."""
        own = np.diag(self.covariance)
        return np.maximum(own[:, None] + own - 2 * self.covariance, 0)

    def likelihood_of_superiority(self, a: str, b: str) -> float:
        """Probability that a is stronger than b, by the normal law of their difference; ½ for a against itself."""
        i, j = self.index(a), self.index(b)
        deviation = math.sqrt(self.variances()[i, j])
        return 0.5 * (1 + math.erf((self.elo[i] - self.elo[j]) / (deviation * math.sqrt(2)))) if deviation else 0.5

    def first_side(self) -> float:
        """Expected score of whoever plays team 0 against an equal; in [0, 1]."""
        return float(self._on_side(np.zeros(()), self.side_advantage))

    def _expected(self, gap: np.ndarray) -> np.ndarray:
        return (self._on_side(gap, self.side_advantage) + self._on_side(gap, -self.side_advantage)) / 2

    def _on_side(self, gap: np.ndarray, side: float) -> np.ndarray:
        return davidson((gap + side) / ELO, math.log(self.draw) if self.draw else -math.inf).score


def fit(
    payoff: Payoff,
    *,
    prior: float = 1.0,
    anchors: Sequence[str] = (),
    anchor_elo: float = 1000.0,
    confidence: float = 0.95,
) -> Ratings:
    """Batch Bradley-Terry ratings with draws and one side advantage: the maximum of a penalised likelihood.

    Draws are Davidson's (1970): with d = θ_home - θ_away + γ, win : draw : loss = exp(d/2) : ν : exp(-d/2). One ν and
    one γ, the side advantage (Davidson and Beaver 1977), are shared by all. γ is fitted only where some two snapshots
    met both ways round; else it cannot be told from strength and stays 0. ν is 0 where nothing was ever drawn.

    The prior is `prior` virtual games per snapshot, half won and half lost, spread over the opponents it really met in
    proportion to games: two snapshots that met nobody else get `prior` virtual games, which for prior = 1 is Jeffreys'
    rule of adding half a win and half a loss. It keeps the unbeaten finite without squeezing a long ladder together,
    as games against the average would. A further 1% of `prior` is played against the average (and, for γ and ν, for no
    side and for as many draws as not), so that what never met is finite too, with an interval that says so.

    Newton's method is Fisher scoring here, since Davidson's model is an exponential family, and the objective is
    concave. The interval is normal, from the covariance H⁻¹ B H⁻¹ (Huber 1967, White 1982): H is the information, B
    counts each pair's information times the dispersion of its seed pairs, see `_dispersion`.

    Args:
        payoff: who beat whom.
        prior: virtual games per snapshot, above 0.
        anchors: names of snapshots whose mean is put at `anchor_elo`; all snapshots if empty.
        anchor_elo: where the scale is pinned.
        confidence: of the intervals, between 0 and 1.

    Raises:
        ValueError: prior not above 0, an anchor that is not in the payoff, confidence outside (0, 1).
    """
    if not prior > 0:
        raise ValueError(f"prior is {prior}; it must be above 0, or the unbeaten would be infinitely strong")
    P = len(payoff.names)
    anchor = np.bincount([payoff.index(name) for name in set(anchors or payoff.names)], minlength=P).astype(float)
    anchor /= max(anchor.sum(), 1)

    problem = _problem(payoff, prior)
    x = _maximise(problem)
    terms = davidson(*problem.linear(x))
    H = problem.information(x, terms)
    B = problem.information(x, terms, _dispersion(payoff, terms))
    gauge = np.zeros((P, P + 2))  # parameters -> differences to the anchors' mean
    gauge[:, :P] = np.eye(P) - anchor
    influence = np.linalg.solve(H, gauge.T)
    covariance = ELO**2 * influence.T @ B @ influence
    elo = anchor_elo + ELO * (x[:P] - anchor @ x[:P])
    half = quantile(confidence) * np.sqrt(np.diag(covariance))
    games = payoff.games.sum(1)
    with np.errstate(invalid="ignore"):
        score = (payoff.wins + payoff.draws / 2).sum(1) / games
    draw = float(np.exp(x[P + 1])) if problem.free[P + 1] else 0.0
    return Ratings(payoff.names, elo, elo - half, elo + half, games, score, draw, float(ELO * x[P]), covariance)


class Outcome(NamedTuple):
    """Davidson's model at some strength differences: chances and second moments of one game, arrays alike in shape."""

    log_likelihood: np.ndarray  # (3, ...) of a win, a draw, a loss
    score: np.ndarray  # expected score
    draw: np.ndarray  # chance of a draw
    score_variance: np.ndarray
    covariance: np.ndarray  # of the score with a draw's indicator
    draw_variance: np.ndarray


def davidson(d: np.ndarray, log_nu: float) -> Outcome:
    """Win, draw, loss as exp(d/2) : ν : exp(-d/2) (Davidson 1970), d in log odds; log_nu is -inf for no draws."""
    logits = np.stack([d / 2, np.full_like(d, log_nu), -d / 2])
    top = logits.max(0)
    log_p = logits - (top + np.log(np.exp(logits - top).sum(0)))
    win, draw, loss = np.exp(log_p)
    # Written without differences of nearly equal numbers, so that certain results keep a positive variance.
    variance = win * loss + draw * (win + loss) / 4
    return Outcome(log_p, win + draw / 2, draw, variance, draw * (loss - win) / 2, draw * (win + loss))


@dataclass(frozen=True, eq=False)
class _Problem:
    """The penalised likelihood; parameters are θ (P), γ and log ν, of which `free` are fitted."""

    size: int
    home: np.ndarray  # (D,) index of the one that played team 0
    away: np.ndarray  # (D,)
    counts: np.ndarray  # (D, 3) wins, draws, losses of home
    virtual: np.ndarray  # (D,) virtual games of the prior, half won and half lost, that know neither sides nor draws
    tie: float  # virtual games of each parameter alone, at even odds
    free: np.ndarray  # (P + 2,) bool

    def linear(self, x: np.ndarray) -> tuple[np.ndarray, float]:
        """Strength differences d (D,) with the side advantage, and log ν."""
        P = self.size
        return x[self.home] - x[self.away] + x[P], float(x[P + 1]) if self.free[P + 1] else -math.inf

    def evaluate(self, x: np.ndarray) -> tuple[float, Outcome]:
        """Log-likelihood of the games and of the virtual games, and the model at x."""
        terms, seen = davidson(*self.linear(x)), self.counts.T > 0
        games = (self.counts.T[seen] * terms.log_likelihood[seen]).sum()
        gaps = x[self.home] - x[self.away]
        return float(games + self.virtual @ _even_log(gaps) + self.tie * _even_log(self._ties(x)).sum()), terms

    def gradient(self, x: np.ndarray, terms: Outcome) -> np.ndarray:
        """(P + 2,) derivative of the objective: score minus expected score, draws minus expected draws."""
        P, n = self.size, self.counts.sum(1)
        residual = self.counts[:, 0] + self.counts[:, 1] / 2 - n * terms.score
        pull = residual - self.virtual * np.tanh((x[self.home] - x[self.away]) / 2) / 2
        gradient = np.zeros(P + 2)
        gradient[:P] = np.bincount(self.home, pull, P) - np.bincount(self.away, pull, P)
        gradient[P:] = residual.sum(), (self.counts[:, 1] - n * terms.draw).sum()
        return np.where(self.free, gradient - self.tie * np.tanh(self._ties(x) / 2) / 2, 0)

    def information(self, x: np.ndarray, terms: Outcome, dispersion: np.ndarray | None = None) -> np.ndarray:
        """(P + 2, P + 2) Fisher information; each pair's games times `dispersion` (D,) if given, the prior's once."""
        P, n = self.size, self.counts.sum(1) * (1 if dispersion is None else dispersion)
        strength, mixed = n * terms.score_variance, n * terms.covariance
        both = strength + self.virtual * _even_variance(x[self.home] - x[self.away])
        H = np.zeros((P + 2, P + 2))
        H[:P, :P] -= np.bincount(self.home * P + self.away, both, P * P).reshape(P, P)
        H[:P, :P] += H[:P, :P].T
        for column, weight in ((P, strength), (P + 1, mixed)):
            H[:P, column] = np.bincount(self.home, weight, P) - np.bincount(self.away, weight, P)
        H[P:, :P] = H[:P, P:].T
        H[P:, P:] = [[strength.sum(), mixed.sum()], [mixed.sum(), (n * terms.draw_variance).sum()]]
        H[np.outer(~self.free, self.free) | np.outer(self.free, ~self.free)] = 0
        diagonal = np.bincount(self.home, both, P) + np.bincount(self.away, both, P)
        H[np.diag_indices(P + 2)] += np.append(diagonal, [0, 0]) + self.tie * _even_variance(self._ties(x))
        return H

    def _ties(self, x: np.ndarray) -> np.ndarray:
        """Each parameter's distance from even odds; draws are even with not drawing at ν = 2 (chance ν/(2+ν))."""
        return x - np.append(np.zeros(self.size + 1), math.log(2))


def _problem(payoff: Payoff, prior: float) -> _Problem:
    """Directed counts of a payoff, with its virtual games."""
    P = len(payoff.names)
    home = np.concatenate([payoff.first, payoff.second])
    away = np.concatenate([payoff.second, payoff.first])
    counts = np.concatenate([payoff.home, payoff.away[:, ::-1]]).astype(float)
    n = counts.sum(1)
    of = np.maximum(np.bincount(home, n, P) + np.bincount(away, n, P), 1)
    both_ways = (payoff.home.sum(1) > 0) & (payoff.away.sum(1) > 0)
    free = np.append(np.ones(P, bool), [both_ways.any(), counts[:, 1].any()])
    return _Problem(P, home, away, counts, prior / 2 * (n / of[home] + n / of[away]), prior * TIE, free)


def _maximise(problem: _Problem, steps: int = 200) -> np.ndarray:
    """Newton's method from even odds, each step halved until the concave objective does not fall."""
    x = np.zeros(problem.size + 2)
    value, terms = problem.evaluate(x)
    for _ in range(steps):
        gradient = problem.gradient(x, terms)
        step = np.linalg.solve(problem.information(x, terms), gradient)
        decrement, floor = gradient @ step, value - 1e-12 * abs(value)
        while (trial := problem.evaluate(x + step))[0] < floor:
            step = step / 2
        x, (value, terms) = x + step, trial
        if decrement < 1e-16 * (1 + abs(value)) or np.abs(step).max() < 1e-10:
            return x
    raise ArithmeticError(f"the ratings' fit did not converge in {steps} Newton steps, though its objective is concave")


def _dispersion(payoff: Payoff, terms: Outcome) -> np.ndarray:
    """(D,) How much more (or less) than independent games a pair's games say about strength.

    The two games of a seed pair share a start, so their scores are correlated. The residual of a pair's score S is
    S - E S; its mean square over the seed pairs of two snapshots, divided by the model's variance, is their dispersion
    (as in quasi-likelihood, McCullagh and Nelder 1989, section 4.5). Few seed pairs, or pairs whose end was certain,
    say little of it: it is shrunk to the dispersion pooled over the whole payoff, which is shrunk to 1 alike. Games
    outside seed pairs have dispersion 1.
    """
    E = len(payoff.first)
    mean = terms.score[:E] + 1 - terms.score[E:]  # of first's score in a seed pair
    variance = payoff.pairs.sum(1) * (terms.score_variance[:E] + terms.score_variance[E:])
    square = (payoff.pairs * (np.arange(5) / 2 - mean[:, None]) ** 2).sum(1)
    pooled = (square.sum() + DISPERSION_PRIOR) / (variance.sum() + DISPERSION_PRIOR)
    per_pair = (square + DISPERSION_PRIOR * pooled) / (variance + DISPERSION_PRIOR)
    n = np.concatenate([payoff.home.sum(1), payoff.away.sum(1)])
    share = np.tile(payoff.pairs.sum(1), 2) / np.maximum(n, 1)
    return 1 + share * (np.tile(per_pair, 2) - 1)


def _even_log(gap: np.ndarray) -> np.ndarray:
    """Log-likelihood of half a game won and half a game lost at log odds `gap`: ½ log σ(gap) + ½ log σ(-gap)."""
    return -np.abs(gap) / 2 - np.log1p(np.exp(-np.abs(gap)))


def _even_variance(gap: np.ndarray) -> np.ndarray:
    """σ(gap) σ(-gap), the information in one virtual game."""
    return 0.25 / np.cosh(np.clip(gap / 2, -300, 300)) ** 2
