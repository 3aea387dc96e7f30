from itertools import combinations

import numpy as np
import pytest

from matchmaking.ratings.davidson import Likelihood
from matchmaking.ratings.likelihoods import priors
from matchmaking.ratings.likelihoods.tie_separation import tie_directions
from matchmaking.ratings.payoff import rankings_payoff, sum_matches
from matchmaking.ratings.rankings import Rankings
from matchmaking.ratings.separation import examined, find_separation
from tests.league.leagues import match

P = 5


def log(*games: tuple[tuple[int, ...], tuple[int, ...]]) -> Rankings:
    """Return the rankings of games, each its players and their ranks."""
    rows = [(number, *each) for number, game in enumerate(games) for each in zip(*game, strict=True)]
    event, player, rank = (np.array(column) for column in zip(*rows, strict=True))
    return Rankings.of_events(event, player, rank.astype(float))


def directions(rankings: Rankings, size: int) -> np.ndarray | None:
    return tie_directions(rankings, size, *rankings.pairs(size))


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


@pytest.mark.slow
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
        found.append(directions(log(*games), P) is not None)
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
    assert (directions(log(*games), 3) is not None) is free


def test_where_all_games_were_ties_no_rating_is_known():
    found = examined(rankings_payoff(("a", "b", "c"), log(((0, 1, 2), (1, 1, 1)), ((0, 1, 2), (1, 1, 1)))))
    assert (found.draw, found.ratings, found.unknown.tolist()) == (True, ("both",) * 3, [True] * 3)


def test_among_many_players_too_no_rating_is_known_where_all_games_were_ties():
    rng = np.random.default_rng(1)
    games = [(tuple(rng.choice(300, 3, replace=False).tolist()), (1, 1, 1)) for _ in range(1200)]
    found = examined(rankings_payoff(tuple(map(str, range(300))), log(*games)))
    assert found.unknown.all()
    assert set(found.ratings) == {"both"}


@pytest.mark.slow
def test_rankings_of_two_tell_what_games_of_two_tell():
    rng, names, unlike = np.random.default_rng(1), ("a", "b", "c", "d"), 0
    for _ in range(100):
        games = [(*rng.choice(4, 2, replace=False).tolist(), int(rng.integers(3))) for _ in range(rng.integers(2, 9))]
        games = [(a, b, 1 if rng.random() < 0.5 else result) for a, b, result in games]
        played = [match(names[a], names[b], r == 0, r == 2, r == 1) for a, b, r in games]
        two = find_separation(Likelihood.of(sum_matches(played, names), priors.none(), False))
        ranks = {0: (1, 2), 1: (1, 1), 2: (2, 1)}
        many = examined(rankings_payoff(names, log(*(((a, b), ranks[r]) for a, b, r in games))))
        assert (many.draw, many.island.tolist()) == (two.draw, two.island.tolist())
        unlike += (many.ratings, many.unknown.tolist()) != (two.ratings, two.unknown.tolist())
    assert unlike < 3  # directions of rankings are looked for along random aims
