"""Soccer's stages: what success is, what is paid, what ends an attempt. Robot and ball are put by hand."""

import math
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from arenas.games.soccer.drill import GameState
from arenas.games.soccer.settings import ALL_DEFECTS
from arenas.games.soccer.stages import DrillReward, DrillRules, faithful
from arenas.games.terms import weights_of
from arenas.scene.randomisation import HARL_A, Randomisation
from tests.arenas.kickoff import put

DT = 0.02  # s
FAR = [(-3.0, 0.0, 0.0)]
PLUS, MINUS = GameState(jnp.asarray(1.0)), GameState(jnp.asarray(-1.0))


def ones(name, **rules):
    """The arena with weights of 1, so that terms can be read off."""
    settings = arenas.settings(name)
    reward = DrillReward(**dict.fromkeys(weights_of(DrillReward()), 1.0))
    return replace(settings, reward=reward, rules=replace(settings.rules, **rules)).build(engine="c")


@pytest.fixture(scope="module")
def score():
    return ones("soccer-score-leatherback")


@pytest.fixture(scope="module")
def ball():
    return ones("soccer-ball")


def judge(arena, before, after, game=PLUS, poses=FAR):
    return arena.judge(put(arena, poses, **before), put(arena, poses, **after), game)[1]


@pytest.mark.parametrize(
    ("at", "game", "success"),
    [
        ((9.0, 0.0), PLUS, 1.0),
        ((9.0, 0.0), MINUS, 0.0),
        ((-9.0, 0.0), MINUS, 1.0),
        ((-9.0, 0.0), PLUS, 0.0),
    ],
)
def test_to_score_is_to_have_the_ball_in_the_goal_that_is_asked_for(score, at, game, success):
    verdict = judge(score, {"ball": at}, {"ball": at}, game)
    assert verdict.terminated
    np.testing.assert_array_equal(verdict.score, [success])
    np.testing.assert_array_equal(verdict.rewards["goal"], [success])
    np.testing.assert_array_equal(verdict.rewards["wrong"], [1 - success])
    assert bool(verdict.events["goal"][0]) == bool(success)
    assert bool(verdict.events["wrong_goal"][0]) != bool(success)


def test_no_goal_yet_goes_on_and_the_clock_only_cuts(score):
    verdict = judge(score, {}, {"time": 19.98})
    assert not (verdict.terminated | verdict.truncated)
    late = judge(score, {}, {"time": 20.0})
    assert late.truncated
    assert not late.terminated
    np.testing.assert_array_equal(late.score, [0.0])
    last = judge(score, {}, {"time": 20.0, "ball": (9.0, 0.0)})
    assert last.terminated
    assert not last.truncated


def test_to_lie_on_its_back_is_a_failure(score, ball):
    for arena in (score, ball):
        verdict = judge(arena, {}, {"flipped": (0,)})
        assert verdict.terminated
        np.testing.assert_array_equal(verdict.score, [0.0])
        np.testing.assert_array_equal(verdict.rewards["fall"], [1.0])


def test_an_anymal_has_fallen_when_its_belly_is_on_the_ground(ball):
    """Its centre of mass is 8.5 mm above the base's origin."""
    assert not judge(ball, {}, {"up": {0: 0.095}}).terminated
    assert judge(ball, {}, {"up": {0: 0.085}}).terminated


@pytest.mark.parametrize(("x", "there"), [(-2.0, False), (-2.4, True)])
def test_to_be_at_the_ball_is_success_in_the_first_stage(ball, x, there):
    """0.8 m from base to ball, heights among them: 0.44 m of it, so 0.67 m along the ground."""
    verdict = judge(ball, {"ball": (x, 0.0)}, {"ball": (x, 0.0)})
    assert bool(verdict.terminated) is there
    assert bool(verdict.events["reached"][0]) is there
    if there:
        np.testing.assert_array_equal(verdict.score, [1.0])
        np.testing.assert_array_equal(verdict.rewards["reached"], [1.0])


def test_a_goal_ends_the_first_stage_as_a_failure(ball):
    verdict = judge(ball, {}, {"ball": (9.0, 0.0)})
    assert verdict.terminated
    np.testing.assert_array_equal(verdict.score, [0.0])


def test_who_shall_stay_at_the_ball_succeeds_when_time_is_up():
    arena = ones("soccer-ball", stay=True)
    near = {"ball": (-2.4, 0.0)}
    assert not judge(arena, near, near).terminated
    late = judge(arena, near, near | {"time": 10.0})
    assert late.truncated
    np.testing.assert_array_equal(late.score, [1.0])
    np.testing.assert_array_equal(late.rewards["reached"], [0.0])
    np.testing.assert_array_equal(judge(arena, {}, {"time": 10.0}).score, [0.0])


TERMS = [
    ("near", {"ball": (-2.0, 0.0)}, {"ball": (-2.0, 0.0)}, DT * (1 - math.tanh(math.hypot(1.0, 0.058) / 0.8))),
    ("ball", {"ball": (8.0, 0.0)}, {"ball": (8.0, 0.0)}, DT * (1 - math.tanh(1.25 / 0.8))),
    ("time", {}, {}, 1.0),
    ("goal", {}, {}, 0.0),
    ("wrong", {}, {}, 0.0),
    ("fall", {}, {}, 0.0),
    ("reached", {}, {}, 0.0),
]


@pytest.mark.parametrize(("term", "before", "after", "value"), TERMS)
def test_each_term_by_number(score, term, before, after, value):
    assert float(judge(score, before, after).rewards[term][0]) == pytest.approx(value, rel=1e-4, abs=1e-7)


@pytest.mark.parametrize(("game", "push"), [(PLUS, 0.1), (MINUS, -0.1)])
def test_hints_by_number(score, game, push):
    found = judge(score, {"ball": (0.0, 0.0)}, {"ball": (0.1, 0.0)}, game).shapings
    assert float(found["push"][0]) == pytest.approx(push, abs=1e-5)
    assert float(found["approach"][0]) == pytest.approx(-0.1, abs=1e-4)


def test_the_first_stages_draw_bodies_and_the_others_do_not():
    drawn = {name: arenas.settings(name).randomisation for name in arenas.names() if name.startswith("soccer")}
    assert {name for name, found in drawn.items() if found != Randomisation()} == {"soccer-ball", "soccer-score"}
    assert drawn["soccer-ball"] == HARL_A
    assert arenas.settings("soccer-walk").randomisation == arenas.settings("anymal-walk").randomisation


def test_faithful_turns_every_defect_on():
    settings = faithful(arenas.settings("soccer-ball"))
    rules = settings.rules
    assert rules.defects == ALL_DEFECTS
    assert (rules.goal_at, rules.stay, rules.heading, rules.fall_up) == (9.0, True, "fixed", -1.0)
    assert faithful(arenas.settings("soccer-score-leatherback")).rules.goal_at == 9.25


def test_steering_and_throttle_are_clamped_unless_the_defect_is_wanted():
    action = jnp.array([9.0, 20.0])
    sane = arenas.load("soccer-score-leatherback", engine="c").robots["blue/0"].command(action)
    np.testing.assert_allclose(sane, [50.0] * 4 + [0.75] * 2)
    rules = DrillRules(defects=ALL_DEFECTS)
    settings = replace(arenas.settings("soccer-score-leatherback"), rules=rules)
    np.testing.assert_allclose(settings.build(engine="c").robots["blue/0"].command(action), [90.0] * 4 + [2.0] * 2)
