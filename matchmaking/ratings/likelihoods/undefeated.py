"""Reasons why a fit without a prior has no maximum: undefeated, winless or unconnected snapshots.

Ford 1957, "Solution of a ranking problem from binary comparisons": strengths are finite if, however the players are
divided into two groups, some player of each has taken points from some player of the other.
"""

from collections.abc import Sequence

import numpy as np

from matchmaking.ratings.likelihoods.information import SolverNotConverged
from matchmaking.ratings.likelihoods.penalised import NotConverged, PenalisedLikelihood, maximise
from matchmaking.ratings.payoff import Payoff

VANISHED = 1e-9
"""Information in (log odds)⁻² below which a direction has diverged; the fit stops where it is about 1e-15."""


class Unbounded(ValueError):  # noqa: N818  (reads as what is wrong)
    """Without a prior some rating would be infinite, or not comparable; the message names the snapshots."""


def maximum(problem: PenalisedLikelihood, payoff: Payoff) -> np.ndarray:
    """Return the parameters (P + T,) at the maximum of a likelihood without a prior; Unbounded if there is none."""
    _check(payoff)
    try:
        x, trouble = maximise(problem), None
    except NotConverged as error:
        x, trouble = error.x, error
    least, direction = _weakest(problem, x)
    if least <= VANISHED:
        raise Unbounded(_explain_divergence(problem, payoff, np.abs(direction)))
    if trouble is not None:
        raise trouble
    return x


def _weakest(problem: PenalisedLikelihood, x: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the smallest eigenvalue of the information and its direction (P + T,)."""
    terms = problem.terms(x)
    if problem.is_dense:
        values, vectors = np.linalg.eigh(problem.information(x, terms) + problem.location)
        return values[0], vectors[:, 0]
    found = problem.sparse_information(x, terms)
    direction, least = np.random.default_rng(0).normal(size=(len(x), 1)), np.inf
    try:
        solve = found.solver()
        for _ in range(30):  # inverse iteration
            direction = solve(direction / np.linalg.norm(direction))
            direction /= np.linalg.norm(direction)
            least = float((direction * found.times(direction)).sum())
    except (SolverNotConverged, np.linalg.LinAlgError):
        least = 0.0
    return least, direction[:, 0]


def _check(payoff: Payoff) -> None:
    """Raise Unbounded if Ford's condition does not hold."""
    names, P, both = payoff.names, len(payoff.names), payoff.home + payoff.away
    first, second = both[:, :2].any(1), both[:, 1:].any(1)  # has taken points
    winner = np.concatenate([payoff.first[first], payoff.second[second]])
    loser = np.concatenate([payoff.second[first], payoff.first[second]])
    ends = np.append(winner, loser), np.append(loser, winner)
    for i in np.flatnonzero(np.bincount(ends[0], minlength=P) == 0)[:1]:
        raise Unbounded(f"{names[i]!r} has not played")
    for i in np.flatnonzero(~_reached(P, *ends))[:1]:
        reason = "they have neither met nor a chain of opponents in common"
        raise Unbounded(f"{names[i]!r} is disconnected from {names[0]!r}: {reason}")
    lost, won = (np.bincount(of, minlength=P) for of in (loser, winner))
    for i in np.flatnonzero((lost == 0) | (won == 0))[:1]:
        reason = "winless: it has lost every game" if lost[i] else "undefeated: it has won every game"
        raise Unbounded(f"{names[i]!r} is {reason}")
    above = ~_reached(P, winner, loser)  # no player that the first one reaches has taken points from these
    below = ~_reached(P, loser, winner)
    for group, reason in ((above, "undefeated by"), (below, "winless against")):
        if group.any():
            who = f"{_listed(names, group)}, taken together, are" if group.sum() > 1 else f"{_listed(names, group)} is"
            raise Unbounded(f"{who} {reason} {_listed(names, ~group)}")


def _explain_divergence(problem: PenalisedLikelihood, payoff: Payoff, direction: np.ndarray) -> str:
    """Return why a fit has diverged along draws or sides, which Ford's condition does not cover."""
    if not (payoff.home + payoff.away)[:, [0, 2]].any():
        return "every game was drawn, so the chance of a draw has no end"
    for name, (wins, _, losses) in zip(payoff.names, payoff.results.tolist(), strict=True):
        if problem.free[problem.size + 1 :].any() and not (wins and losses):
            return f"{name!r} is {'undefeated' if wins else 'winless'}: it has not {'lost' if wins else 'won'} a game"
    if problem.free[problem.size] and direction[problem.size] > 0.5 * direction.max():
        return "one side wins where strengths do not tell, so its advantage has no end"
    name = payoff.names[int(direction[: problem.size].argmax())]
    return f"{name!r} hangs together with the others by draws or sides alone"


def _reached(size: int, winner: np.ndarray, loser: np.ndarray) -> np.ndarray:
    """Return a mask (P,) bool of the players reached from the first one along pairs of winner and loser."""
    reached = np.arange(size) == 0
    while len(winner):
        new = reached[winner]
        if not new.any():
            break
        reached[loser[new]] = True
        open_ = ~new & ~reached[loser]  # the others add nothing
        winner, loser = winner[open_], loser[open_]
    return reached


def _listed(names: Sequence[str], which: np.ndarray) -> str:
    reason = [name for name, listed in zip(names, which, strict=True) if listed]
    return ", ".join(map(repr, reason[:3])) + (f" and {len(reason) - 3} more" if len(reason) > 3 else "")
