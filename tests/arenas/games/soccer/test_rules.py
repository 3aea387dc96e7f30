"""Soccer's matches: who has won, what is paid, what happened. Robots and ball are put by hand."""

import math
import re
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from arenas.games.soccer.match import GameState
from arenas.games.soccer.settings import OUTCOME, RewardDefects, SoccerReward, SoccerRules, faithful
from tests.arenas.hooks import judging
from tests.arenas.kickoff import put

DT = 0.02  # s
POSES = [(-3.0, 0.0, 0.0), (3.0, 2.0, math.pi)]
NOBODY = GameState(jnp.zeros(2, bool))
BLUE, RED = GameState(jnp.array([True, False])), GameState(jnp.array([False, True]))


def built(name="soccer-1v1", **changes):
    return replace(arenas.settings(name), **changes).build(engine="c")


@pytest.fixture(scope="module")
def match():
    return built()


@pytest.fixture(scope="module")
def rovers():
    return built(blue=("leatherback",), red=("leatherback",))


def judged(arena, before=None, after=None, poses=POSES, game=NOBODY):
    """The game and verdict of a control step, from the one state to the other, each the words of `put`."""
    return judging(arena)(put(arena, poses, **(before or {})), put(arena, poses, **(after or {})), game)


# where the ball is, and who has scored
GOALS = [
    ((9.25, 0.0), "blue"),
    ((-9.25, 0.0), "red"),
    ((8.76, 1.49), "blue"),
    ((-8.76, -1.49), "red"),
    ((9.64, -1.49), "blue"),  # at the end wall
    ((8.74, 0.0), None),  # before the goal
    ((9.25, 1.51), None),  # beside it
    ((0.0, 0.0), None),
]


@pytest.mark.parametrize(("ball", "scorer"), GOALS)
def test_a_goal_wins_for_those_who_play_at_it(match, ball, scorer):
    _, verdict = judged(match, after={"ball": ball})
    assert bool(verdict.terminated) == (scorer is not None)
    assert not verdict.truncated
    scored = [scorer == "blue", scorer == "red"]
    np.testing.assert_array_equal(verdict.events["goal"], scored)
    np.testing.assert_array_equal(verdict.events["conceded"], scored[::-1])
    if scorer:
        np.testing.assert_array_equal(verdict.score, scored)
        np.testing.assert_allclose(verdict.rewards["goal"], np.multiply(scored, 20.0))
        np.testing.assert_allclose(verdict.rewards["concede"], np.multiply(scored[::-1], -20.0))
        np.testing.assert_allclose(verdict.reward, np.where(scored, 20.0, -20.0) - 0.01, rtol=1e-6)


@pytest.mark.parametrize("height", [0.11, 1.0, 3.0])
def test_how_high_the_ball_is_does_not_matter(match, height):
    assert judged(match, after={"ball": (9.0, 1.0), "height": height})[1].events["goal"][0]


@pytest.mark.parametrize(("last", "own"), [(BLUE, True), (RED, False), (NOBODY, False)])
def test_a_goal_counts_whoever_pushed_the_ball_and_an_own_goal_is_told(match, last, own):
    _, verdict = judged(match, after={"ball": (-9.0, 0.0)}, game=last)
    np.testing.assert_array_equal(verdict.score, [0.0, 1.0])
    np.testing.assert_array_equal(verdict.events["own_goal"], [own, False])


def test_time_up_is_a_draw_that_cuts_the_match_off(match):
    assert not judged(match, after={"time": 29.98})[1].truncated
    _, late = judged(match, after={"time": 30.0})
    assert late.truncated
    assert not late.terminated
    np.testing.assert_array_equal(late.score, [0.5, 0.5])
    np.testing.assert_allclose(late.reward, [-0.01, -0.01], rtol=1e-6)
    _, last = judged(match, after={"time": 30.0, "ball": (9.0, 0.0)})
    assert last.terminated
    assert not last.truncated
    np.testing.assert_array_equal(last.score, [1.0, 0.0])


def test_time_up_may_end_the_match_for_the_learner_too():
    _, late = judged(built(rules=SoccerRules(clock="end")), after={"time": 30.0})
    assert late.terminated
    assert not late.truncated
    np.testing.assert_array_equal(late.score, [0.5, 0.5])


@pytest.mark.parametrize(
    ("falls", "fallen", "terminated", "score"),
    [
        ("play", (0,), False, None),
        ("play", (0, 1), False, None),
        ("lose", (0,), True, (0.0, 1.0)),
        ("lose", (1,), True, (1.0, 0.0)),
        ("lose", (0, 1), True, (0.5, 0.5)),
        ("end", (1,), True, (0.5, 0.5)),
    ],
)
def test_a_fall_costs_what_the_rules_say(falls, fallen, terminated, score):
    arena = built(rules=SoccerRules(falls=falls))
    _, verdict = judged(arena, after={"flipped": fallen})
    np.testing.assert_array_equal(verdict.events["fall"], [i in fallen for i in range(2)])
    assert bool(verdict.terminated) is terminated
    if score:
        np.testing.assert_array_equal(verdict.score, score)
        np.testing.assert_allclose(verdict.rewards["goal"] + verdict.rewards["concede"], np.subtract(score, 0.5) * 40)


def test_a_launched_robot_cuts_the_match_off_as_a_draw(match):
    assert not judged(match, after={"up": {1: 4.9}})[1].truncated
    _, verdict = judged(match, after={"up": {1: 5.1}})
    assert verdict.truncated
    assert not verdict.terminated
    np.testing.assert_array_equal(verdict.score, [0.5, 0.5])
    np.testing.assert_array_equal(verdict.events["launched"], [False, True])


# Touches and saves ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ball", "was", "now", "touch"),
    [
        ((-2.6, 0.0), (0.0, 0.0), (1.0, 0.0), (True, False)),  # blue's robot is at -3
        ((-2.6, 0.0), (1.0, 0.0), (0.9, 0.0), (False, False)),  # slowed by no more than the ground can
        ((2.7, 1.9), (1.0, 0.0), (0.0, 1.0), (False, True)),
        ((0.0, 0.0), (0.0, 0.0), (2.0, 0.0), (False, False)),  # nobody is near
    ],
)
def test_a_push_is_a_change_of_speed_near_a_robot(rovers, ball, was, now, touch):
    states = ({"ball": ball, "rolls": rolls} for rolls in (was, now))
    game, verdict = judged(rovers, *states)
    np.testing.assert_array_equal(verdict.events["touch"], touch)
    np.testing.assert_array_equal(game.last, touch)


def test_the_last_push_is_remembered(rovers):
    game, _ = judged(rovers, game=BLUE)
    np.testing.assert_array_equal(game.last, [True, False])


KEEPING = [(-8.4, 0.0, 0.0), (3.0, 2.0, math.pi)]


@pytest.mark.parametrize(
    ("was", "now", "saved"),
    [
        ((-3.0, 0.0), (1.0, 0.0), True),
        ((-3.0, 0.0), (-0.5, 2.0), True),  # turned aside: it would cross the line beside the goal
        ((-3.0, 0.0), (-2.0, 0.0), False),  # it still goes in
        ((-0.2, 0.0), (1.0, 0.0), False),  # it would not have got there
        ((-3.0, 9.0), (1.0, 0.0), False),  # it would have missed
        ((3.0, 0.0), (1.0, 0.0), False),
    ],
)
def test_a_save_turns_away_a_ball_that_would_have_gone_in(rovers, was, now, saved):
    states = ({"ball": (-8.1, 0.1), "rolls": rolls} for rolls in (was, now))
    _, verdict = judged(rovers, *states, poses=KEEPING)
    np.testing.assert_array_equal(verdict.events["save"], [saved, False])


def test_a_wall_saves_nothing(rovers):
    states = ({"ball": (-8.1, 0.1), "rolls": rolls} for rolls in ((-3.0, 0.0), (1.0, 0.0)))
    assert not judged(rovers, *states)[1].events["save"].any()


# Rewards --------------------------------------------------------------------------------------------------------------


def test_hints_by_number(rovers):
    """The ball goes from (6, 0) to (6.05, 0): nearer to blue's target goal, away from red's; red is nearer to it."""
    _, verdict = judged(rovers, {"ball": (6.0, 0.0)}, {"ball": (6.05, 0.0)})
    np.testing.assert_allclose(verdict.shapings["push"], [0.05, -0.05], atol=1e-5)
    red = math.hypot(3.0, 2.0) - math.hypot(3.05, 2.0)  # heights differ by 6 cm
    np.testing.assert_allclose(verdict.shapings["approach"], [-0.5 * 0.05, 0.5 * red], atol=1e-4)
    paid = [DT * (1 - math.tanh(3.2 / 0.8)), DT * (1 - math.tanh(15.3 / 0.8))]
    np.testing.assert_allclose(verdict.shapings["ball"], paid, rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize(
    ("defects", "paid"),
    [
        (RewardDefects(), (0.0, DT)),
        (RewardDefects(own_goal=True), (DT, DT)),  # blue is paid for a ball before its own goal
        (RewardDefects(per_step=True), (0.0, 1.0)),
        (RewardDefects(own_goal=True, per_step=True), (1.0, 1.0)),
    ],
)
def test_the_originals_shaping_can_be_had(defects, paid):
    arena = built("soccer-2v2-leatherback", reward=SoccerReward(defects=defects))
    poses = [(0.0, float(y), 0.0) for y in range(4)]
    _, verdict = judged(arena, after={"ball": (-8.7, 0.0)}, poses=poses)
    share = 1 - math.tanh(0.55 / 0.8)
    np.testing.assert_allclose(verdict.shapings["ball"], np.multiply(paid, share), rtol=1e-4, atol=1e-6)


def test_the_outcome_alone_is_the_papers_reward_of_one_against_one(match):
    arena = built(reward=OUTCOME)
    _, verdict = judged(arena, {"ball": (6.0, 0.0)}, {"ball": (6.05, 0.0)})
    assert all((term == 0).all() for term in verdict.shapings.values())
    assert arena.config_hash == match.config_hash  # rewards decide no match


# Exchange -------------------------------------------------------------------------------------------------------------


def test_teams_change_places_by_half_a_turn(rovers):
    physics = put(rovers, [(-3.0, 1.0, 0.3), (2.0, -2.0, 2.0)], (4.0, 3.0), (1.0, -2.0), moves={0: (0.5, 0.2)})
    qpos, qvel, game = rovers.exchange(physics.qpos, physics.qvel, BLUE)
    there = put(
        rovers, [(-2.0, 2.0, 2.0 - math.pi), (3.0, -1.0, 0.3 + math.pi)], (-4.0, -3.0), (-1.0, 2.0),
        moves={1: (-0.5, -0.2)},
    )  # fmt: skip
    at = [rovers.scene.agents[name].qpos for name in ("blue/0", "red/0")]
    for first in at:
        np.testing.assert_allclose(qpos[first : first + 3], there.qpos[first : first + 3], atol=1e-5)
        same = abs(float(qpos[first + 3 : first + 7] @ there.qpos[first + 3 : first + 7]))
        assert same == pytest.approx(1.0, abs=1e-6)  # a quaternion and its negative are one rotation
    ball = rovers.pitch.ball_qpos
    np.testing.assert_allclose(qpos[ball : ball + 2], there.qpos[ball : ball + 2], atol=1e-6)
    np.testing.assert_allclose(qvel, there.qvel, atol=1e-6)
    np.testing.assert_array_equal(game.last, [False, True])


# Settings -------------------------------------------------------------------------------------------------------------


def test_faithful_turns_every_defect_on():
    settings = faithful(arenas.settings("soccer-2v2"))
    for group in (settings.rules.defects, settings.reward.defects):
        assert all(vars(group).values())
    assert (settings.rules.heading, settings.rules.clock, settings.rules.falls) == ("fixed", "end", "play")
    assert settings.build(engine="c").config_hash != arenas.load("soccer-2v2", engine="c").config_hash


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"blue": ("minitank",)}, "blue: unknown robot 'minitank': (robots: anymal, leatherback, ant, "),
        ({"red": ("leatherbak",)}, "red: unknown robot 'leatherbak': did you mean leatherback?"),
        ({"blue": ()}, "blue: a team needs at least one robot"),
        ({"blue": ("anymal",) * 40}, "rules.pitch: 41 robots may find no room on the 165 points"),
    ],
)
def test_rosters_that_cannot_be_are_refused_in_one_line(change, says):
    with pytest.raises(ValueError, match=f"^{re.escape(says)}") as caught:
        replace(arenas.settings("soccer-1v1"), **change)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"pitch": (5.0, 10.0)}, r"pitch: \[5.0, 10.0\] must be two lengths in metres, each from 6 to 200"),
        ({"goal": (1.0, 9.6)}, r"goal: \[1.0, 9.6\] must be two lengths in metres from 0.1 on, the second to 9.5"),
        ({"goal_at": 9.5}, "goal_at: 9.5 m must be from 0.5 to 9.25 m"),
        ({"pitch": (16.0, 10.0)}, "goal_at: 9.25 m must be from 0.5 to 7.25 m"),
    ],
)
def test_pitches_that_cannot_be_are_refused_in_one_line(change, says):
    with pytest.raises(ValueError, match=f"^{says}") as caught:
        SoccerRules(**change)
    assert "\n" not in str(caught.value)
