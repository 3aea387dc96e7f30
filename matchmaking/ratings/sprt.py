"""Sequential probability ratio test on seed pairs: which policy is better, decided as early as two error rates allow.

Wald (1945) compares two simple hypotheses by the ratio of their likelihoods and stops at the first of two bounds. Here
the hypotheses are composite, "A is elo0 (elo1) better than B, whatever the share of each result": their likelihoods are
those of the distribution that fits best under each, a generalised SPRT (Li, Liu, Ying 2016). The observations are seed
pairs with five results (pentanomial), because the two games of a pair start alike and are not independent. As in
Fishtest: Van den Bergh, "The generalized maximum likelihood ratio for the expectation value of a multinomial
distribution" (logistic Elo) and "Normalized Elo: theory and practice" (normalised Elo), both linked in Fishtest's
documentation.

A result that never occurred counts as 0.001 pairs, as in Fishtest, so that nothing is impossible under either
hypothesis, even if all pairs are alike. Without any pair the ratio is 1 and its logarithm 0.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np

from matchmaking.ratings.scores import PAIR_SCORES, score_interval

Model = Literal["logistic", "normalized"]
Decision = Literal["accept", "reject", "continue"]

NEVER = 1e-3  # pairs, instead of none
NORMALIZED = 800 / math.log(10)
"""Normalised Elo of a game whose mean score lies one of its standard deviations above ½."""
_GRID = 128  # values of a second moment at which a likelihood is evaluated, in each refinement


class SprtResult(NamedTuple):
    """State of a test: log-likelihood ratio, its bounds, the decision, and the measured difference."""

    llr: float
    lower: float
    upper: float
    decision: Decision
    elo: float  # logistic; nan without a pair, infinite if A won or lost every game
    low: float  # 95 % interval of it, from the score's: see scores.score_interval
    high: float

    def for_json(self) -> dict[str, float | str | None]:
        """Return the fields; None where the counts determine nothing, or the difference is unbounded."""
        return {k: v if isinstance(v, str) or math.isfinite(v) else None for k, v in self._asdict().items()}


@dataclass(frozen=True)
class SequentialTest:
    """Test of elo0 (the null hypothesis) against elo1 > elo0, with the error rates alpha and beta.

    `accept` means that A is better: the hypothesis elo1 is accepted, wrongly in at most about `alpha` of all tests in
    which elo0 is true. `reject` means that elo0 is accepted, wrongly in at most about `beta` of those in which elo1 is
    true. Both hold for a look after every pair; less frequent looks, or looks after whole batches, err less and need
    more games.
    """

    elo0: float = 0.0
    elo1: float = 20.0
    alpha: float = 0.05
    beta: float = 0.05
    model: Model = "logistic"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.elo0) and self.elo1 > self.elo0 and math.isfinite(self.elo1)):
            raise ValueError(f"elo1: must be above elo0, which is {self.elo0:g}")
        for name in ("alpha", "beta"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"{name}: must be between 0 and 1, e.g. 0.05")
        if self.alpha + self.beta >= 1:
            raise ValueError(f"beta: must be below 1 - alpha, {1 - self.alpha:g}, or the test decides nothing")
        if self.model not in get_args(Model):
            raise ValueError(f"model: must be one of {', '.join(get_args(Model))}")

    @property
    def lower(self) -> float:
        """Log-likelihood ratio at which elo0 is accepted: log(β / (1 - α))."""
        return math.log(self.beta / (1 - self.alpha))

    @property
    def upper(self) -> float:
        """Log-likelihood ratio at which elo1 is accepted: log((1 - β) / α)."""
        return math.log((1 - self.beta) / self.alpha)

    def llr(self, pairs: Sequence[int] | np.ndarray) -> np.ndarray:
        """Return log-likelihood ratios (...) of elo1 to elo0 for pair counts (..., 5): LL, LD, DD or WL, DW, WW.

        Raises ValueError for counts that are negative or not five.
        """
        counts = np.asarray(pairs, float)
        if counts.shape[-1:] != (5,) or not np.all(counts >= 0):
            raise ValueError("pentanomial: must be five counts, 0 or more each: LL LD DD DW WW")
        played = counts.sum(-1) > 0
        counts = np.where(counts > 0, counts, NEVER)
        highest = _log_likelihood_logistic if self.model == "logistic" else _log_likelihood_normalized
        ratio = highest(counts, self.elo1) - highest(counts, self.elo0)
        return np.where(played, ratio, 0.0)

    def result(self, pairs: Sequence[int]) -> SprtResult:
        """Return the state of the test after these pairs. Raises ValueError as `llr` does."""
        llr = float(self.llr(pairs))
        decision: Decision = "accept" if llr >= self.upper else "reject" if llr <= self.lower else "continue"
        return SprtResult(llr, self.lower, self.upper, decision, *measured_elo(pairs))


def measured_elo(pairs: Sequence[int]) -> tuple[float, float, float]:
    """Return logistic Elo from the mean score of seed pairs (5,), and its 95 % interval.

    Without any pair the Elo is nan and the interval infinite.
    """
    counts = np.asarray(pairs, float)
    games = 2 * counts.sum()
    points = 2 * float(counts @ PAIR_SCORES)
    low, high = score_interval(points, 0, games - points, counts)
    return (
        elo_from_score(points / games if games else math.nan),
        elo_from_score(float(low)),
        elo_from_score(float(high)),
    )


def elo_from_score(score: float) -> float:
    """Return the difference in logistic Elo at which this mean score is expected; infinite for 0 and 1."""
    if score in (0.0, 1.0):
        return math.copysign(math.inf, score - 0.5)
    return 400 * math.log10(score / (1 - score))


def score_from_elo(elo: float) -> float:
    """Return the mean score expected at this difference in logistic Elo."""
    return 1 / (1 + 10 ** (-elo / 400))


def _log_likelihood_logistic(counts: np.ndarray, elo: float) -> np.ndarray:
    """Return the highest log-likelihood (...) of counts (..., 5) at this logistic Elo, minus that of observed shares.

    Counts are positive. The likeliest p with mean s is p̂ / (1 + x (a - s)) with a the scores, where x makes the mean
    right (Van den Bergh, proposition 1.1).
    """
    return -_cost(counts, PAIR_SCORES - score_from_elo(elo))


def _log_likelihood_normalized(counts: np.ndarray, elo: float) -> np.ndarray:
    """Return the highest log-likelihood (...) of counts (..., 5) at this normalised Elo, minus that of observed shares.

    Normalised Elo: mean - ½ = t σ, with σ the deviation of a pair's mean score. With the moments m and M of the scores
    about ½ that is m = τ √M, τ = t / √(1 + t²); and for τ > 0, since √M = min over c of (M + c²) / 2c, it is the edge
    of the region where the linear g(c) = m - τ (M + c²) / 2c is positive for some c. If the observed shares lie in that
    region, the others are an intersection of half-spaces, and the likeliest p has the smallest of the likelihoods at
    g(c) = 0; if they lie outside, the largest.
    """
    t = math.sqrt(2) * elo / NORMALIZED  # a pair's mean has half the variance of a game's score
    if t < 0:
        return _log_likelihood_normalized(counts[..., ::-1], -elo)
    b = PAIR_SCORES - 0.5
    if t == 0:
        return -_cost(counts, b)
    tau = t / math.sqrt(1 + t * t)
    shares = counts / counts.sum(-1, keepdims=True)
    inside = shares @ b > tau * np.sqrt(shares @ b**2)
    sign = np.where(inside, 1.0, -1.0)  # the cost is to be maximal inside, minimal outside

    def cost(c: np.ndarray) -> np.ndarray:
        c = c[..., None]
        d = b - tau * (b**2 + c**2) / (2 * c)
        free = inside[..., None] & ((shares[..., None, :] * d).sum(-1) <= 0)  # the observed shares lie in it
        return sign[..., None] * np.where(free, 0.0, _cost(counts[..., None, :], d))

    low, high = np.log(np.full(counts.shape[:-1], 1e-5)), np.log(np.full(counts.shape[:-1], 0.5))
    found = np.full(counts.shape[:-1], -math.inf)
    for _ in range(4):  # each refinement is 60 times finer
        at = np.linspace(low, high, _GRID, axis=-1)
        seen = cost(np.exp(at))
        best = seen.argmax(-1)
        found = np.maximum(found, np.take_along_axis(seen, best[..., None], -1)[..., 0])
        step = (high - low) / (_GRID - 1)
        middle = low + best * step
        low, high = np.maximum(low, middle - step), np.minimum(high, middle + step)
    return -sign * found


def _cost(counts: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return the loss (...) of log-likelihood of positive counts (..., k) by the constraint Σ p d = 0, d (..., k).

    Σ n log(p̂ / p) at the likeliest p, p̂ / (1 + x d): x solves Σ p̂ d / (1 + x d) = 0, which falls with x between -1 /
    max d and -1 / min d. Infinite if all d are of one sign.
    """
    possible = (d.min(-1) < 0) & (d.max(-1) > 0)
    d = np.where(possible[..., None], d, np.linspace(-1, 1, d.shape[-1]))
    counts, d = np.broadcast_arrays(counts, d)
    low, high = -1 / d.max(-1), -1 / d.min(-1)
    for _ in range(64):
        x = (low + high) / 2
        rising = (counts * d / (1 + x[..., None] * d)).sum(-1) > 0
        low, high = np.where(rising, x, low), np.where(rising, high, x)
    x = ((low + high) / 2)[..., None]
    return np.where(possible, (counts * np.log1p(x * d)).sum(-1), math.inf)
