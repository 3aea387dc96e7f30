"""Ratings: one fit of all matches on the Elo scale, with intervals. Pure functions of a Payoff.

Below P is the number of snapshots, G that of populations, D the number of (home, away) pairs that met, home being the
one that played team 0.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from matchmaking import bounds, priors
from matchmaking.likelihood import Likelihood, Outcome, davidson, expected_score, maximise
from matchmaking.payoff import PAIR_SCORES, Payoff, quantile
from matchmaking.priors import Prior

ELO = 400 / math.log(10)  # Elo points per unit of log odds: 400 points are odds of 10 wins to 1 loss
DISPERSION_PRIOR = 2.0  # virtual variance, as of four decisive seed pairs between equals, with the pooled dispersion


class Clusters(NamedTuple):
    """Games that share a start, so that their scores are correlated: M kinds of clusters between two snapshots."""

    edge: np.ndarray  # (M,) int: which pair of the payoff
    home: np.ndarray  # (M,) games in which its first played team 0
    away: np.ndarray  # (M,) games in which its second did
    score: np.ndarray  # (M,) of its first, summed over the cluster
    number: np.ndarray  # (M,) clusters of this kind

    @classmethod
    def of(cls, payoff: Payoff) -> "Clusters":
        """The seed pairs of a payoff."""
        edge, score = np.nonzero(payoff.pairs)
        one = np.ones(len(edge))
        return cls(edge, one, one, 2 * PAIR_SCORES[score], payoff.pairs[edge, score].astype(float))


@dataclass(frozen=True, eq=False)
class Ratings:
    """What the fit says of P snapshots, in the order of the payoff.

    Elo counts from the anchors of a snapshot's own population. Populations that never meet within themselves, as the
    teams of an arena with unlike rosters, stand side by side: what differs between them is the tilt.
    """

    names: tuple[str, ...]  # (P,) of snapshots
    elo: np.ndarray  # (P,)
    stderr: np.ndarray  # (P,) of the difference to the anchors' mean
    low: np.ndarray  # (P,) interval of that difference, put at anchor_elo
    high: np.ndarray  # (P,)
    games: np.ndarray  # (P,) valid games
    score: np.ndarray  # (P,) mean score over those games, nan without any
    draw: float  # Davidson's ν: draws per √(win · loss); between equals a game is drawn with chance ν/(2+ν)
    side_advantage: float  # of playing team 0, in Elo; 0 where it cannot be told from strength
    side_stderr: float  # nan where it cannot
    covariance: np.ndarray  # (P, P) in Elo², of the differences to the mean of all anchors
    log_likelihood: float  # of the games alone, in nats
    populations: tuple[str, ...]  # (G,)
    population: np.ndarray  # (P,) int: which of them a snapshot is of
    anchors: np.ndarray  # (G, P) weights whose sums are 1
    tilts: np.ndarray  # (G,) Elo by which a population's anchors are stronger than all anchors' mean

    def index(self, name: str) -> int:
        """Position of a snapshot; ValueError if it was not rated."""
        if name not in self._positions:
            raise ValueError(f"snapshot {name!r} is not among the {len(self.names)} that are rated; see Ratings.names")
        return self._positions[name]

    def expected(self, a: str, b: str) -> float:
        """Expected score of a against b, sides swapped halfway; in [0, 1]."""
        return float(self._expected(self.strength[self.index(a)] - self.strength[self.index(b)]))

    def expected_scores(self) -> np.ndarray:
        """(P, P) expected score of i against j, sides swapped halfway."""
        first = self._on_side(self.strength[:, None] - self.strength, self.side_advantage)
        return (first + 1 - first.T) / 2

    def variances(self) -> np.ndarray:
        """(P, P) variance of the difference in strength between i and j, in Elo²."""
        own = np.diag(self.covariance)
        return np.maximum(own[:, None] + own - 2 * self.covariance, 0)

    def likelihood_of_superiority(self, a: str, b: str) -> float:
        """Probability that a is stronger than b, by the normal law of their difference; ½ for a against itself."""
        i, j = self.index(a), self.index(b)
        deviation = math.sqrt(self.variances()[i, j])
        gap = self.strength[i] - self.strength[j]
        return 0.5 * (1 + math.erf(gap / (deviation * math.sqrt(2)))) if deviation else 0.5

    def tilt(self, one: str, other: str) -> tuple[float, float]:
        """By how much one population's anchors are stronger than another's, in Elo, and the standard error of that."""
        g, h = self.populations.index(one), self.populations.index(other)
        contrast = self.anchors[g] - self.anchors[h]
        return float(self.tilts[g] - self.tilts[h]), math.sqrt(max(contrast @ self.covariance @ contrast, 0))

    def first_side(self) -> float:
        """Expected score of whoever plays team 0 against an equal; in [0, 1]."""
        return float(self._on_side(np.zeros(()), self.side_advantage))

    @cached_property
    def strength(self) -> np.ndarray:
        """(P,) Elo on one scale for all populations, by which those of two of them are compared."""
        return self.elo + self.tilts[self.population] if len(self.populations) > 1 else self.elo

    @cached_property
    def _positions(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.names)}

    def _expected(self, gap: np.ndarray) -> np.ndarray:
        first = self._on_side(gap, self.side_advantage)  # and on the other side what the other one leaves
        return (first + 1 - self._on_side(-gap, self.side_advantage)) / 2

    def _on_side(self, gap: np.ndarray, side: float) -> np.ndarray:
        return expected_score((gap + side) / ELO, self.draw)


def fit(
    payoff: Payoff,
    *,
    prior: Prior | float = 1.0,
    anchors: Sequence[str] = (),
    anchor_elo: float = 1000.0,
    populations: Mapping[str, str] | None = None,
    confidence: float = 0.95,
    sides: bool = True,
    clusters: Clusters | None = None,
) -> Ratings:
    """Batch Bradley-Terry ratings with draws and one side advantage: the maximum of a penalised likelihood.

    Draws are Davidson's (1970): with d = θ_home - θ_away + γ, win : draw : loss = exp(d/2) : ν : exp(-d/2). One ν and
    one γ, the side advantage (Davidson and Beaver 1977), are shared by all. γ is fitted only where it can be told from
    strength (some two met both ways round, or a ring of games does not come out even); else it stays 0. ν is 0 where
    nothing was ever drawn.

    The objective is concave. The interval is normal, from the covariance H⁻¹ B H⁻¹ (Huber 1967, White 1982): H is the
    information, B counts each pair's information times the dispersion of its seed pairs, see `_dispersion`.

    Args:
        payoff: who beat whom.
        prior: see matchmaking.priors; a number is that of virtual games with the `opponents`, 0 is no prior.
        anchors: names of snapshots whose mean is put at `anchor_elo`; all that have played if empty.
        anchor_elo: where the scale is pinned.
        populations: snapshot -> what it is of, where those of one never meet each other, so that strength is compared
            within each and between them only together with the arena's tilt. Each has the anchors that are of it at
            `anchor_elo`, or all of its snapshots that have played if none is.
        confidence: of the intervals, between 0 and 1.
        sides: whether there is a side advantage to fit.
        clusters: games that share a start; the payoff's seed pairs if None.

    Raises:
        ValueError: a negative prior, an anchor that is not in the payoff, confidence outside (0, 1).
        Unbounded: without a prior, somebody whose rating would be infinite.
    """
    z, P = quantile(confidence), len(payoff.names)
    held = _prior(payoff, prior)
    labels, population, weights = _gauge(payoff, anchors, populations or {})
    problem = Likelihood.of(payoff, held, sides)
    x = maximise(problem) if held.any() or not P else bounds.maximum(problem, payoff)
    terms = davidson(*problem.linear(x))
    common = weights.mean(0)
    dispersion = _dispersion(payoff, terms, clusters or Clusters.of(payoff))
    covariance = _covariance(problem, x, terms, dispersion, common)
    theta, shared = ELO * x[:P], covariance[:P, :P]
    means = weights @ theta
    stderr = np.sqrt(_own_variances(shared, population, weights))
    elo = anchor_elo + (theta - means[population])
    games = payoff.games.sum(1)
    with np.errstate(invalid="ignore"):
        score = (payoff.wins + payoff.draws / 2).sum(1) / games
    return Ratings(
        payoff.names, elo, stderr, elo - z * stderr, elo + z * stderr, games, score,
        draw=float(np.exp(x[P + 1])) if problem.free[P + 1] else 0.0,
        side_advantage=float(ELO * x[P]),
        side_stderr=math.sqrt(covariance[P, P]) if problem.free[P] else math.nan,
        covariance=shared, log_likelihood=problem.of_games(terms),
        populations=labels, population=population, anchors=weights, tilts=means - common @ theta,
    )  # fmt: skip


def _prior(payoff: Payoff, prior: Prior | float) -> Prior:
    if isinstance(prior, Prior):
        return prior
    if not 0 <= prior < math.inf:
        raise ValueError(f"prior is {prior}; it must be 0 (none) or a positive number of virtual games")
    return priors.opponents(payoff, prior) if prior else priors.none()


def _gauge(
    payoff: Payoff, anchors: Sequence[str], of: Mapping[str, str]
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """The populations (G), which of them each snapshot is of (P,), and their anchors' weights (G, P)."""
    labels = tuple(sorted({of.get(name, "") for name in payoff.names})) or ("",)
    population = np.array([labels.index(of.get(name, "")) for name in payoff.names], int)
    own = population == np.arange(len(labels))[:, None]
    pinned = np.zeros(len(payoff.names), bool)
    pinned[[payoff.index(name) for name in anchors]] = True
    played = payoff.games.any(1)
    for fitting in (own & played, own & pinned):  # the last that has somebody of a population counts
        own = np.where(fitting.any(1, keepdims=True), fitting, own)
    return labels, population, own / np.maximum(own.sum(1, keepdims=True), 1)


def _covariance(
    problem: Likelihood, x: np.ndarray, terms: Outcome, dispersion: np.ndarray, anchor: np.ndarray
) -> np.ndarray:
    """(P + 2, P + 2) covariance in Elo² of the differences to the anchors' mean, of γ and of log ν."""
    gauge = np.eye(len(x))
    gauge[:-2, :-2] -= anchor
    influence = np.linalg.solve(problem.information(x, terms) + problem.location, gauge.T)
    if (dispersion == 1).all():
        return ELO**2 * gauge @ influence
    return ELO**2 * influence.T @ problem.information(x, terms, dispersion) @ influence


def _own_variances(covariance: np.ndarray, population: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(P,) variances of the differences to the anchors' mean of each snapshot's own population."""
    if len(weights) == 1:
        return np.maximum(covariance.diagonal(), 0)
    blurred = covariance @ weights.T  # (P, G)
    shared = blurred[np.arange(len(population)), population]
    return np.maximum(covariance.diagonal() - 2 * shared + (weights @ blurred).diagonal()[population], 0)


def _dispersion(payoff: Payoff, terms: Outcome, clusters: Clusters) -> np.ndarray:
    """(D,) How much more (or less) than independent games a pair's games say about strength.

    The games of a cluster, such as the two of a seed pair, share a start, so their scores are correlated. The residual
    of a cluster's score S is S - E S; its mean square over the clusters of two snapshots, divided by the model's
    variance, is their dispersion (as in quasi-likelihood, McCullagh and Nelder 1989, section 4.5). Few clusters, or
    ones whose end was certain, say little of it: it is shrunk to the dispersion pooled over the whole payoff, which is
    shrunk to 1 alike. Games outside clusters have dispersion 1.
    """
    E, (edge, home, away, score, number) = len(payoff.first), clusters
    first, second = slice(None, E), slice(E, None)
    mean = home * terms.score[first][edge] + away * (1 - terms.score[second][edge])
    spread = home * terms.score_variance[first][edge] + away * terms.score_variance[second][edge]
    variance = np.bincount(edge, number * spread, E)
    square = np.bincount(edge, number * (score - mean) ** 2, E)
    pooled = (square.sum() + DISPERSION_PRIOR) / (variance.sum() + DISPERSION_PRIOR)
    per_pair = (square + DISPERSION_PRIOR * pooled) / (variance + DISPERSION_PRIOR)
    clustered = np.concatenate([np.bincount(edge, number * n, E) for n in (home, away)])
    share = clustered / np.maximum(np.concatenate([payoff.home.sum(1), payoff.away.sum(1)]), 1)
    return 1 + share * (np.tile(per_pair, 2) - 1)
