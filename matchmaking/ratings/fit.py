"""Ratings: one fit of all matches on the Elo scale, with intervals. Pure functions of a Payoff.

Below P is the number of snapshots, G the number of populations, D the number of (home, away) pairs that met, where home
played team 0.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from matchmaking.ratings.davidson import Likelihood, expected_score
from matchmaking.ratings.likelihoods import priors, undefeated
from matchmaking.ratings.likelihoods.covariance import StrengthCovariance
from matchmaking.ratings.likelihoods.dispersion import Clusters, of_pairs, of_rankings
from matchmaking.ratings.likelihoods.penalised import PenalisedLikelihood, maximise
from matchmaking.ratings.likelihoods.priors import Prior
from matchmaking.ratings.payoff import Payoff
from matchmaking.ratings.plackett_luce import PlackettLuce
from matchmaking.ratings.scores import quantile

ELO = 400 / math.log(10)  # Elo points per unit of log odds: 400 points are odds of 10 wins to 1 loss


@dataclass(frozen=True, eq=False)
class Ratings:
    """Ratings of P snapshots, in the order of the payoff.

    Elo counts from the anchors of a snapshot's own population. Populations whose snapshots never meet their own kind,
    such as the teams of an arena with different rosters, stand side by side: the offset is the difference between them.
    """

    names: tuple[str, ...]  # (P,) of snapshots
    elo: np.ndarray  # (P,)
    games: np.ndarray  # (P,) valid episodes
    score: np.ndarray  # (P,) mean score over their games, of which a ranking has one with each other team; nan if none
    draw: float  # Davidson's ν: draws per √(win · loss); equals draw a game with probability ν/(2+ν)
    side_advantage: float  # of playing team 0, in Elo; 0 if it cannot be separated from strength
    side_identifiable: bool  # it can be separated from strength
    strength_covariance: (
        StrengthCovariance  # covariances, of the differences to the mean of all anchors, in (log odds)⁻²
    )
    log_likelihood: float  # of the games alone, in nats
    populations: tuple[str, ...]  # (G,)
    population: np.ndarray  # (P,) int: index of a snapshot's population
    anchors: np.ndarray  # (G, P) weights whose sums are 1
    population_offsets: np.ndarray  # (G,) Elo of a population's anchors above the mean of all anchors
    quantile: float  # of the normal distribution, for the intervals
    ties: Mapping[int, float] = field(default_factory=dict)  # of rankings: number of tied players -> δ; `draw` is δ_2

    def index(self, name: str) -> int:
        """Return the position of a snapshot; ValueError if it was not rated."""
        if name not in self._positions:
            raise ValueError(f"snapshot {name!r} is not among the {len(self.names)} that are rated; see Ratings.names")
        return self._positions[name]

    def expected(self, a: str, b: str) -> float:
        """Return the expected score of a against b, averaged over sides; in [0, 1]."""
        return float(self._expected(self.strength[self.index(a)] - self.strength[self.index(b)]))

    @cached_property
    def stderr(self) -> np.ndarray:
        """Standard error (P,) of the difference to the anchors' mean; above 2,000 snapshots estimated, to about 2 %."""
        return ELO * np.sqrt(self.strength_covariance.variances(self.population, self.anchors))

    @property
    def low(self) -> np.ndarray:
        """Lower end (P,) of the interval of that difference, placed where the anchors are."""
        return self.elo - self.quantile * self.stderr

    @property
    def high(self) -> np.ndarray:
        """Upper end (P,) of that interval."""
        return self.elo + self.quantile * self.stderr

    @cached_property
    def side_stderr(self) -> float:
        """Standard error of the side advantage; nan if that cannot be separated from strength."""
        return ELO * math.sqrt(self.strength_covariance.side()) if self.side_identifiable else math.nan

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (P, P) in Elo² of differences to the mean of all anchors; too large for many thousands."""
        return ELO**2 * self.strength_covariance.whole[: len(self.names), : len(self.names)]

    def covariances_with_gaps(
        self, ahead: Sequence[int], behind: Sequence[int], close: float | None = None
    ) -> np.ndarray:
        """Return differences (P, K) of columns of `covariance`: of each gap's snapshot ahead and the one behind it.

        For more than 2,000 snapshots they have a relative error of about `close`, by default one that is negligible.
        """
        return ELO**2 * self.strength_covariance.with_gaps(np.asarray(ahead, int), np.asarray(behind, int), close)

    def covariances_of(self, places: Sequence[int] | np.ndarray) -> np.ndarray:
        """Return the part (K, K) of `covariance` of some snapshots, by their indices."""
        return ELO**2 * self.strength_covariance.block(np.asarray(places, int))

    def expected_between(self, places: np.ndarray) -> np.ndarray:
        """Return the part (K, K) of `expected_scores` of some snapshots, by their indices."""
        strength = self.strength[places]
        return self._expected(strength[:, None] - strength)

    def expected_from(self, i: int) -> np.ndarray:
        """Return the expected score (P,) of i against each, averaged over sides."""
        return self._expected(self.strength[i] - self.strength)

    def expected_scores(self) -> np.ndarray:
        """Return the expected score (P, P) of i against j, averaged over sides."""
        first = self._on_side(self.strength[:, None] - self.strength, self.side_advantage)
        return (first + 1 - first.T) / 2

    def variances(self) -> np.ndarray:
        """Return the variance (P, P) of the difference in strength between i and j, in Elo²."""
        own = np.diag(self.covariance)
        return np.maximum(own[:, None] + own - 2 * self.covariance, 0)

    def variance_of_gap(self, i: int, j: int) -> float:
        """Return the variance of the difference in strength between i and j, in Elo²; 0 for i = j."""
        weights = np.zeros(len(self.names))
        weights[i] += 1
        weights[j] -= 1
        return ELO**2 * self.strength_covariance.of_sum(weights) if i != j else 0.0

    def likelihood_of_superiority(self, a: str, b: str) -> float:
        """Return the probability that a is stronger than b, by the normal distribution of the gap; ½ for a = b."""
        i, j = self.index(a), self.index(b)
        deviation = math.sqrt(self.variance_of_gap(i, j))
        gap = self.strength[i] - self.strength[j]
        return 0.5 * (1 + math.erf(gap / (deviation * math.sqrt(2)))) if deviation else 0.5

    def population_offset(self, one: str, other: str) -> tuple[float, float]:
        """Return how much stronger one population's anchors are than another's, in Elo, and its standard error."""
        g, h = self.populations.index(one), self.populations.index(other)
        contrast = self.anchors[g] - self.anchors[h]
        return float(self.population_offsets[g] - self.population_offsets[h]), ELO * math.sqrt(
            self.strength_covariance.of_sum(contrast)
        )

    def first_side_score(self) -> float:
        """Return the expected score of team 0 between equals; in [0, 1]."""
        return float(self._on_side(np.zeros(()), self.side_advantage))

    @cached_property
    def strength(self) -> np.ndarray:
        """Elo (P,) on one scale for all populations, by which snapshots of different ones are compared."""
        return self.elo + self.population_offsets[self.population] if len(self.populations) > 1 else self.elo

    @cached_property
    def _positions(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.names)}

    def _expected(self, gap: np.ndarray) -> np.ndarray:
        first = self._on_side(gap, self.side_advantage)  # as team 0, and below as team 1
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
    """Return batch Bradley-Terry ratings with draws and one side advantage: the maximum of a penalised likelihood.

    Draws are Davidson's (1970): with d = θ_home - θ_away + γ, win : draw : loss = exp(d/2) : ν : exp(-d/2). One ν and
    one γ, the side advantage (Davidson and Beaver 1977), are shared by all. γ is fitted only if it can be separated
    from strength (two snapshots met both ways round, or a cycle of games does not come out even); otherwise it stays 0.
    ν is 0 if nothing was ever drawn. Rankings are fitted by Plackett and Luce's model with ties and without γ, which is
    the same for two players (`matchmaking.ratings.plackett_luce`).

    The objective is concave. The interval is normal, from the covariance H⁻¹ B H⁻¹ (Huber 1967, White 1982): H is the
    information, B counts the information of each pair, or of each lineup of more, times the dispersion of its seed
    clusters, see `matchmaking.ratings.likelihoods.dispersion`.

    Args:
        payoff: counts of all games.
        prior: see matchmaking.ratings.likelihoods.priors; a number is that of virtual games with the `opponents`,
            0 is no prior.
        anchors: names of snapshots whose mean is placed at `anchor_elo`; all that have played if empty.
        anchor_elo: fixed point of the scale.
        populations: snapshot -> population, if snapshots of one population never meet each other. Strength is then
            compared within each, and between them only together with the arena's offset. Each places its own anchors at
            `anchor_elo`, or all of its snapshots that have played if it has none.
        confidence: of the intervals, between 0 and 1.
        sides: fit a side advantage.
        clusters: games of two that share a start; the payoff's seed pairs if None.

    Raises:
        ValueError: a negative prior, an anchor that is not in the payoff, confidence outside (0, 1).
        Unbounded: without a prior, a snapshot whose rating would be infinite.
    """
    z, P = quantile(confidence), len(payoff.names)
    chosen_prior = _prior(payoff, prior)
    labels, population, weights = _anchor_weights(payoff, anchors, populations or {})
    problem = likelihood(payoff, chosen_prior, sides)
    x = maximise(problem) if chosen_prior.any() or not P else undefeated.maximum(problem, payoff)
    terms = problem.terms(x)
    common = weights.mean(0)
    strength_covariance = StrengthCovariance(problem, x, terms, _dispersion(problem, payoff, terms, clusters), common)
    theta = ELO * x[:P]
    means, played = weights @ theta, payoff.played
    with np.errstate(invalid="ignore"):
        score = (payoff.results[:, 0] + payoff.results[:, 1] / 2) / played
    return Ratings(
        payoff.names, anchor_elo + (theta - means[population]), payoff.ranked_or_played, score,
        draw=float(np.exp(x[P + 1])) if problem.free[P + 1] else 0.0,
        side_advantage=float(ELO * x[P]),
        side_identifiable=bool(problem.free[P]),
        strength_covariance=strength_covariance, log_likelihood=problem.of_games(terms),
        populations=labels, population=population, anchors=weights, population_offsets=means - common @ theta,
        quantile=z, ties=problem.ties(x) if isinstance(problem, PlackettLuce) else {},
    )  # fmt: skip


def likelihood(payoff: Payoff, prior: Prior, sides: bool = True) -> PenalisedLikelihood:
    """Return the likelihood of a payoff's rankings, or of its games of two if it has none."""
    if payoff.rankings:
        return PlackettLuce(payoff.rankings, len(payoff.names), prior)
    return Likelihood.of(payoff, prior, sides)


def _dispersion(problem: PenalisedLikelihood, payoff: Payoff, terms: Any, clusters: Clusters | None) -> np.ndarray:
    """Return the dispersion of each ranking, or of the games of each pair."""
    if isinstance(problem, PlackettLuce):
        return of_rankings(problem, terms, payoff.rankings)
    return of_pairs(payoff, terms, Clusters.of(payoff) if clusters is None else clusters)


def _prior(payoff: Payoff, prior: Prior | float) -> Prior:
    """Return the prior that a number of virtual games stands for; ValueError for a negative or infinite number."""
    if isinstance(prior, Prior):
        return prior
    if not 0 <= prior < math.inf:
        raise ValueError(f"prior is {prior}; it must be 0 (none) or a positive number of virtual games")
    return priors.opponents(payoff, prior) if prior else priors.none()


def _anchor_weights(
    payoff: Payoff, anchors: Sequence[str], of: Mapping[str, str]
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Return the populations (G), each snapshot's population (P,), and their anchors' weights (G, P)."""
    labels = tuple(sorted({of.get(name, "") for name in payoff.names})) or ("",)
    population = np.array([labels.index(of.get(name, "")) for name in payoff.names], int)
    own = population == np.arange(len(labels))[:, None]
    pinned = np.zeros(len(payoff.names), bool)
    pinned[[payoff.index(name) for name in anchors]] = True
    played = payoff.played > 0
    for fitting in (own & played, own & pinned):  # the last one with a snapshot of a population counts
        own = np.where(fitting.any(1, keepdims=True), fitting, own)
    return labels, population, own / np.maximum(own.sum(1, keepdims=True), 1)
