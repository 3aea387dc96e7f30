"""Uncertainty of a fit: covariances of strengths, computed as far as they are requested.

The covariance is the sandwich H⁻¹ B H⁻¹ (Huber 1967, White 1982), with H the information and B the information in which
the games of each pair or lineup are multiplied by their dispersion. For up to `information.MAX_DENSE` snapshots all of
it is computed. For more, a single row is computed exactly, and the variances of all are estimated from random draws.
Below P is the number of snapshots, D the number of (home, away) pairs, T the number of shared parameters (the side
advantage γ, log ν and the logarithms of the other tie terms), G the number of populations.
"""

from functools import cached_property
from typing import Any

import numpy as np

from matchmaking.ratings.likelihoods.information import MAX_DENSE, Information
from matchmaking.ratings.likelihoods.penalised import PenalisedLikelihood

DRAWS = 128
BATCH = 32
CLOSE = 1e-4  # relative error of a draw, far below the sampling error
BLOCK = 1e-6  # relative error of covariances of many at once
WIDE = 20_000_000
"""Maximum number of entries of the sparse product from which a variance's exact part is read."""


class StrengthCovariance:
    """Covariances, in (log odds)⁻², of P strengths minus their anchors' mean, and of T shared parameters."""

    def __init__(
        self, problem: PenalisedLikelihood, x: np.ndarray, terms: Any, dispersion: np.ndarray, anchor: np.ndarray
    ):
        """Prepare for a fit; nothing is computed yet.

        Args:
            problem: the likelihood that was fitted.
            x: (P + T,) position of its maximum.
            terms: the model there.
            dispersion: (D,) of each pair's games, or (R,) of each ranking.
            anchor: (P,) weights of the anchors, whose sum is 1.
        """
        self._problem, self._x, self._terms = problem, x, terms
        self._dispersion, self._anchor = dispersion, anchor

    def with_gaps(self, ahead: np.ndarray, behind: np.ndarray, close: float | None = None) -> np.ndarray:
        """Return covariances (P, K) of all strengths with K gaps, each between a snapshot ahead and one behind (K,).

        `close` is the relative error of the systems that are solved for many snapshots, by default that of `solve`.
        """
        P, gaps = len(self._anchor), np.arange(len(ahead))
        if self._is_small:
            return self.whole[:P, ahead] - self.whole[:P, behind]
        contrasts = np.zeros((len(self._x), len(gaps)))
        contrasts[ahead, gaps] += 1
        contrasts[behind, gaps] -= 1
        solve = self.solve if close is None else self.information.solver(close)
        through = [solve(self.dispersed_information.times(solve(some))) for some in _some(contrasts)]
        found = np.concatenate(through, 1)[:P]
        return found - self._anchor @ found

    def block(self, places: np.ndarray) -> np.ndarray:
        """Return covariances (K, K) of some strengths with each other, by their indices (K,)."""
        if self._is_small:
            return self.whole[np.ix_(places, places)]
        contrasts = np.zeros((len(self._x), len(places)))
        contrasts[: len(self._anchor)] -= self._anchor[:, None]
        contrasts[places, np.arange(len(places))] += 1
        solve = self.information.solver(BLOCK)
        influence = np.concatenate([solve(some) for some in _some(contrasts)], 1)
        dispersed_information = np.concatenate([self.dispersed_information.times(some) for some in _some(influence)], 1)
        return influence.T @ dispersed_information

    def side(self) -> float:
        """Return the variance of the side advantage γ.

        The two games of a seed pair swap sides: with dispersion φ of a player's score that of side A's is 2 - φ, since
        twice the variance of both games is the sum of the two. A start that favours a side makes φ small, so the larger
        of both counts, which is right for games that share a start without swapping sides too.
        """
        unit = np.zeros((len(self._x), 1))
        unit[len(self._anchor)] = 1
        problem, x, terms = self._problem, self._x, self._terms
        dispersion = np.maximum(self._dispersion, 2 - self._dispersion)
        if self._is_small:
            influence = np.linalg.solve(problem.information(x, terms) + problem.location, unit)
            dispersed = problem.information(x, terms, dispersion) @ influence
        else:
            influence = self.solve(unit)
            dispersed = problem.sparse_information(x, terms, dispersion, located=False).times(influence)
        return float(influence[:, 0] @ dispersed[:, 0])

    def of_sum(self, weights: np.ndarray) -> float:
        """Return the variance of a weighted sum of strengths; the weights (P,) sum to 0."""
        if self._is_small:
            found = weights @ self.whole[: len(weights), : len(weights)] @ weights
        else:
            found = weights @ self._times(self._padded(weights))[: len(weights)]
        return max(float(found), 0.0)

    @cached_property
    def whole(self) -> np.ndarray:
        """Full covariance (P + T, P + T); for 10,000 snapshots that takes minutes and several GB."""
        contrasts, influence, dispersed_information = self._influence
        return (contrasts if dispersed_information is influence else influence).T @ dispersed_information

    def variances(self, population: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return variances (P,) of each snapshot's difference to the mean of its own population's anchors.

        Args:
            population: (P,) int, index of each snapshot's population.
            weights: (G, P) of each population's anchors.
        """
        if not self._is_small:
            return np.maximum(_SampledVariances(self, weights).variances(population), 0)
        contrasts, influence, dispersed_information = self._influence
        left = contrasts if dispersed_information is influence else influence
        P = len(population)
        own = np.einsum("ki,ki->i", left, dispersed_information)[:P]
        if len(weights) > 1:
            blurred = (left.T @ (dispersed_information[:, :P] @ weights.T))[:P]  # (P, G)
            shared = blurred[np.arange(len(population)), population]
            own = own - 2 * shared + (weights @ blurred).diagonal()[population]
        return np.maximum(own, 0)

    @property
    def _is_small(self) -> bool:
        return self._problem.size <= MAX_DENSE

    @cached_property
    def _influence(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Contrasts gᵀ, H⁻¹ gᵀ and B H⁻¹ gᵀ, or H⁻¹ gᵀ once more if B is H; each (P + T, P + T)."""
        problem, x, terms = self._problem, self._x, self._terms
        contrasts = np.eye(len(x))
        P = len(self._anchor)
        contrasts[:P, :P] -= self._anchor[:, None]
        influence = np.linalg.solve(problem.information(x, terms) + problem.location, contrasts)
        if (self._dispersion == 1).all():
            return contrasts, influence, influence
        return contrasts, influence, problem.information(x, terms, self._dispersion) @ influence

    # For many snapshots

    @cached_property
    def information(self) -> Information:
        """Information matrix H."""
        return self._problem.sparse_information(self._x, self._terms)

    @cached_property
    def dispersed_information(self) -> Information:
        """Information matrix B."""
        return self._problem.sparse_information(self._x, self._terms, self._dispersion, located=False)

    @cached_property
    def solve(self):
        """Solver of systems with H, to all but the last seven digits."""
        return self.information.solver()

    def _times(self, contrast: np.ndarray) -> np.ndarray:
        """Return the covariances (P + T,) with a contrast (P + T,) of the parameters."""
        influence = self.solve(contrast[:, None])
        found = self.solve(self.dispersed_information.times(influence))[:, 0]
        P = len(self._anchor)
        found[:P] -= self._anchor @ found[:P]
        return found

    def _padded(self, strengths: np.ndarray) -> np.ndarray:
        """Return a contrast (P + T,) of strengths alone."""
        return np.append(strengths, np.zeros(len(self._x) - len(strengths)))


def _some(columns: np.ndarray) -> list[np.ndarray]:
    """Split columns into portions that fit into a processor's cache."""
    return [columns[:, i : i + BATCH] for i in range(0, columns.shape[1], BATCH)]


def _between_ordinary(met):
    """Return the entries between snapshots that have not met far more others than most: their products stay sparse."""
    degree, entries = np.diff(met.indptr), met.tocoo()
    many = degree > 4 * np.median(degree)
    kept = ~(many[entries.row] | many[entries.col])
    return type(entries)((entries.data[kept], (entries.row[kept], entries.col[kept])), met.shape).tocsr()


class _SampledVariances:
    """Variances of many strengths, by regression on a similar quantity of known variance.

    H⁻¹ u, with u drawn with covariance B, has the desired covariance. M u is close to it, where M is two steps of
    Jacobi's method and a coarse correction over groups of snapshots, and its variance is computed exactly. So the
    variance of H⁻¹ u is β² that of M u plus that of the rest, with β the regression's slope, and only β and the rest
    are subject to chance (a control variate, e.g. Owen 2013, "Monte Carlo theory, methods and examples", chapter 8).
    The random numbers are always the same.
    """

    def __init__(self, signed_sums: StrengthCovariance, weights: np.ndarray):
        self._covariance, self._weights = signed_sums, weights
        h = self._h = signed_sums.information
        from scipy import sparse

        self._sparse = sparse
        scale = sparse.diags_array(1 / (h.diagonal + h.constant))
        near, met = scale, h.sparse()
        pairs = _between_ordinary(met)
        if pairs.nnz * (pairs.nnz / max(h.graph.size, 1)) <= WIDE:
            near = scale + scale @ pairs @ scale
        self._near: Any = near.tocsr()
        self._group = h.graph.groups
        members = sparse.csr_array(
            (np.ones(len(self._group)), (self._group, np.arange(len(self._group)))), (len(h.coarse), len(self._group))
        )
        # Zᵀ - Zᵀ H C; a constant in every entry is left out, which makes M slightly worse
        rest = members - (members @ sparse.diags_array(h.diagonal) - members @ met) @ self._near
        self._coarse = np.linalg.solve(h.coarse, rest.toarray())

    def variances(self, population: np.ndarray) -> np.ndarray:
        """Return variances (P,) of the differences to the anchors' mean of each snapshot's population."""
        rng = np.random.default_rng(0)
        both, square, rest = (np.zeros(len(population)) for _ in range(3))
        solve = self._covariance.information.solver(CLOSE)
        for _ in range(DRAWS // BATCH):
            noise = self._covariance.dispersed_information.draws(rng, BATCH)
            found = self._gauged(solve(noise)[: len(population)], population)
            nearly = self._gauged(self._times(noise[: len(population)]), population)
            both += np.einsum("ik,ik->i", found, nearly)
            square += np.einsum("ik,ik->i", nearly, nearly)
            rest += np.einsum("ik,ik->i", found, found)
        slope = both / np.maximum(square, 1e-300)
        return slope**2 * self._exact(population) + np.maximum(rest - slope * both, 0) / DRAWS

    def _gauged(self, x: np.ndarray, population: np.ndarray) -> np.ndarray:
        return x - (self._weights @ x)[population]

    def _times(self, x: np.ndarray) -> np.ndarray:
        """Return M x."""
        return self._near @ x + (self._coarse @ x)[self._group]

    def _transposed(self, x: np.ndarray) -> np.ndarray:
        """Return Mᵀ x."""
        sums = np.zeros((len(self._coarse), x.shape[1]))
        np.add.at(sums, self._group, x)
        return self._near.T @ x + self._coarse.T @ sums

    def _exact(self, population: np.ndarray) -> np.ndarray:
        """Return the variance (P,) of M u minus its anchors' mean."""
        near, group, dispersed_information = self._near, self._group, self._covariance.dispersed_information
        b = self._sparse.diags_array(dispersed_information.diagonal) - dispersed_information.sparse()
        through = b @ self._coarse.T  # (P, C)
        of_groups = np.einsum("ck,kc->c", self._coarse, through)
        entries = near.tocoo()
        mixed = np.bincount(entries.row, entries.data * through[entries.col, group[entries.row]], len(group))
        own = np.asarray((near @ b).multiply(near).sum(1)).ravel() + 2 * mixed + of_groups[group]
        shared = self._times(b @ self._transposed(self._weights.T))  # (P, G)
        return own - 2 * shared[np.arange(len(group)), population] + (self._weights @ shared).diagonal()[population]
