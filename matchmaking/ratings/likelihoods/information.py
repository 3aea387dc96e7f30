"""The information matrix of a fit of many snapshots, stored as the pairs that met, and linear systems with it.

A table of all pairs of 10,000 snapshots takes 800 MB and minutes to invert, though each has met only some ten others.
Below P is the number of snapshots, S the number of pairs with a weight, T the number of shared parameters (the side
advantage and the logarithms of the tie terms), K the number of right-hand sides.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

COARSE = 400
"""Maximum number of groups of snapshots in the coarse part of the preconditioner."""
MAX_DENSE = 2000
"""Above so many snapshots SciPy computes products; below, importing it takes longer than it saves."""
STEPS = 3000
CLOSE = 1e-9


class SolverNotConverged(ArithmeticError):  # noqa: N818  (reads as what is wrong)
    """Conjugate gradients have not converged: the weights differ too much for floating-point numbers."""


@dataclass(frozen=True, eq=False)
class PairGraph:
    """Pairs of snapshots with a weight: the nonzero entries of a sparse symmetric matrix during a whole fit."""

    size: int
    first: np.ndarray  # (S,) int
    second: np.ndarray  # (S,) int, each pair once
    games: np.ndarray  # (S,) weights for forming groups

    @classmethod
    def of(cls, size: int, ends: np.ndarray, others: np.ndarray, games: np.ndarray) -> tuple["PairGraph", np.ndarray]:
        """Return the graph of pairs, which may repeat and be in either order, and the index of each of them in it."""
        keys = np.minimum(ends, others) * size + np.maximum(ends, others)
        found, place = np.unique(keys, return_inverse=True)
        first, second = np.divmod(found, max(size, 1))
        return cls(size, first, second, np.bincount(place, games, len(found))), place

    @cached_property
    def order(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compressed rows: the pair (2S,) and the column (2S,) of each entry, and row ends (P + 1,)."""
        rows, columns = np.append(self.first, self.second), np.append(self.second, self.first)
        sorted_ = np.argsort(rows, kind="stable")
        ends = np.append(0, np.cumsum(np.bincount(rows, minlength=self.size)))
        return sorted_ % max(len(self.first), 1), columns[sorted_], ends

    def signed_sums(self, values: np.ndarray) -> np.ndarray:
        """Return sums (P, K) of values (S, K) over pairs: added for a pair's first, subtracted for its second."""
        if self.size > MAX_DENSE:
            return self._incidence @ values
        found = np.zeros((self.size, values.shape[1]))
        np.add.at(found, self.first, values)
        np.subtract.at(found, self.second, values)
        return found

    @cached_property
    def _incidence(self):
        from scipy import sparse

        S = len(self.first)
        signs, ends = np.append(np.ones(S), -np.ones(S)), np.append(self.first, self.second)
        return sparse.csr_array((signs, (ends, np.tile(np.arange(S), 2))), (self.size, S))

    @cached_property
    def groups(self) -> np.ndarray:
        """Group (P,) of each snapshot: snapshots that played much with each other, about COARSE groups at most.

        Two snapshots that each played most with the other, as a share of all games of either, are joined, together with
        those that played most with one of them; this is repeated. So a lineage is cut into runs.
        """
        group, first, second, heavy = np.arange(self.size), self.first, self.second, self.games
        for _ in range(12):
            count = int(group.max(initial=-1)) + 1
            if count <= COARSE or not len(first):
                break
            total = np.bincount(first, heavy, count) + np.bincount(second, heavy, count)
            share = heavy / np.maximum(np.maximum(total[first], total[second]), 1e-300)
            rows, columns = np.append(first, second), np.append(second, first)
            best = np.lexsort((columns, np.append(share, share), rows))
            last = np.append(np.flatnonzero(np.diff(rows[best])), len(rows) - 1)
            chosen = np.arange(count)
            chosen[rows[best][last]] = columns[best][last]
            mutual = chosen[chosen] == np.arange(count)
            root = np.where(mutual, np.minimum(chosen, np.arange(count)), np.arange(count))
            root = np.where(mutual[chosen], root[chosen], root)
            number = np.unique(root, return_inverse=True)[1]
            group, first, second = number[group], number[first], number[second]
            kept = first != second
            keys, place = np.unique(
                np.minimum(first, second)[kept] * self.size + np.maximum(first, second)[kept], return_inverse=True
            )
            heavy = np.bincount(place, heavy[kept], len(keys))
            first, second = np.divmod(keys, self.size)
        return group


@dataclass(frozen=True, eq=False)
class Information:
    """Symmetric matrix over P strengths and T shared parameters.

    The part of the strengths is the Laplacian of the weights, plus a diagonal, plus a constant in every entry.
    """

    graph: PairGraph
    weight: np.ndarray  # (S,)
    own: np.ndarray  # (P,) added to the diagonal
    shared_terms: np.ndarray  # (S, T) of a pair's first with the shared parameters; its second has the opposite
    shared_block: np.ndarray  # (T, T) of the shared parameters
    constant: float = 0.0

    @cached_property
    def border(self) -> np.ndarray:
        """Block (P, T) between strengths and shared parameters."""
        return self.graph.signed_sums(self.shared_terms)

    @cached_property
    def diagonal(self) -> np.ndarray:
        """Diagonal (P,) of the strengths, without `constant`."""
        of = self.graph
        return self.own + np.bincount(of.first, self.weight, of.size) + np.bincount(of.second, self.weight, of.size)

    def times(self, x: np.ndarray) -> np.ndarray:
        """Return the product (P + T, K) with x (P + T, K)."""
        strengths, shared = x[: self.graph.size], x[self.graph.size :]
        top = self.of_strengths(strengths) + self.border @ shared
        return np.concatenate([top, self.border.T @ strengths + self.shared_block @ shared])

    def of_strengths(self, x: np.ndarray) -> np.ndarray:
        """Return the product (P, K) of the strengths' part with x (P, K)."""
        found = self.diagonal[:, None] * x - self._met(x)
        return found + self.constant * x.sum(0) if self.constant else found

    @cached_property
    def _met(self) -> Callable[[np.ndarray], np.ndarray]:
        pair, column, ends = self.graph.order
        if self.graph.size > MAX_DENSE:
            return self.sparse().__matmul__
        weight, filled = self.weight[pair][:, None], np.flatnonzero(np.diff(ends))

        def product(x: np.ndarray) -> np.ndarray:
            found = np.zeros_like(x)
            if len(filled):
                found[filled] = np.add.reduceat(weight * x[column], ends[filled])
            return found

        return product

    def sparse(self):
        """Return the weights as a symmetric `scipy.sparse.csr_array` (P, P)."""
        from scipy import sparse  # takes a tenth of a second

        pair, column, ends = self.graph.order
        return sparse.csr_array((self.weight[pair], column, ends), shape=(self.graph.size,) * 2)

    def draws(self, rng: np.random.Generator, number: int) -> np.ndarray:
        """Return samples (P + T, number) of a normal distribution of mean 0 and this covariance without `constant`."""
        pairs = _normal(rng, len(self.weight), number)
        size = np.sqrt(np.maximum(self.weight, 0))[:, None]  # ties of three and more can make a small one negative
        slope = self.shared_terms / np.maximum(size, 1e-150)
        strengths = self.graph.signed_sums(size * pairs) + np.sqrt(self.own)[:, None] * _normal(
            rng, len(self.own), number
        )
        values, vectors = np.linalg.eigh(self.shared_block - slope.T @ slope)  # remainder after the pairs
        rest = vectors * np.sqrt(np.maximum(values, 0))
        return np.concatenate([strengths, slope.T @ pairs + rest @ _normal(rng, len(values), number)])

    def solver(self, close: float = CLOSE) -> Callable[[np.ndarray], np.ndarray]:
        """Return a solver of systems with this matrix, for right-hand sides (P + T, K).

        The solver raises SolverNotConverged.
        """
        solve, P = self._strengths_solver(close), self.graph.size
        found: list[np.ndarray] = []  # the solved border, computed with the first right-hand sides

        def solved(right: np.ndarray) -> np.ndarray:
            columns = right.shape[1]
            top = solve(right[:P] if found else np.concatenate([right[:P], self.border], 1))
            if not found:
                through = top[:, columns:]
                found.extend([through, np.linalg.inv(self.shared_block - self.border.T @ through)])
                top = top[:, :columns]
            through, left = found
            shared = left @ (right[P:] - self.border.T @ top)
            return np.concatenate([top - through @ shared, shared])

        return solved

    def _strengths_solver(self, close: float) -> Callable[[np.ndarray], np.ndarray]:
        """Return conjugate gradients (Hestenes and Stiefel 1952), preconditioned by the diagonal and by groups.

        The groups' own system is solved exactly, so that distant snapshots are connected in few steps (additive
        two-level preconditioner, e.g. Nicolaides 1987): without it steps grow with the length of a lineage.
        """
        group, of = self.graph.groups, self.coarse
        inverse, scale = np.linalg.inv(of), 1 / (self.diagonal + self.constant)[:, None]
        sums = _GroupSums(group, len(of))

        def precondition(r: np.ndarray) -> np.ndarray:
            return scale * r + (inverse @ sums(r))[group]

        def solve(right: np.ndarray) -> np.ndarray:
            x, r = np.zeros_like(right), right.copy()
            z = precondition(r)
            p, size = z, _dots(r, z)
            enough = close**2 * size
            for _ in range(STEPS):
                if (size <= enough).all():
                    return x
                product = self.of_strengths(p)
                length = size / np.maximum(_dots(p, product), 1e-300)
                x, r = x + length * p, r - length * product
                z = precondition(r)
                before, size = size, _dots(r, z)
                p = z + size / np.maximum(before, 1e-300) * p
            raise SolverNotConverged(f"{STEPS} steps were not enough")

        return solve

    @cached_property
    def coarse(self) -> np.ndarray:
        """Part of the strengths, summed over groups (C, C)."""
        a, b, size = (
            self.graph.groups[self.graph.first],
            self.graph.groups[self.graph.second],
            int(self.graph.groups.max()) + 1,
        )
        apart = a != b
        met = np.bincount((a * size + b)[apart], self.weight[apart], size * size).reshape(size, size)
        met = met + met.T
        members = np.bincount(self.graph.groups, minlength=size)
        own = np.bincount(self.graph.groups, self.own, size)
        return np.diag(met.sum(1) + own) - met + self.constant * np.outer(members, members)


class _GroupSums:
    """Sums of rows over groups, in the order of the groups."""

    def __init__(self, group: np.ndarray, size: int):
        self._order = np.argsort(group, kind="stable")
        self._starts = np.searchsorted(group[self._order], np.arange(size))

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        return np.add.reduceat(rows[self._order], self._starts)


def _normal(rng: np.random.Generator, rows: int, columns: int) -> np.ndarray:
    """Return standard normal numbers (rows, columns), in single precision for speed."""
    return rng.standard_normal((rows, columns), np.float32)


def _dots(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the dot products (K,) of the columns."""
    return np.einsum("ik,ik->k", a, b)
