"""Meta-games: what a table of payoffs says of a population. Pure functions of matrices; N strategies.

`matchmaking.equilibrium` has the Nash mixture.
"""

from typing import Literal, NamedTuple

import numpy as np

from matchmaking.equilibrium import Equilibrium, nash

Selection = Literal["local", "global"]
ALPHA, POPULATION = 100.0, 50
LIMIT = 1e12
"""Largest exponent of alpha-rank, alpha × payoff difference: beyond it nothing changes but rounding."""


def alpharank(
    payoffs: np.ndarray, alpha: float = ALPHA, population: int = POPULATION, selection: Selection = "local"
) -> Equilibrium:
    """alpha-rank of a symmetric game of one population: how long evolution dwells on each strategy.

    Omidshafiei et al. 2019, "α-rank: multi-agent evaluation by evolution". A population of m plays strategy s; a mutant
    r takes it over with probability

        ρ = (1 + Σ_{l=1}^{m-1} Π_{k=1}^{l} exp(-α (f_r(k) - f_s(k))))⁻¹

    k the number of mutants. Each of the N - 1 other strategies arises equally often; the mass is the stationary
    distribution of that chain. Fitness by `selection`: local, that of the pair that meets, f_r = A_rs and f_s = A_sr;
    global, the mean over the population, f_r(k) = ((k-1) A_rr + (m-k) A_rs) / (m-1) and likewise for s.

    All is done with logarithms, and the stationary distribution by the elimination of Grassmann, Taksar and Heyman
    (1985), which never subtracts: however large α is, no figure overflows and none cancels.

    Args:
        payoffs: (N, N), of the row player.
        alpha: selection intensity, above 0; infinity is its limit.
        population: m, 2 or more.
        selection: local or global.

    Returns:
        mass (N,) and as value the mean payoff in a population so mixed, massᵀ A mass. Raises ValueError.
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
    """(N, N) log ρ of a mutant of the column in a population of the row."""
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
    """(N,) The stationary distribution of a chain whose rates from row to column have these logarithms."""
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
    """Log Σ exp."""
    largest = logs.max()
    return largest + np.log(np.exp(logs - largest).sum())


class Shares(NamedTuple):
    """How a game of N strategies splits: what a rating of each explains, and what goes round in circles."""

    rating: np.ndarray  # (N,) mean zero, in payoff: the transitive part is rating_i - rating_j
    transitive: float  # shares of the squares; nan where all payoffs are nil
    cyclic: float


def decompose(payoffs: np.ndarray) -> Shares:
    """The transitive and the cyclic part of an antisymmetric game, which are orthogonal.

    The Hodge decomposition of Balduzzi et al. 2018 ("Re-evaluating evaluation") and 2019 ("Open-ended learning in
    symmetric zero-sum games"): A = grad(r) + rot(A) with r the row means; by least squares over the pairs that are
    known where some are not (HodgeRank, Jiang et al. 2011).

    Args:
        payoffs: (N, N), nan where nothing is known. Of a score between 0 and 1, or of any constant sum, the
            antisymmetric half is taken.
    """
    a = np.asarray(payoffs, float)
    half = (a - a.T) / 2
    i, j = np.nonzero(np.triu(np.isfinite(half), 1))
    flow = half[i, j]
    edges = np.zeros((len(i), len(a)))
    edges[np.arange(len(i)), i], edges[np.arange(len(i)), j] = 1, -1
    rating = np.linalg.lstsq(edges, flow, rcond=None)[0] if len(i) else np.zeros(len(a))
    total, rest = float(flow @ flow), flow - edges @ rating
    cyclic = float(rest @ rest) / total if total else float("nan")
    return Shares(rating - rating.mean(), 1 - cyclic, cyclic)


def relative_performance(payoffs: np.ndarray) -> Equilibrium:
    """Relative population performance: what the rows' population is worth against the columns' when both play best.

    Balduzzi et al. 2019: the value of the zero-sum game between two populations, pᵀ A q at its Nash equilibrium. Above
    zero (one half for scores) the first population is the better one, whatever goes round in circles within either.

    Args:
        payoffs: (N, M) of the first population's members against the second's.
    """
    return nash(payoffs)
