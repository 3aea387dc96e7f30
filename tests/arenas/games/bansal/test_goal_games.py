"""Run to goal, you shall not pass, kick and defend: who wins, what is paid, by hand on the C engine."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arenas.games.bansal.kick_and_defend import KickAndDefend, Shot, X, Y
from tests.arenas.games.bansal.contests import built, judged, outcome

OPEN = ((0.0, 0.0, 1.3), (1.0, 0.0, 1.3))


@pytest.fixture(scope="module")
def run():
    return built("run-to-goal")


@pytest.fixture(scope="module")
def passing():
    return built("you-shall-not-pass")


@pytest.fixture(scope="module")
def kicking():
    return built("kick-and-defend")


@pytest.fixture(scope="module")
def strict():
    return built("kick-and-defend", falls_lose=True)


RUNS = [
    # bases, time, the outcome with the first team on the left, then on the right
    (((3.9, 0, 0.5), (-3.9, 0, 0.5)), 1.0, (None, (0, 0)), (None, (0, 0))),
    (((4.1, 0, 0.5), (-3.9, 0, 0.5)), 1.0, ((1, 0), (1, -1)), (None, (0, 0))),
    (((-4.1, 0, 0.5), (3.9, 0, 0.5)), 1.0, (None, (0, 0)), ((1, 0), (1, -1))),
    (((4.1, 0, 0.5), (-4.1, 0, 0.5)), 1.0, ((0.5, 0.5), (0, 0)), (None, (0, 0))),
    (((0, 0, 0.2), (2, 0, 0.5)), 1.0, (None, (0, 0)), (None, (0, 0))),
    (((0, 0, 0.2), (2, 0, 0.2)), 1.0, ((0.5, 0.5), (-1, -1)), ((0.5, 0.5), (-1, -1))),
    (((0, 0, 0.5), (2, 0, 0.5)), 10.0, ((0.5, 0.5), (-1, -1)), ((0.5, 0.5), (-1, -1))),
]


@pytest.mark.parametrize(("bases", "time", "left", "right"), RUNS)
def test_the_first_over_its_own_far_line_wins(run, bases, time, left, right):
    assert outcome(judged(run, bases, time=time)) == left
    assert outcome(judged(run, bases, second_first=True, time=time)) == right


PASSES = [
    # runner, blocker, time, score, rewards; both in the order runner, blocker
    ((3.9, 0, 1.3), (1, 0, 1.3), 1.0, None, (0, 0)),
    ((4.1, 0, 1.3), (1, 0, 1.3), 1.0, (1, 0), (1, -1)),
    ((0, 0, 0.25), (1, 0, 1.3), 1.0, (0, 1), (-1, 1)),
    ((0, 0, 0.25), (1, 0, 0.25), 1.0, (0.5, 0.5), (-1, 0)),
    ((0, 0, 1.3), (1, 0, 0.25), 1.0, None, (0, 0)),
    ((0, 0, 1.3), (1, 0, 1.3), 7.5, (0, 1), (-1, 0)),
    ((4.1, 0, 1.3), (1, 0, 1.3), 7.5, (1, 0), (1, -1)),
]


@pytest.mark.parametrize(("runner", "blocker", "time", "score", "rewards"), PASSES)
def test_the_runner_must_pass_on_its_feet_and_in_time_whichever_team_it_is(
    passing, runner, blocker, time, score, rewards
):
    assert outcome(judged(passing, (runner, blocker), time=time)) == (score, rewards)
    swapped = judged(passing, (blocker, runner), second_first=True, time=time)
    assert outcome(swapped) == (score and score[::-1], rewards[::-1])


KICKS = [
    # ball, keeper's x and z, time, score and rewards of kicker and keeper
    ((3.9, 0.0, 0.0), (3.0, 1.3), 1.0, None, (0, 0)),
    ((4.1, 2.9, 3.0), (3.0, 1.3), 1.0, (1, 0), (1, -1)),
    ((4.1, 3.1, 3.0), (3.0, 1.3), 1.0, (0, 1), (-1, 1.5)),
    ((2.0, 0.0, -1.1), (3.0, 1.3), 1.0, (0, 1), (-1, 1.5)),
    ((2.0, 0.0, -0.9), (3.0, 1.3), 1.0, None, (0, 0)),
    ((2.0, 0.0, -1.1), (3.0, 0.3), 1.0, (0, 1), (-1, 1)),
    ((0.0, 0.0, 0.0), (3.0, 1.3), 7.5, (0, 1), (-1, 1.5)),
    ((0.0, 0.0, 0.0), (1.4, 1.3), 1.0, (1, 0), (0, -1)),
]


@pytest.mark.parametrize(("ball", "keeper", "time", "score", "rewards"), KICKS)
def test_goals_saves_and_fouls(kicking, ball, keeper, time, score, rewards):
    own = Shot(jnp.zeros(2), jnp.zeros((), bool))
    kicker, x, z = (-2.0, 0.0, 1.3), *keeper
    verdict = judged(kicking, (kicker, (x, 1.0, z)), own, ball=ball, time=time)
    assert outcome(verdict) == (score, rewards)
    swapped = judged(kicking, ((x, 1.0, z), kicker), own, second_first=True, ball=ball, time=time)
    assert outcome(swapped) == (score and score[::-1], rewards[::-1])


FALLS = [
    # z of kicker and keeper, ball, score and rewards of kicker and keeper
    (1.3, 0.7, (0.0, 0.0, 0.0), (1, 0), (0, -1)),
    (0.7, 1.3, (0.0, 0.0, 0.0), (0, 1), (-1, 0)),
    (0.7, 0.7, (0.0, 0.0, 0.0), (0.5, 0.5), (-1, -1)),
    (0.7, 1.3, (4.1, 2.9, 3.0), (1, 0), (1, -1)),
    (0.9, 0.9, (0.0, 0.0, 0.0), None, (0, 0)),
]


@pytest.mark.parametrize(("kicker", "keeper", "ball", "score", "rewards"), FALLS)
def test_who_falls_loses_where_the_rules_say_so(kicking, strict, kicker, keeper, ball, score, rewards):
    own, bases = Shot(jnp.zeros(2), jnp.zeros((), bool)), ((-2.0, 0.0, kicker), (3.0, 1.0, keeper))
    assert outcome(judged(strict, bases, own, ball=ball)) == (score, rewards)
    swapped = judged(strict, bases[::-1], own, second_first=True, ball=ball)
    assert outcome(swapped) == (score and score[::-1], rewards[::-1])
    plays_on = outcome(judged(kicking, bases, own, ball=ball))
    assert plays_on == (((1, 0), (1, -1)) if ball[0] > 4 else (None, (0, 0)))


@pytest.mark.parametrize(("y", "touches"), [(0.0, True), (1.0, False)])
def test_a_keeper_that_touched_the_ball_is_paid_at_the_save(kicking, y, touches):
    own = Shot(jnp.zeros(2), jnp.zeros((), bool))
    verdict = judged(kicking, ((-2.0, 0.0, 1.3), (3.0, y, 1.3)), own, ball=(3.0, 0.0, -2.0))
    np.testing.assert_array_equal(verdict.events["touch"], [False, touches])
    np.testing.assert_allclose(verdict.rewards["touch"], [0.0, 0.5 * touches])


def test_dense_terms_are_bansals_by_second(passing):
    verdict = judged(passing, ((1.0, 0.0, 1.3), (2.0, 0.0, 0.9)))
    dt = 0.02
    np.testing.assert_allclose(verdict.shapings["distance"], [-0.1 * 3 * dt, 0.1 * 3 * dt], rtol=1e-5)
    np.testing.assert_allclose(verdict.shapings["alive"], [0.5 * dt, -0.5 * dt], rtol=1e-5)
    np.testing.assert_allclose(verdict.shapings["forward"], [0.0, 0.0])


def reach(arena: KickAndDefend) -> np.ndarray:
    """The largest distance of kicker and keeper from the middles of their ranges by episode, as a share of them."""
    xy = np.asarray(jax.jit(jax.vmap(lambda key: arena.draw(key)[0]))(jax.random.split(jax.random.key(3), 2048)))
    low, high = np.stack([X[:, 0], [Y[0]] * 2], 1), np.stack([X[:, 1], [Y[1]] * 2], 1)
    return np.abs((xy - (low + high) / 2) / ((high - low) / 2)).max((1, 2))


def test_each_episode_draws_its_share_of_the_starts():
    wide = reach(built("kick-and-defend"))
    graded = reach(built("kick-and-defend", least_spread=0.0))
    assert max(wide.max(), graded.max()) <= 1.0
    assert (wide < 0.2).mean() < 0.01 < 0.2 < (graded < 0.2).mean() < 0.32  # 0.2 ** 4 = 0.002; 0.27 by integration
    assert (graded > 0.8).any()
    some = reach(built("kick-and-defend", spread=0.5, least_spread=0.5))
    np.testing.assert_allclose(some, reach(built("kick-and-defend", spread=0.5)), atol=1e-6)


def test_a_least_spread_above_the_largest_is_refused():
    with pytest.raises(ValueError, match=r"least_spread: 0\.5 is above spread, 0\.1"):
        built("kick-and-defend", spread=0.1, least_spread=0.5)
