"""Parameters of Davidson's model without a finite maximum-likelihood value, given the games alone.

The likelihood of a multinomial logit has a finite maximum unless there is a direction in which no observed outcome
becomes less likely and one becomes more likely: the data are separated (Albert and Anderson 1984). Here a direction
changes each pair's difference d = θ_home - θ_away + γ and the draw term λ = log ν. With m the change of 2 λ it requires

    a win:  d >= 0 and d >= m        a draw:  -m <= d <= m        a loss:  d <= 0 and d <= -m

for the outcomes that a directed pair has had. If something was drawn m cannot be negative, so only m = 0 and m = 1 must
be examined, and for m = 0 only γ = 0, 1 and -1. Each is a system of difference constraints, which
`matchmaking.graph_algorithms` solves in integers: nothing is rounded, and no linear programme is needed. For m = γ = 0
it is the condition of Ford 1957: every player has taken points from every other along a chain.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Literal, NamedTuple

import numpy as np

from matchmaking import graph_algorithms
from matchmaking.ratings.davidson import Likelihood
from matchmaking.ratings.likelihoods.priors import none
from matchmaking.ratings.likelihoods.tie_separation import tie_directions
from matchmaking.ratings.payoff import Payoff

Bound = Literal["above", "below", "both"]
"""Direction in which a parameter has no bound."""
ABOVE, BELOW = 1, 2
BOUNDS: tuple[Bound | None, ...] = (None, "above", "below", "both")


@dataclass(frozen=True, eq=False)
class Separation:
    """Parameters of a fit of P players without a finite maximum.

    A rating is compared with the largest group of players of its island whose differences are all finite; if no two
    players have a finite difference, with all others of its island.
    """

    side: Bound | None  # of the side advantage
    draw: bool  # log ν then has no upper bound
    ratings: tuple[Bound | None, ...]  # (P,)
    unknown: np.ndarray  # (P,) bool: sides or draws explain all its results, so games say nothing about its rating
    island: np.ndarray  # (P,) int: connected component of games, from 1, the largest first; 0: has not played

    @property
    def finite(self) -> bool:
        """True if every parameter has a finite maximum, each rating within its island."""
        return self.side is None and not self.draw and not any(self.ratings)

    @property
    def islands(self) -> int:
        """Number of islands: groups of players between which no game was played."""
        return int(self.island.max(initial=0))


class _Direction(NamedTuple):
    """A system of difference constraints that has a solution."""

    m: int
    side: Fraction  # change of γ
    solution: np.ndarray  # (P,) change of θ, times the denominator of `side`
    edges: "_Edges"


class _Edges(NamedTuple):
    """A system of difference constraints, see `matchmaking.graph_algorithms`."""

    source: np.ndarray  # (E,)
    target: np.ndarray  # (E,)
    weight: np.ndarray  # (E,) times the denominator of the change of γ
    turn: np.ndarray  # (E,) change of the weight with γ: 1 or -1


def examined(payoff: Payoff, sides: bool = True) -> Separation:
    """Find the parameters of a fit of this payoff that have no finite value without a prior."""
    if not payoff.rankings:
        return find_separation(Likelihood.of(payoff, none(), sides))
    problem = Likelihood.of(payoff, none(), sides=False)
    problem = replace(problem, free=np.append(problem.free[:-1], False))  # with ties fixed, by pairs
    changes = tie_directions(payoff.rankings, len(payoff.names), payoff.first, payoff.second, payoff.home)
    return find_separation(problem, changes)


def find_separation(problem: Likelihood, changes: np.ndarray | None = None) -> Separation:
    """Find every direction in which the likelihood of the games has no maximum; the prior is left out.

    `changes` (D, P) are those of ratings along which ties of rankings have no bound, see `tie_directions`.
    """
    seen = problem.counts.any(1)
    home, away, counts = problem.home[seen], problem.away[seen], problem.counts[seen] > 0
    size, side_identifiable = problem.size, bool(problem.free[problem.size])
    island = islands(size, home, away)
    won, lost = counts[:, :2].any(1), counts[:, 1:].any(1)  # home has taken points, and away has
    ford = graph_algorithms.strong_components(
        size, np.concatenate([home[won], away[lost]]), np.concatenate([away[won], home[lost]])
    )
    found = list(_directions(size, home, away, counts, side_identifiable, bool(problem.free[-1])))
    moves = np.zeros((0, size)) if changes is None else np.round(changes, 5)
    groups = np.unique(np.stack([_groups(ford, found), *moves], 1), axis=0, return_inverse=True)[1].reshape(-1)
    better, worse = np.concatenate([home[won], away[lost]]), np.concatenate([away[won], home[lost]])
    bounds, unknown = np.zeros(size, int), np.zeros(size, bool)
    for number in range(1, island.max(initial=0) + 1):
        own = np.flatnonzero(island == number)
        names, sizes = np.unique(groups[own], return_counts=True)
        main = int(own[np.isin(groups[own], names[sizes == sizes.max()])][0])
        bounds[own] = (_against(main, better, worse, size) if sizes.max() > 1 else _alone(ford, better, worse))[own]
        ways = [_reaches(each, main) for each in found]
        if len(moves):
            apart = moves - moves[:, [main]]
            ways.append((np.any(apart > 0, axis=0), np.any(apart < 0, axis=0)))
        for way in ways:
            up, down = (reached[own] for reached in way)
            bounds[own] |= ABOVE * up + BELOW * down
            unknown[own] |= up & down
            if sizes.max() == 1:  # all are equally uncertain, including the one they are compared with
                bounds[main] |= ABOVE * down.any() + BELOW * up.any()
                unknown[main] |= (up & down).any()
    side = ABOVE * any(each.side > 0 for each in found) + BELOW * any(each.side < 0 for each in found)
    draw = bool(len(moves)) or any(each.m for each in found)
    return Separation(BOUNDS[side], draw, tuple(BOUNDS[b] for b in bounds), unknown, island)


def _groups(ford: np.ndarray, found: Sequence[_Direction]) -> np.ndarray:
    """Return numbers (P,) of groups of players whose differences are 0 in every direction, and so are finite."""
    labels = [ford]
    for each in found:
        source, target, weight, _ = each.edges
        tight = weight + each.solution[source] == each.solution[target]
        labels += [graph_algorithms.strong_components(len(ford), source[tight], target[tight]), each.solution]
    return np.unique(np.stack(labels, 1), axis=0, return_inverse=True)[1].reshape(-1)


def _against(main: int, better: np.ndarray, worse: np.ndarray, size: int) -> np.ndarray:
    """Return the bounds (P,) missing against player `main`, with sides and draws fixed (Ford's condition)."""
    under = graph_algorithms.reachable_from(size, better, worse, main)
    over = graph_algorithms.reachable_from(size, worse, better, main)
    return ABOVE * ~under + BELOW * ~over


def _alone(ford: np.ndarray, better: np.ndarray, worse: np.ndarray) -> np.ndarray:
    """Return the missing bounds (P,) if no two are comparable: never lost points, or never taken any."""
    between = ford[better] != ford[worse]
    beaten, beats = np.zeros(len(ford), bool), np.zeros(len(ford), bool)
    beaten[worse[between]] = beats[better[between]] = True
    return ABOVE * beats + BELOW * beaten


def _reaches(direction: _Direction, main: int) -> tuple[np.ndarray, np.ndarray]:
    """Return two masks (P,) bool: a rating may rise, or fall, against player `main` along this change of γ and λ."""
    (source, target, weight, _), x = direction.edges, direction.solution
    up = graph_algorithms.largest_differences(len(x), source, target, weight, x, main)
    down = graph_algorithms.largest_differences(len(x), target, source, weight, -x, main)
    return up > 0, down > 0


def islands(size: int, home: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Return the number (P,) of each player's island, the one with most players first; 0 for players without a game."""
    played = np.zeros(size, bool)
    played[home] = played[away] = True
    names, own, number = np.unique(
        graph_algorithms.connected(size, home, away)[played], return_inverse=True, return_counts=True
    )
    rank = np.empty(len(names), int)
    rank[np.argsort(-number, kind="stable")] = np.arange(1, len(names) + 1)
    island = np.zeros(size, int)
    island[played] = rank[own]
    return island


def _directions(
    size: int, home: np.ndarray, away: np.ndarray, counts: np.ndarray, side_identifiable: bool, drawn: bool
) -> Iterator[_Direction]:
    """Yield solvable systems other than Ford's: together they contain every change of γ and λ, up to a factor."""
    for m, side in [(0, 1), (0, -1)] if side_identifiable else []:
        edges = _edges(home, away, counts, m, Fraction(side))
        if edges and isinstance(found := graph_algorithms.solve(size, *edges[:3]), np.ndarray):
            yield _Direction(m, Fraction(side), found, edges)
    if not drawn or _edges(home, away, counts, 1, Fraction(0)) is None:
        return
    for side in _range(size, home, away, counts) if side_identifiable else [Fraction(0)]:
        edges = _edges(home, away, counts, 1, side)
        if edges and isinstance(found := graph_algorithms.solve(size, *edges[:3]), np.ndarray):
            yield _Direction(1, side, found, edges)


def _edges(home: np.ndarray, away: np.ndarray, counts: np.ndarray, m: int, side: Fraction) -> _Edges | None:
    """Return the constraints on θ, times the denominator of `side`; None if one pair alone contradicts itself."""
    won, drawn, lost = counts.T
    if m and (won & lost).any():
        return None
    p, q = side.numerator, side.denominator
    low, high = np.where(won, m, -m) * q - p, np.where(lost, -m, m) * q - p  # of θ_home - θ_away
    is_low, is_high = won | drawn, lost | drawn
    source = np.concatenate([away[is_high], home[is_low]])
    target = np.concatenate([home[is_high], away[is_low]])
    turn = np.repeat([-1, 1], [is_high.sum(), is_low.sum()])
    return _Edges(source, target, np.concatenate([high[is_high], -low[is_low]]), turn)


def _range(size: int, home: np.ndarray, away: np.ndarray, counts: np.ndarray) -> list[Fraction]:
    """Return two changes of γ inside the interval that m = 1 allows, or the only one; none without such an interval.

    A cycle that proves that there is no solution bounds γ by a fraction, from below or above (discrete Newton,
    Dinkelbach 1967).
    """
    far = Fraction(4 * size + 4)  # beyond every such fraction
    low, high = -far, far
    for start in (low, high):
        side = start
        while low <= side <= high:
            edges = _edges(home, away, counts, 1, side)
            assert edges is not None
            found = graph_algorithms.solve(size, *edges[:3])
            if isinstance(found, np.ndarray):
                break
            turns = int(edges.turn[found.edges].sum())  # the sum of weights is rest + turns × γ
            rest = Fraction(int(edges.weight[found.edges].sum()), side.denominator) - turns * side
            if turns == 0:
                return []
            side = -rest / turns
            low, high = (max(low, side), high) if turns > 0 else (low, min(high, side))
        if low > high:
            return []
    if low < 0 < high:
        return [low / 2, high / 2]  # inside, and of either sign
    return [low] if low == high else [low + (high - low) / 3, low + (high - low) / 2]
