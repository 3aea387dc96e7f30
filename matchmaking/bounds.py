"""Why a fit without a prior would have no end: who is undefeated, winless or never met the others.

Ford 1957, "Solution of a ranking problem from binary comparisons": strengths are finite where, however the players are
divided into two groups, somebody of each has taken points from somebody of the other.
"""

from collections.abc import Sequence

import numpy as np

from matchmaking.likelihood import Likelihood, NotConverged, davidson, maximise
from matchmaking.payoff import Payoff

VANISHED = 1e-9
"""Information in (log odds)⁻² below which a direction has run away; the fit stops where it is about 1e-15."""


class Unbounded(ValueError):  # noqa: N818  (reads as what is wrong)
    """Without a prior some rating would be infinite, or not comparable; the message names whose."""


def maximum(problem: Likelihood, payoff: Payoff) -> np.ndarray:
    """(P + 2,) The parameters at the maximum of a likelihood without a prior. Raises Unbounded where there is none."""
    _check(payoff)
    try:
        x, trouble = maximise(problem), None
    except NotConverged as error:
        x, trouble = error.x, error
    information = problem.information(x, davidson(*problem.linear(x))) + problem.location
    values, vectors = np.linalg.eigh(information)
    if values[0] <= VANISHED:
        raise Unbounded(_ran_away(problem, payoff, np.abs(vectors[:, 0])))
    if trouble is not None:
        raise trouble
    return x


def _check(payoff: Payoff) -> None:
    """Raise Unbounded where Ford's condition is not met."""
    names, P = payoff.names, len(payoff.names)
    points = payoff.wins + payoff.draws > 0  # i has taken points from j
    met = points | points.T
    for name in np.array(names)[~met.any(1)]:
        raise Unbounded(f"{str(name)!r} has not played")
    for name in np.array(names)[~_reached(met, 0)]:
        told = "they have neither met nor a chain of opponents in common"
        raise Unbounded(f"{str(name)!r} is disconnected from {names[0]!r}: {told}")
    for i in range(P):
        if not points[:, i].any():
            raise Unbounded(f"{names[i]!r} is undefeated: it has won every game")
        if not points[i].any():
            raise Unbounded(f"{names[i]!r} is winless: it has lost every game")
    above = ~_reached(points, 0)  # from whom nobody that the first one leads to has taken points
    below = ~_reached(points.T, 0)
    for group, told in ((above, "undefeated by"), (below, "winless against")):
        if group.any():
            who = f"{_listed(names, group)}, taken together, are" if group.sum() > 1 else f"{_listed(names, group)} is"
            raise Unbounded(f"{who} {told} {_listed(names, ~group)}")


def _ran_away(problem: Likelihood, payoff: Payoff, direction: np.ndarray) -> str:
    """Why a fit has run away along draws or sides, which Ford's condition does not see."""
    if not problem.counts[:, [0, 2]].any():
        return "every game was drawn, so the chance of a draw has no end"
    for name, wins, losses in zip(payoff.names, payoff.wins.sum(1), payoff.losses.sum(1), strict=True):
        if problem.free[-1] and not (wins and losses):
            return f"{name!r} is {'undefeated' if wins else 'winless'}: it has not {'lost' if wins else 'won'} a game"
    if problem.free[-2] and direction[-2] > 0.5 * direction.max():
        return "one side wins where strengths do not tell, so its advantage has no end"
    name = payoff.names[int(direction[:-2].argmax())]
    return f"{name!r} hangs together with the others by draws or sides alone"


def _reached(points: np.ndarray, start: int) -> np.ndarray:
    """(P,) bool: who is reached from a player along who has taken points from whom."""
    reached = np.zeros(len(points), bool)
    reached[start] = True
    while (more := reached | points[reached].any(0)).sum() > reached.sum():
        reached = more
    return reached


def _listed(names: Sequence[str], which: np.ndarray) -> str:
    told = [name for name, listed in zip(names, which, strict=True) if listed]
    return ", ".join(map(repr, told[:3])) + (f" and {len(told) - 3} more" if len(told) > 3 else "")
