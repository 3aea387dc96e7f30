from itertools import combinations

import numpy as np
import pytest

from matchmaking.ratings.likelihoods.tie_separation import tie_direction
from matchmaking.ratings.rankings import Rankings

P = 5


def log(*games: tuple[tuple[int, ...], tuple[int, ...]]) -> Rankings:
    """Return the rankings of games, each its players and their ranks."""
    rows = [(number, *each) for number, game in enumerate(games) for each in zip(*game, strict=True)]
    event, player, rank = (np.array(column) for column in zip(*rows, strict=True))
    return Rankings.of_events(event, player, rank.astype(float))


def direction(rankings: Rankings, size: int) -> np.ndarray | None:
    return tie_direction(rankings, size, *rankings.pairs(size))


def every_condition(games) -> tuple[np.ndarray, list[int]]:
    """Return the coefficients of u and λ in each condition of each choice, written out from the model's definition."""
    orders = sorted({ranks.count(r) for _, ranks in games for r in ranks} - {1})
    rows = []

    def group(members) -> np.ndarray:
        row = np.zeros(P + len(orders))
        row[list(members)] = 1 / len(members)
        if len(members) > 1:
            row[P + orders.index(len(members))] += 1
        return row

    for players, ranks in games:
        for rank in sorted(set(ranks)):
            left = [p for p, r in zip(players, ranks, strict=True) if r >= rank]
            chosen = group([p for p, r in zip(players, ranks, strict=True) if r == rank])
            for k in [1, *orders]:
                rows += [chosen - group(members) for members in combinations(left, k)]
    return np.array(rows), orders


def test_ties_have_a_bound_exactly_where_all_conditions_together_say_so():
    from scipy.optimize import linprog

    rng, found = np.random.default_rng(5), []
    for _ in range(150):
        games = []
        for _ in range(rng.integers(1, 7)):
            players = tuple(rng.choice(P, rng.integers(2, P + 1), replace=False).tolist())
            raw = rng.integers(1, 4, len(players)).tolist()
            games.append((players, tuple(1 + sum(other < each for other in raw) for each in raw)))
        conditions, orders = every_condition(games)
        if not orders:
            continue
        gain = -linprog(
            -np.append(np.zeros(P), np.ones(len(orders))), -conditions, np.zeros(len(conditions)),
            bounds=[(-1, 1)] * P + [(0, 1)] * len(orders),
        ).fun  # fmt: skip
        found.append(direction(log(*games), P) is not None)
        assert found[-1] == (gain > 1e-7), games
    assert 20 < sum(found) < len(found) - 20


@pytest.mark.parametrize(
    ("games", "free"),
    [
        ([((0, 1, 2), (1, 1, 1))], True),  # every game was a tie of all
        ([((0, 1, 2), (1, 1, 1)), ((0, 1, 2), (1, 2, 3)), ((2, 1, 0), (1, 2, 3))], False),
        ([((0, 1, 2), (1, 1, 3)), ((0, 1, 2), (1, 1, 3))], True),  # the first two always tie
    ],
)
def test_ties_by_hand(games, free):
    assert (direction(log(*games), 3) is not None) is free
