"""Analysis of payoff tables of a population: alpha-rank, transitive and cyclic parts. Pure functions; N strategies.

`matchmaking.metagame.nash` has the Nash mixture.
"""

from typing import Literal, NamedTuple

import numpy as np

from matchmaking.graph_algorithms import connected
from matchmaking.metagame.nash import Equilibrium, nash

Selection = Literal["local", "global"]
ALPHA, POPULATION = 100.0, 50
LIMIT = 1e12
"""Largest exponent of alpha-rank, alpha × payoff difference: beyond it only rounding changes."""
CYCLE_TOLERANCE = 1e-9
"""A pair is on a cycle if the share of its payoff that ratings explain is below 1 by more than this."""


def alpharank(
    payoffs: np.ndarray, alpha: float = ALPHA, population: int = POPULATION, selection: Selection = "local"
) -> Equilibrium:
    """Return the alpha-rank mixture of a symmetric game of one population: how long evolution stays at each strategy.

    Omidshafiei et al. 2019, "α-rank: multi-agent evaluation by evolution". A population of m plays strategy s; a mutant
    r takes it over with probability

        ρ = (1 + Σ_{l=1}^{m-1} Π_{k=1}^{l} exp(-α (f_r(k) - f_s(k))))⁻¹

    with k the number of mutants. Each of the N - 1 other strategies arises equally often; the mass is the stationary
    distribution of that chain. Fitness by `selection`: local, that of the pair that meets, f_r = A_rs and f_s = A_sr;
    global, the mean over the population, f_r(k) = ((k-1) A_rr + (m-k) A_rs) / (m-1) and likewise for s.

    All computations use logarithms, and the stationary distribution follows by the elimination of Grassmann, Taksar and
    Heyman (1985), which never subtracts: however large α is, nothing overflows or cancels.

    Args:
        payoffs: (N, N), of the row player.
        alpha: selection intensity, above 0; infinity is its limit.
        population: m, 2 or more.
        selection: local or global.

    Returns:
        mass (N,), and as value the mean payoff in a population of this mixture, massᵀ A mass.

    Raises:
        ValueError: a table that is not square or not finite, alpha or population out of range.
    """
    a = np.asarray(payoffs, float)
    if a.ndim != 2 or a.shape[0] != a.shape[1] or not a.size or not np.all(np.isfinite(a)):
        raise ValueError(
            f"alpha-rank needs a square table of finite payoffs, not one of {' × '.join(map(str, a.shape))}"
        )
    if not alpha > 0:
        raise ValueError(f"alpha is {alpha}; it must be above 0")
    if population < 2:
        raise ValueError(f"population is {population}; it must be 2 or more")
    span = float(np.ptp(a))
    if len(a) == 1 or span == 0:
        mass = np.full(len(a), 1 / len(a))
    else:
        mass = _stationary(_fixation(a / span, min(float(alpha) * span, LIMIT), population, selection))
    return Equilibrium(mass, float(mass @ a @ mass))


def _fixation(a: np.ndarray, alpha: float, population: int, selection: Selection) -> np.ndarray:
    """Return log ρ (N, N) of a mutant of the column in a population of the row."""
    own = np.diag(a)
    total, path = np.zeros_like(a), np.zeros_like(a)
    for k in range(1, population):
        if selection == "local":
            gap = a.T - a
        else:
            others = population - k
            mutant = ((k - 1) * own[None, :] + others * a.T) / (population - 1)
            gap = mutant - ((others - 1) * own[:, None] + k * a) / (population - 1)
        path = path - alpha * gap
        total = np.logaddexp(total, path)
    return -total


def _stationary(logs: np.ndarray) -> np.ndarray:
    """Return the stationary distribution (N,) of a chain whose rates from row to column have these logarithms."""
    logs = logs.copy()
    np.fill_diagonal(logs, -np.inf)
    n = len(logs)
    for k in range(n - 1, 0, -1):
        logs[:k, k] -= _sum(logs[k, :k])
        logs[:k, :k] = np.logaddexp(logs[:k, :k], logs[:k, k, None] + logs[None, k, :k])
        np.fill_diagonal(logs[:k, :k], -np.inf)
    found = np.zeros(n)
    for k in range(1, n):
        found[k] = _sum(found[:k] + logs[:k, k])
    p = np.exp(found - found.max())
    return p / p.sum()


def _sum(logs: np.ndarray) -> float:
    """Return log Σ exp(logs)."""
    largest = logs.max()
    return largest + np.log(np.exp(logs - largest).sum())


class Decomposition(NamedTuple):
    """Decomposition of a game of N strategies into a transitive part, which ratings explain, and a cyclic part."""

    rating: np.ndarray  # (N,) mean zero, in payoff: the transitive part is rating_i - rating_j
    transitive: float  # share of squared payoffs of pairs on cycles; nan if all are 0, or no pairs form a cycle
    cyclic: float
    cycles: int  # independent cycles that the known pairs form
    chance: float  # what chance alone would add to the cyclic share; nan without variances


def decompose(payoffs: np.ndarray, variances: np.ndarray | None = None) -> Decomposition:
    """Return the transitive and the cyclic part of an antisymmetric game, which are orthogonal.

    The Hodge decomposition of Balduzzi et al. 2018 ("Re-evaluating evaluation") and 2019 ("Open-ended learning in
    symmetric zero-sum games"): A = grad(r) + rot(A) with r the row means; by least squares over the known pairs if some
    are unknown (HodgeRank, Jiang et al. 2011).

    Ratings explain any payoff of a pair that is on no cycle of known pairs, so such a pair says nothing about the
    shares and is left out of them.

    Args:
        payoffs: (N, N), nan where unknown. Of scores between 0 and 1, or any constant sum, the antisymmetric half is
            taken.
        variances: (N, N) sampling variances of that half, if the payoffs are means of games.
    """
    a = np.asarray(payoffs, float)
    half = (a - a.T) / 2
    i, j = np.nonzero(np.triu(np.isfinite(half), 1))
    flow, n = half[i, j], len(a)
    # The graph's Laplacian plus a projection onto the constants of each component: no longer singular, and equivalent.
    part = connected(n, i, j)
    met = np.zeros((n, n))
    met[i, j] = met[j, i] = 1
    same = part[:, None] == part
    inverse = np.linalg.inv(np.diag(met.sum(1)) - met + same / same.sum(1))
    rating = inverse @ (np.bincount(i, flow, n) - np.bincount(j, flow, n))
    # Share of a pair's payoff that ratings explain whatever it is: 1 on no cycle (the effective resistance).
    own = inverse.diagonal()
    explained = own[i] + own[j] - 2 * inverse[i, j]
    on_cycle, cycles = explained < 1 - CYCLE_TOLERANCE, len(i) - n + len(np.unique(part))
    rest = (flow - rating[i] + rating[j])[on_cycle]
    total = float(flow[on_cycle] @ flow[on_cycle]) if cycles else 0.0
    cyclic = float(rest @ rest) / total if total else float("nan")
    chance = float("nan")
    if variances is not None and total:
        chance = float(((1 - explained) * variances[i, j])[on_cycle].sum()) / total
    return Decomposition(rating - rating.mean(), 1 - cyclic, cyclic, cycles, chance)


def relative_population_performance(payoffs: np.ndarray) -> Equilibrium:
    """Return the value of the game between two populations when both play best, with the rows' mixture.

    Balduzzi et al. 2019: the value of the zero-sum game between two populations, pᵀ A q at its Nash equilibrium. Above
    zero (one half for scores) the first population is the better one, whatever cycles exist within either.

    Args:
        payoffs: (N, M) of the first population's members against the second's.
    """
    return nash(payoffs)
