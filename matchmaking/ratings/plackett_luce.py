"""Plackett and Luce's model of rankings with ties: its likelihood, which for two players is Davidson's.

For two players the choice of the best is exp(d/2) : δ_2 : exp(-d/2), so ν = δ_2 (Turner, van Etten, Firth and Kosmidis
2020). Rankings have no sides: γ stays 0.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from matchmaking.ratings.likelihoods.choice_sets import ChoiceSets, Values
from matchmaking.ratings.likelihoods.information import MAX_DENSE
from matchmaking.ratings.likelihoods.penalised import Moments, PenalisedLikelihood
from matchmaking.ratings.likelihoods.priors import Prior
from matchmaking.ratings.rankings import MAX_TABLE, Block, Rankings


@dataclass(eq=False)
class RankingTerms:
    """The model at some parameters; derivatives are computed when they are first asked for."""

    values: Sequence[Values]
    theta: np.ndarray  # (P,)
    derivatives: tuple[np.ndarray, Moments] | None = None


class PlackettLuce(PenalisedLikelihood):
    """Penalised likelihood of rankings of P players.

    The parameters are θ (P), γ = 0, log δ_2, and log δ_k of every larger number k of players that were once tied.
    δ_2 is fitted only if two players were tied.
    """

    def __init__(self, rankings: Rankings, size: int, prior: Prior):
        self.size, self.prior = size, prior
        seen = rankings.tie_orders().tolist()
        self.orders = (2, *(k for k in seen if k > 2))
        self.free = np.append(np.ones(size, bool), [False, 2 in seen, *[True] * (len(self.orders) - 1)])
        self._fitted = [place for place, k in enumerate(self.orders) if k in seen]
        self._blocks, self._sizes = rankings.blocks, (1, *seen)
        self._sets = [ChoiceSets(block, self._sizes) for block in rankings.blocks]
        met, self._places = self._pairs_that_met()
        self.home, self.away = np.divmod(met, max(size, 1))

    @property
    def even(self) -> np.ndarray:
        """Even is a tie of all k players that is as likely as a single best one, if they are equals: δ_k = k."""
        return np.array([0.0, *map(math.log, self.orders)])

    @property
    def is_dense(self) -> bool:
        """True where a table of all pairs is solved faster: also where most players have met each other."""
        return super().is_dense or (self.size <= MAX_DENSE and len(self.home) > self.size**2 / 10)

    @property
    def weights(self) -> np.ndarray:
        """Numbers (D,) of games in which each pair met."""
        return self._weights

    @cached_property
    def _weights(self) -> np.ndarray:
        found = np.zeros(len(self.home))
        for of, block in zip(self._places, self._blocks, strict=True):
            found += np.bincount(of.ravel(), np.broadcast_to(block.number, of.shape).ravel(), len(found))
        return found

    def start(self) -> np.ndarray:
        """Return even strengths, and tie terms with which ties are about as frequent as they were.

        Among equals the odds of a tie of k of n players against a single best are δ_k (n over k) / n. With δ_k = 1
        large groups would be so likely that steps from there overshoot.
        """
        x = np.zeros(len(self.free))
        for number, place in enumerate(self._fitted):
            odds = sum(each.tie_odds[number] for each in self._sets)
            x[self.size + 1 + place] = math.log(sum(each.ties[number] for each in self._sets) / odds)
        return x

    def ties(self, x: np.ndarray) -> dict[int, float]:
        """Return δ_k of every number k of players that were once tied."""
        return {self.orders[place]: math.exp(x[self.size + 1 + place]) for place in self._fitted}

    def terms(self, x: np.ndarray) -> RankingTerms:
        """Return the model at parameters (P + T,)."""
        P = self.size
        log_delta = np.append(0.0, x[P + 1 :][self._fitted])
        return RankingTerms([each.evaluate(x[:P], log_delta) for each in self._sets], x[:P])

    def of_games(self, terms: RankingTerms) -> float:
        """Return the log-likelihood of the rankings alone."""
        return float(sum(each.log_likelihood for each in terms.values))

    def slope(self, terms: RankingTerms) -> np.ndarray:
        """Return the derivative (P + T,) of the log-likelihood."""
        return self._derived(terms)[0].copy()

    def moments(self, terms: RankingTerms, dispersion: np.ndarray | None) -> Moments:
        """Return the information of the rankings; each counts times its `dispersion` (R,) if given, block by block."""
        if dispersion is None or (dispersion == 1).all():
            return self._derived(terms)[1]
        ends = np.cumsum([len(block.number) for block in self._blocks])[:-1]
        weights = zip(self._blocks, np.split(dispersion, ends), strict=True)
        dispersed = [ChoiceSets(block._replace(number=block.number * each), self._sizes) for block, each in weights]
        return self._derive(dispersed, terms.values)[1]

    def scores_of(self, terms: RankingTerms, block: Block) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives (R, n) of rankings by their players' strengths, and the weights (R,) of their pairs.

        The weight of a ranking is the sum over its pairs of different players, times its number.
        """
        sets = ChoiceSets(block, self._sizes)
        values = sets.evaluate(terms.theta, terms.values[0].log_delta)
        different = sets.players[sets.ahead] != sets.players[sets.behind]
        found = [(rows, sets.derive(values, rows)) for rows in sets.parts()]
        residual = np.concatenate([each.residual for _, each in found], 1)
        return residual.T, np.concatenate([(different[:, rows] * each.pairs).sum(0) for rows, each in found])

    def _derived(self, terms: RankingTerms) -> tuple[np.ndarray, Moments]:
        if terms.derivatives is None:
            terms.derivatives = self._derive(self._sets, terms.values)
        return terms.derivatives

    def _derive(self, sets: Sequence[ChoiceSets], of: Sequence[Values]) -> tuple[np.ndarray, Moments]:
        """Return the derivative (P + T,) of the log-likelihood, and the information."""
        P, D, T = self.size, len(self.home), len(self.orders) + 1
        tied = [1 + place for place in self._fitted]  # of the shared parameters
        slope, strength = np.zeros(P + T), np.zeros(D)
        shared, block = np.zeros((T, D)), np.zeros((T, T))
        for each, values, places in zip(sets, of, self._places, strict=True):
            slope[[P + place for place in tied]] += each.ties
            for rows in each.parts():
                found, place = each.derive(values, rows), places[:, rows].ravel()
                players = each.players[:, rows]
                slope[:P] += np.bincount(players.ravel(), found.residual.ravel(), P)
                strength += np.bincount(place, found.pairs.ravel(), D)
                turned = np.where(players[each.ahead] < players[each.behind], 1.0, -1.0) if tied else np.zeros(0)
                for column, flow in zip(tied, found.flows, strict=True):
                    shared[column] += np.bincount(place, (turned * flow).ravel(), D)
                slope[[P + place for place in tied]] -= found.ties
                block[np.ix_(tied, tied)] += found.tie_covariance
        return slope, Moments(strength, shared.T, block)

    def _pairs_that_met(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return the pairs that met as ascending numbers (D,), and the place (C, R) in it of each pair of positions."""
        P, keys = self.size, []
        for each in self._sets:
            a, b = each.players[each.ahead], each.players[each.behind]
            keys.append(np.minimum(a, b) * P + np.maximum(a, b))
        if P * P > MAX_TABLE:
            found = np.unique(np.concatenate([np.unique(key) for key in keys])) if keys else np.zeros(0, int)
            return found, [np.searchsorted(found, key).astype(np.int32) for key in keys]
        seen = np.zeros(P * P, bool)
        for key in keys:
            seen[key] = True
        found = np.flatnonzero(seen)
        place = np.zeros(P * P, np.int32)
        place[found] = np.arange(len(found))
        return found, [place[key] for key in keys]


def ranking_chances(strength: Sequence[float], ties: Mapping[int, float]) -> dict[tuple[int, ...], float]:
    """Return the probability of every ranking of a game: the rank of each player, from 1 -> probability.

    For a few players: eight have 545,835 rankings.

    Args:
        strength: log odds θ of each player.
        ties: δ_k of every number k of players that may be tied.
    """
    found: dict[tuple[int, ...], float] = {}

    def choose(left: tuple[int, ...], ranks: dict[int, int], chance: float) -> None:
        if not left:
            found[tuple(ranks[i] for i in range(len(strength)))] = chance
            return
        groups = [group for k in (1, *sorted(ties)) for group in combinations(left, k)]
        top = max(strength[i] for i in left)
        weights = [
            (ties[len(group)] if len(group) > 1 else 1.0)
            * math.exp(sum(strength[i] - top for i in group) / len(group))
            for group in groups
        ]  # fmt: skip
        for group, weight in zip(groups, weights, strict=True):
            rest = tuple(i for i in left if i not in group)
            rank = len(strength) - len(left) + 1
            choose(rest, ranks | dict.fromkeys(group, rank), chance * weight / sum(weights))

    choose(tuple(range(len(strength))), {}, 1.0)
    return found
