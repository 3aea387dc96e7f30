"""HARL-A's rules: falls, the outcome alone as reward, timeouts that cost as much as a loss; and its defects."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from arenas.games.sumo import Defects
from arenas.games.sumo.match import GameState
from arenas.games.sumo.settings import PAPER, faithful
from tests.arenas.hooks import judging

RING = GameState(jnp.asarray(4.0))
IN, OUT = (2.0, 2.0, 0.0), (3.0, 3.0, 0.0)  # 2.83 and 4.24 m from the centre
MATES = (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)
BELLY = 0.08  # m: an ANYmal's base this high has its centre of mass at 0.0885 m


def judge(arena, stand, blue=IN, red=IN, low=(), flipped=(), time=1.0):
    poses = [blue, MATES[0], (-red[0], -red[1], 0.0), MATES[1]]
    physics = stand(arena, poses, time, flipped, height=dict.fromkeys(low, BELLY))
    return judging(arena)(physics, physics, RING)[1]


@pytest.fixture(scope="module")
def original(by_team):
    """By team, where falls are not counted."""
    return with_defects(falls_uncounted=True)


def with_defects(name="sumo-by-team", **defects):
    settings = arenas.settings(name)
    return replace(settings, rules=replace(settings.rules, defects=Defects(**defects))).build(engine="c")


ENDS = [
    ({"blue": OUT}, (0.0, 1.0), (-10.0, 10.0)),
    ({"red": OUT}, (1.0, 0.0), (10.0, -10.0)),
    ({"low": (1,)}, (0.0, 1.0), (-10.0, 10.0)),  # an ANYmal's belly is on the ground
    ({"low": (2,)}, None, (0.0, 0.0)),  # a rover is always low
    ({"flipped": (3,)}, (1.0, 0.0), (10.0, -10.0)),  # a rover on its back
    ({"flipped": (1,)}, None, (0.0, 0.0)),  # an ANYmal on its back, high: the paper knows no such rule
    ({"blue": OUT, "red": OUT}, (0.5, 0.5), (0.0, 0.0)),
    ({"low": (0,), "red": OUT}, (0.5, 0.5), (0.0, 0.0)),
    ({"time": 29.98}, None, (0.0, 0.0)),
    ({"time": 30.0}, (0.5, 0.5), (-10.0, -10.0)),
    ({"time": 30.0, "red": OUT}, (1.0, 0.0), (10.0, -10.0)),
]


@pytest.mark.parametrize(("scene", "score", "reward"), ENDS)
def test_who_wins_and_what_it_is_worth(by_team, stand, scene, score, reward):
    verdict = judge(by_team.arena, stand, **scene)
    assert bool(verdict.terminated) is (score is not None)
    assert not verdict.truncated
    np.testing.assert_array_equal(verdict.reward, reward)
    if score:
        np.testing.assert_array_equal(verdict.score, score)
    np.testing.assert_array_equal(verdict.shaping, [0.0, 0.0])


@pytest.mark.parametrize(
    ("scene", "score", "reward"),
    [
        ({"low": (1,)}, (0.5, 0.5), (-10.0, 10.0)),
        ({"blue": OUT}, (0.0, 1.0), (-10.0, 10.0)),
        ({"low": (0,), "red": OUT}, (1.0, 0.0), (0.0, 0.0)),
        ({"blue": OUT, "red": OUT}, (0.5, 0.5), (0.0, 0.0)),
    ],
)
def test_falls_that_are_not_counted_cost_reward_alone(original, stand, scene, score, reward):
    verdict = judge(original, stand, **scene)
    assert verdict.terminated
    np.testing.assert_array_equal(verdict.score, score)
    np.testing.assert_array_equal(verdict.reward, reward)


def test_events_tell_who_fell_and_who_was_out(by_team, stand):
    events = judge(by_team.arena, stand, low=(0,), red=OUT).events
    assert {name: each.tolist() for name, each in events.items()} == {"out": [False, True], "fall": [True, False]}


def test_the_ring_stays(by_team):
    assert by_team.arena.ring_radius(RING, jnp.asarray(30.0)) == 4.0


def wheels(arena, throttle, steering):
    command = arena.robots["red/0"].command(jnp.array([throttle, steering]))
    return command[0], command[4]


def test_actions_are_scaled_and_wheels_clamped(by_team):
    np.testing.assert_allclose(wheels(by_team.arena, 3.0, 2.0), [30.0, 0.2], rtol=1e-6)
    np.testing.assert_allclose(wheels(by_team.arena, -8.0, 9.0), [-50.0, 0.75], rtol=1e-6)


def test_without_the_clamp_wheels_turn_as_fast_as_asked(stand):
    np.testing.assert_allclose(wheels(with_defects(throttle_unclamped=True), -8.0, 9.0), [-80.0, 0.75], rtol=1e-6)


def test_the_quick_starts_actions_are_clipped(duel):
    np.testing.assert_allclose(wheels(duel.arena, 3.0, -2.0), [60.0, -0.6], rtol=1e-6)


def test_faithful_is_every_defect_and_its_steps_of_physics():
    before = arenas.settings("sumo-within-team")
    after = faithful(before)
    assert set(vars(after.rules.defects).values()) == {True}
    rules = replace(after.rules, defects=Defects(), heading="random", timestep=before.rules.timestep)
    assert replace(after, rules=rules) == before
    assert (after.rules.heading, after.rules.timestep) == ("fixed", 0.005)
    hashes = {replace(before, rules=rules).build(engine="c").config_hash for rules in (before.rules, after.rules)}
    assert len(hashes) == 2


@pytest.mark.parametrize("name", ["sumo-by-team", "sumo-within-team", "sumo-2v2-anymal", "sumo-1v1-leatherback"])
def test_the_papers_arenas_are_settings_of_one_game(name):
    settings = arenas.settings(name)
    assert settings.rules == PAPER
    assert type(settings) is type(arenas.settings("sumo-2v2"))
    arena = settings.build(engine="c")
    assert arena.timing.decisions == 1500
    assert arena.timing.control_interval == pytest.approx(0.02)
