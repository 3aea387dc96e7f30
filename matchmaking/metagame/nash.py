"""Nash equilibria of zero-sum matrix games: the equilibrium of maximum entropy, by interior points. NumPy alone.

Below N is the number of rows (strategies of the maximiser), M that of columns.
"""

from typing import NamedTuple

import numpy as np

STEPS = 200
CLOSE = 1e-13  # complementarity at which the interior point method stops, for payoffs that span 1


class Equilibrium(NamedTuple):
    """A mixture of the rows, and its value against the best reply."""

    mass: np.ndarray  # (N,)
    value: float


def nash(payoffs: np.ndarray) -> Equilibrium:
    """Return the row player's maximum-entropy Nash equilibrium of a zero-sum game, and the game's value.

    Equilibria of a zero-sum game are a convex set; the one of maximum entropy is unique, and treats equal strategies
    equally (Ortiz, Schapire, Kakade 2007; Balduzzi et al. 2018, "Re-evaluating evaluation"). In two steps:

    1. A primal-dual path-following interior point method (Wright 1997) solves the linear programme of the game and ends
       in
       the middle of the optimal faces. This tells the rows that are played in some equilibrium, and the columns that
       hold
       each of them to the value (strict complementarity, Goldman and Tucker 1956).
    2. On that face Newton's method maximises the entropy, with a vanishing barrier for the other columns.

    Args:
        payoffs: (N, M) of the row player, finite; they may be a score or anything of a constant sum.

    Returns:
        mass (N,) and value. Raises ValueError for a table that is empty or not finite.
    """
    table = np.asarray(payoffs, float)
    if table.ndim != 2 or not table.size or not np.all(np.isfinite(table)):
        raise ValueError("payoffs must be a table of finite numbers, a row per strategy and at least one column")
    low, span = table.min(), np.ptp(table)
    if span == 0:
        return Equilibrium(np.full(len(table), 1 / len(table)), float(low))
    scaled = (table - low) / span
    p, value, played, tight = _face(scaled)
    mass, value = _most_even(scaled, p, value, played, tight)
    return Equilibrium(mass, float(low + span * value))


def _face(a: np.ndarray) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
    """Return a point in the middle of the row player's equilibria, the value, the played rows and the tight columns.

    Follows p t = q s = μ to μ = 0, where s = aᵀp - v and t = w - a q are what the columns and rows lack to be best
    replies: v is the least value of p, w the highest cost of q.
    """
    n, m = a.shape
    p, q = np.full(n, 1 / n), np.full(m, 1 / m)
    v, w = (p @ a).min() - 1, (a @ q).max() + 1
    for _ in range(STEPS):
        s, t = p @ a - v, w - a @ q
        gap = p @ t + q @ s
        if gap < CLOSE * (n + m):
            break
        # Unknowns: dp (n), dq (m), dv, dw. Rows: p t and q s become μ, and the masses keep their sums.
        system = np.zeros((n + m + 2, n + m + 2))
        system[:n, :n], system[:n, n : n + m], system[:n, -1] = np.diag(t), -p[:, None] * a, p
        system[n : n + m, :n], system[n : n + m, n : n + m] = q[:, None] * a.T, np.diag(s)
        system[n : n + m, -2] = -q
        system[-2, :n] = system[-1, n : n + m] = 1
        aim = 0.1 * gap / (n + m)
        try:
            step = np.linalg.solve(system, np.concatenate([aim - p * t, aim - q * s, [0, 0]]))
        except np.linalg.LinAlgError:
            break  # singular in floating-point numbers: a step would be mere rounding
        dp, dq, dv, dw = step[:n], step[n : n + m], step[-2], step[-1]
        now, change = np.concatenate([p, q, s, t]), np.concatenate([dp, dq, dp @ a - dv, dw - a @ dq])
        shrinks = change < 0
        length = min(1.0, 0.995 * (now[shrinks] / -change[shrinks]).min(initial=np.inf))
        p, q, v, w = p + length * dp, q + length * dq, v + length * dv, w + length * dw
    return p / p.sum(), (v + w) / 2, p > w - a @ q, q > p @ a - v


def _most_even(
    a: np.ndarray, p: np.ndarray, value: float, played: np.ndarray, tight: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the mixture of maximum entropy among those rows with the same value, starting near `p`; and the value."""
    rows, columns = a[played][:, tight], a[played][:, ~tight]
    fixed = np.vstack([np.column_stack([rows.T, -np.ones(rows.shape[1])]), [*np.ones(len(rows)), 0.0]])
    start = np.append(p[played] / p[played].sum(), value)
    start = start + np.linalg.lstsq(fixed, np.append(np.zeros(rows.shape[1]), 1.0) - fixed @ start, rcond=1e-11)[0]
    x, value = start[:-1], start[-1]
    _, sizes, basis = np.linalg.svd(np.vstack([rows.T, np.ones(len(rows))]))
    free = basis[(sizes > 1e-9 * sizes[0]).sum() :].T  # directions that change neither sum nor value
    if free.size and x.min() > 0:
        barrier = 1e-2
        while barrier > 1e-14:
            x = _newton(x, free, columns, value, barrier)
            barrier /= 10
    mass = np.zeros(len(a))
    mass[played] = np.clip(x, 0, None)
    mass /= mass.sum()
    # If rows and columns could not be distinguished, the interior point itself is the better answer.
    return (mass, value) if (mass @ a).min() >= (p @ a).min() - 1e-9 else (p, float((p @ a).min()))


def _newton(x: np.ndarray, free: np.ndarray, columns: np.ndarray, value: float, barrier: float) -> np.ndarray:
    """Minimise Σ x log x - barrier Σ log(columnsᵀx - value) along the free directions."""

    def cost(x: np.ndarray) -> float:
        slack = x @ columns - value
        return np.inf if x.min() <= 0 or (slack <= 0).any() else x @ np.log(x) - barrier * np.log(slack).sum()

    now = cost(x)
    if not np.isfinite(now):
        return x
    across = free.T @ columns
    for _ in range(STEPS):
        slack = x @ columns - value
        slope = free.T @ (np.log(x) + 1) - barrier * (across / slack).sum(1)
        rows, held = free / np.sqrt(x)[:, None], np.sqrt(barrier) * across / slack
        move = _descent(rows.T @ rows + held @ held.T, slope)
        if -slope @ move < 1e-18:
            break
        length = 1.0
        while cost(x + length * (free @ move)) > now + 1e-4 * length * (slope @ move) and length > 1e-12:
            length /= 2
        if length <= 1e-12:
            break
        x = x + length * (free @ move)
        now = cost(x)
    return x


def _descent(curved: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return -curved⁻¹ slope, for a matrix that is positive definite up to rounding.

    The curvature of a tiny probability or slack exceeds all others by more than floating-point numbers hold,
    and the matrix is singular to them. It is therefore scaled to a diagonal of ones; if that does not suffice, only
    directions with significant eigenvalues are followed.
    """
    scale = 1 / np.sqrt(np.maximum(curved.diagonal(), np.finfo(float).tiny))
    scaled, steep = curved * scale * scale[:, None], scale * slope
    try:
        move = -scale * np.linalg.solve(scaled, steep)
        if slope @ move < 0:
            return move
    except np.linalg.LinAlgError:
        pass
    values, vectors = np.linalg.eigh(scaled)
    known = values > len(values) * np.finfo(float).eps * values[-1]
    return -scale * (vectors[:, known] @ ((vectors[:, known].T @ steep) / values[known]))
