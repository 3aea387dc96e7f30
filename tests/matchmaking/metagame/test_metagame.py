"""Meta-games with known answers."""

import numpy as np
import pytest

from matchmaking.metagame.alpharank import alpharank, decompose, relative_population_performance
from matchmaking.metagame.nash import nash

RPS = np.array([[0.0, -1, 1], [1, 0, -1], [-1, 1, 0]])
# Biased rock, paper, scissors of Omidshafiei et al. 2019: Nash (1, 10, 5) / 16, alpha-rank a third each.
BIASED = np.array([[0.0, -0.5, 1], [0.5, 0, -0.1], [-1, 0.1, 0]])


def han() -> np.ndarray:
    """The game of Han, Pereira and Lenaerts 2013 on commitment, by which OpenSpiel tests its alpha-rank."""
    r, t, p, s, fine, cost = 1.0, 2.0, 0.0, -1.0, 4.0, 0.25
    return np.array([
        [r - cost / 2, r - cost, 0, s + fine - cost, r - cost],
        [r, r, s, s, s], [0, t, p, p, p], [t - fine, t, p, p, p], [r, t, p, p, p],
    ])  # fmt: skip


def random_game(n: int, seed: int, ties: bool = False) -> np.ndarray:
    a = np.random.default_rng(seed).normal(size=(n, n))
    a = a - a.T
    return np.round(a) if ties else a


@pytest.mark.parametrize(
    ("payoffs", "mass", "value"),
    [
        (RPS, [1 / 3] * 3, 0),
        ([[1, -1], [-1, 1]], [0.5, 0.5], 0),  # matching pennies
        (BIASED, [0.1 / 1.6, 1 / 1.6, 0.5 / 1.6], 0),
        ([[3, 1], [2, 0]], [1, 0], 1),  # the second row is dominated
        ([[0, 2], [1, 0]], [1 / 3, 2 / 3], 2 / 3),
        ([[4.0]], [1], 4),
        ([[7, 7], [7, 7]], [0.5, 0.5], 7),
        ([[0.5, 0.0, 1.0], [1.0, 0.5, 0.0], [0.0, 1.0, 0.5]], [1 / 3] * 3, 0.5),  # scores
    ],
)
def test_nash_of_games_that_can_be_solved_by_hand(payoffs, mass, value):
    found = nash(np.array(payoffs, float))
    assert found.mass == pytest.approx(mass, abs=1e-9)
    assert found.value == pytest.approx(value, abs=1e-9)


def test_of_many_equilibria_nash_is_the_one_of_maximum_entropy():
    twice = np.ix_([0, 0, 1, 2], [0, 0, 1, 2])
    assert nash(RPS[twice]).mass == pytest.approx([1 / 6, 1 / 6, 1 / 3, 1 / 3])
    # Any mixture of the first two holds the value; a third that is worse against one column is never played.
    assert nash(np.array([[0.5, 0.5], [0.5, 0.5], [0.5, 0.4]])).mass == pytest.approx([0.5, 0.5, 0], abs=1e-8)
    # p = (x, x, 1 - 2x) holds the value for all x in [1/4, 1/2]; the most even of them is the middle.
    found = nash(np.array([[1.0, -1, 0], [-1, 1, 0], [0, 0, 0]]))
    assert found.mass == pytest.approx([1 / 3] * 3, abs=1e-6)
    # And where a column holds only some of these: entropy's maximum lies on an edge.
    edge = nash(np.array([[1.0, -1, 1], [-1, 1, 1], [0, 0, -1.5]]))
    assert edge.mass == pytest.approx([1 / 3] * 3, abs=1e-6)
    edge = nash(np.array([[1.0, -1, 1], [-1, 1, 1], [0, 0, -4]]))
    assert edge.mass == pytest.approx([0.4, 0.4, 0.2], abs=1e-6)


@pytest.mark.parametrize("ties", [False, True])
@pytest.mark.parametrize("n", [2, 7, 30])
def test_nobody_beats_nash_and_renaming_changes_nothing(n, ties):
    for seed in range(5):
        a = random_game(n, seed, ties)
        found = nash(a)
        assert found.value == pytest.approx(0, abs=1e-9)
        assert (found.mass @ a).min() >= -1e-9
        order = np.random.default_rng(seed).permutation(n)
        assert nash(a[np.ix_(order, order)]).mass == pytest.approx(found.mass[order], abs=1e-6)


def test_nash_of_unlike_sides_has_the_value_that_linear_programming_finds():
    linprog = pytest.importorskip("scipy.optimize").linprog
    for seed in range(5):
        a = np.random.default_rng(seed).normal(size=(6, 9))
        known = linprog(
            np.r_[np.zeros(6), -1], np.c_[-a.T, np.ones(9)], np.zeros(9), [np.r_[np.ones(6), 0]], [1],
            [(0, None)] * 6 + [(None, None)],
        )  # fmt: skip
        found = nash(a)
        assert found.value == pytest.approx(-known.fun, abs=1e-9)
        assert (found.mass @ a).min() == pytest.approx(found.value, abs=1e-9)
        assert relative_population_performance(a).value == found.value


def test_alpharank_gives_the_published_masses():
    assert alpharank(RPS).mass == pytest.approx([1 / 3] * 3)
    published = [0.40966787, 0.07959841, 0.20506998, 0.08505983, 0.2206039]
    assert alpharank(han(), alpha=0.1, population=20, selection="global").mass == pytest.approx(published, abs=1e-7)


@pytest.mark.parametrize("selection", ["local", "global"])
def test_alpharank_is_the_stationary_distribution_of_its_chain(selection):
    a, alpha, m = BIASED, 0.7, 8
    chain = np.zeros((3, 3))
    for s in range(3):
        for r in set(range(3)) - {s}:
            total, product = 1.0, 1.0
            for k in range(1, m):
                if selection == "local":
                    gap = a[r, s] - a[s, r]
                else:
                    gap = ((k - 1) * a[r, r] + (m - k) * a[r, s]) / (m - 1)
                    gap -= ((m - k - 1) * a[s, s] + k * a[s, r]) / (m - 1)
                product *= np.exp(-alpha * gap)
                total += product
            chain[s, r] = 1 / total / 2
        chain[s, s] = 1 - chain[s].sum()
    found = alpharank(a, alpha, m, selection)
    assert found.mass @ chain == pytest.approx(found.mass, abs=1e-12)
    assert found.value == pytest.approx(found.mass @ a @ found.mass)


@pytest.mark.parametrize("alpha", [1e3, 1e9, 1e300, np.inf])
@pytest.mark.parametrize("selection", ["local", "global"])
def test_a_large_alpha_is_the_limit(alpha, selection):
    """In a circle every step is certain, so each strategy is held equally long however small its lead."""
    found = alpharank(BIASED, alpha, selection=selection)
    assert found.mass == pytest.approx([1 / 3] * 3)
    dominated = alpharank(np.array([[0.0, 1, 1], [-1, 0, 1e-3], [-1, -1e-3, 0]]), alpha, selection=selection)
    assert dominated.mass == pytest.approx([1, 0, 0])


def test_renaming_permutes_alpharank_and_equals_share():
    a = random_game(12, 3)
    order = np.random.default_rng(1).permutation(12)
    assert alpharank(a[np.ix_(order, order)], 5).mass == pytest.approx(alpharank(a, 5).mass[order])
    assert alpharank(np.full((4, 4), 0.3)).mass == pytest.approx([0.25] * 4)
    assert alpharank(RPS * 7 + 100, 1).mass == pytest.approx([1 / 3] * 3)


def test_the_cyclic_share_of_circles_and_ladders():
    assert decompose(RPS).cyclic == pytest.approx(1)
    ladder = np.subtract.outer([3.0, 1, -4], [3, 1, -4])
    assert (decompose(ladder).cyclic, decompose(ladder).rating.tolist()) == (
        pytest.approx(0),
        pytest.approx([3, 1, -4]),
    )
    both = decompose(ladder + 2 * RPS)
    assert both.transitive == pytest.approx((ladder**2).sum() / ((ladder + 2 * RPS) ** 2).sum())
    assert decompose(0.5 + RPS / 2).cyclic == pytest.approx(1)  # of scores
    assert np.isnan(decompose(np.zeros((2, 2))).cyclic)


def test_pairs_that_never_met_are_left_out_of_the_shares():
    ladder = np.subtract.outer([3.0, 1, -4, 0], [3, 1, -4, 0])
    ladder[0, 2] = ladder[2, 0] = np.nan
    assert decompose(ladder).rating == pytest.approx([3, 1, -4, 0])


def test_no_share_is_known_until_pairs_close_a_ring():
    tree = np.full((4, 4), np.nan)
    for i, j in ((0, 1), (1, 2), (2, 3)):
        tree[i, j], tree[j, i] = 1, -1
    found = decompose(tree)
    assert found.cycles == 0
    assert np.isnan([found.cyclic, found.transitive]).all()
    assert found.rating == pytest.approx([1.5, 0.5, -0.5, -1.5])
    tree[0, 2], tree[2, 0] = -1, 1  # the first three go round in a circle, and the last hangs on to it
    found = decompose(tree)
    assert (found.cycles, found.cyclic) == (1, pytest.approx(1))
    apart = np.full((7, 7), np.nan)
    apart[:3, :3], apart[3:, 3:] = RPS, tree
    assert decompose(apart).cycles == 2
    assert decompose(apart).cyclic == pytest.approx(1)


def test_what_chance_adds_to_the_cyclic_share_is_what_equals_show():
    rng, n, games = np.random.default_rng(0), 12, 10
    found = []
    for _ in range(50):
        wins = np.triu(rng.binomial(games, 0.5, (n, n)), 1) / games
        scores = wins + np.tril(1 - wins.T, -1) + 0.5 * np.eye(n)
        found.append(decompose(scores, np.full((n, n), 0.25 / games)))
    cyclic, chance = np.mean([each.cyclic for each in found]), np.mean([each.chance for each in found])
    assert chance == pytest.approx(cyclic, rel=0.1)
    assert cyclic == pytest.approx(1 - (n - 1) / (n * (n - 1) / 2), rel=0.05)  # 55 of the 66 dimensions


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: nash(np.zeros((0, 3))), "row per strategy"),
        (lambda: nash(np.array([[np.nan]])), "finite"),
        (lambda: alpharank(np.zeros((2, 3))), "square table"),
        (lambda: alpharank(RPS, 0.0), "alpha is 0.0"),
        (lambda: alpharank(RPS, population=1), "2 or more"),
    ],
)
def test_what_cannot_be_solved_is_refused(call, says):
    with pytest.raises(ValueError, match=says):
        call()


def test_scores_of_single_games_among_many_strategies_have_an_equilibrium():
    """Most pairs have not met and count ½, others are 0 or 1: curvatures differ by more than floating-point holds."""
    rng = np.random.default_rng(36)
    strengths, met = rng.normal(0, 1.5, 76), rng.integers(76, size=(2, 760))
    i, j = met[:, met[0] != met[1]]
    won = rng.binomial(1, 1 / (1 + np.exp(strengths[j] - strengths[i])))
    table = np.full((76, 76), 0.5)
    table[i, j], table[j, i] = won, 1 - won
    first, second = nash(table), nash(-table.T)
    assert (first.mass @ table).min() == pytest.approx(first.value, abs=1e-9)
    assert first.value == pytest.approx(-second.value, abs=1e-9)
