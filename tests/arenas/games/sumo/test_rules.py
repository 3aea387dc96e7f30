"""Who has won: rovers put down by hand and judged, without a step of physics."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from arenas.games.sumo import SumoRules
from arenas.games.sumo.match import GameState
from tests.arenas.hooks import judging, observing

IN, OUT = (1.0, 0.5, 0.3), (1.2, 1.7, 0.0)  # 1.12 m and 2.08 m from the centre of a ring of 2 m
RING = GameState(jnp.asarray(2.0))
MATE = [(-0.5, -0.8, 0.0), (-0.5, 0.8, 1.0)]


def judge(arena, before, after):
    verdict = judging(arena)(before, after, RING)[1]
    assert not verdict.truncated  # time is part of the game: its end is a real end
    return verdict


@pytest.mark.parametrize(
    ("blue", "red", "flipped", "score", "reward"),
    [
        (IN, OUT, (), (1.0, 0.0), (1.0, -1.0)),
        (OUT, IN, (), (0.0, 1.0), (-1.0, 1.0)),
        (IN, IN, (3,), (1.0, 0.0), (1.0, -1.0)),  # red/1 lies on its back
        (IN, IN, (0,), (0.0, 1.0), (-1.0, 1.0)),
        (OUT, OUT, (), (0.5, 0.5), (0.0, 0.0)),
        (OUT, IN, (2,), (0.5, 0.5), (0.0, 0.0)),  # blue out and red flipped in one control step
    ],
)
def test_the_first_team_with_a_robot_outside_or_flipped_loses(brawl, stand, blue, red, flipped, score, reward):
    arena = brawl.arena
    poses = [blue, MATE[0], (red[0], -red[1], 0.0), MATE[1]]
    verdict = judge(arena, stand(arena, poses), stand(arena, poses, time=1.0, flipped=flipped))
    assert verdict.terminated
    np.testing.assert_array_equal(verdict.score, score)
    np.testing.assert_array_equal(verdict.reward, reward)


@pytest.mark.parametrize(("time", "over"), [(0.02, False), (5.0, False), (8.0, True)])
def test_what_counts_is_the_ring_as_it_is_now(brawl, stand, time, over):
    inside = stand(brawl.arena, [IN, MATE[0], (1.0, -0.5, 0.0), MATE[1]], time)  # 1.12 m out; 1.04 m are left at 8 s
    verdict = judge(brawl.arena, inside, inside)
    assert bool(verdict.terminated) is over
    np.testing.assert_array_equal(verdict.reward, [0.0, 0.0])


@pytest.mark.parametrize(("time", "over"), [(9.98, False), (10.0, True)])
def test_time_up_is_a_draw_that_costs_both_teams(duel, stand, time, over):
    near = stand(duel.arena, [(0.0, 0.05, 0.0), (0.0, -0.05, 0.0)], time)
    verdict = judge(duel.arena, near, near)
    assert bool(verdict.terminated) is over
    np.testing.assert_array_equal(verdict.reward, [-0.5, -0.5] if over else [0.0, 0.0])
    np.testing.assert_array_equal(verdict.score, [0.5, 0.5])


def test_a_ring_out_in_the_last_control_step_still_decides(duel, stand):
    last = stand(duel.arena, [(0.0, 0.1, 0.0), (0.0, 0.5, 0.0)], time=10.0)  # the ring is 0.4 m by now
    np.testing.assert_array_equal(judge(duel.arena, last, last).score, [1.0, 0.0])


def test_the_ring_shrinks_late_and_linearly(duel):
    times = jnp.array([0.0, 5.0, 6.25, 7.5, 10.0])
    radii = [duel.arena.ring_radius(RING, t) for t in times]
    np.testing.assert_allclose(radii, [2.0, 2.0, 1.6, 1.2, 0.4], rtol=1e-6)


def test_a_ring_that_shall_not_shrink_stays():
    settings = arenas.settings("sumo-1v1")
    arena = replace(settings, rules=replace(settings.rules, shrink_after=10.0)).build(engine="c")
    assert arena.ring_radius(RING, jnp.asarray(10.0)) == 2.0


def test_shaping_pays_metres_gained_and_metres_pushed(duel, stand):
    # Blue drives from 0.50 to 0.49 m, red is pushed from 0.90 to 0.91 m, both on the x axis, on opposite sides.
    before = stand(duel.arena, [(0.5, 0.0, 0.0), (-0.9, 0.0, 0.0)])
    after = stand(duel.arena, [(0.49, 0.0, 0.0), (-0.91, 0.0, 0.0)])
    # Their distance stays 1.4 m: nothing for the approach. Outwards: blue -0.01, red +0.01.
    np.testing.assert_allclose(judge(duel.arena, before, after).shaping, [0.02, -0.02], atol=1e-6)
    closer = stand(duel.arena, [(0.48, 0.0, 0.0), (-0.9, 0.0, 0.0)])
    # 0.02 m nearer to each other is 0.2 × 0.02 for both; 0.02 m inwards is worth 0.02 to blue and costs red as much.
    np.testing.assert_allclose(judge(duel.arena, before, closer).shaping, [0.024, -0.016], atol=1e-6)


def test_shaping_of_a_team_is_the_mean_over_its_robots(brawl, stand):
    before = stand(brawl.arena, [(0.5, 0.0, 0.0), (0.5, 1.0, 0.0), (-0.5, 0.0, 0.0), (-0.5, 1.0, 0.0)])
    after = stand(brawl.arena, [(0.48, 0.0, 0.0), (0.5, 1.0, 0.0), (-0.5, 0.0, 0.0), (-0.5, 1.0, 0.0)])
    # blue/0 goes 0.02 m inwards and nearer to red/0: per robot 0.01 m inwards for blue, 0.01 m gained on both sides.
    expected = [0.2 * 0.01 + 0.01, 0.2 * 0.01 - 0.01]
    np.testing.assert_allclose(judge(brawl.arena, before, after).shaping, expected, atol=1e-6)


def test_shaping_is_bounded_per_second(duel, stand):
    before, after = (stand(duel.arena, [(x, 0.0, 0.0), (-0.9, 0.0, 0.0)]) for x in (0.5, 0.2))
    np.testing.assert_allclose(judge(duel.arena, before, after).shaping, [0.04, -0.04], rtol=1e-6)  # 2 per s × 0.02 s


def test_rolling_over_the_edge_loses_the_match(duel, stand):
    arena = duel.arena
    physics = stand(arena, [(1.0, 0.0, 0.0), (-0.2, 0.0, 0.0)], velocity={0: (2.0, 0.0, 0.0)})
    state = duel.reset(jax.random.key(0)[None])
    moved = duel.place(state.physics, physics.qpos[None], physics.qvel[None], jnp.ones(1, bool))
    state = state._replace(physics=moved, game=GameState(jnp.full(1, 1.1)))
    for _ in range(10):
        state = duel.step(state, {name: jnp.array([[2.0, 0.0]]) for name in duel.idle(1)})
        if state.done[0]:
            break
    np.testing.assert_array_equal(state.verdict.score[0], [0.0, 1.0])
    np.testing.assert_array_equal(state.verdict.reward[0], [-1.0, 1.0])


@pytest.mark.parametrize(("size", "ring"), [(1, 0.85), (2, 1.4), (3, 1.9), (4, 2.5)])
def test_rings_without_room_for_the_start_are_refused(size, ring):
    settings, team = arenas.settings("sumo-2v2"), ("leatherback",) * size
    with pytest.raises(ValueError, match=rf"^rules.ring: .* ring of {ring} m; it must begin at \d.\d+ m"):
        replace(settings, blue=team, red=team, rules=SumoRules(ring=(ring, 3.0)))


@pytest.mark.parametrize(
    ("rule", "message"), [({"ring": (2.0, 1.0)}, "^ring: .* smallest <= largest"), ({"timestep": 0.015}, "^timestep: ")]
)
def test_rules_that_contradict_themselves_are_refused(rule, message):
    with pytest.raises(ValueError, match=message):
        SumoRules(**rule)


def test_hand_placed_rovers_stand_as_told(duel, stand):
    physics = stand(duel.arena, [(0, 0, math.pi / 3), (1, 0, 0.5)], flipped=(1,))
    seen = observing(duel.arena)(physics, RING, {"blue/0": jnp.zeros(2), "red/0": jnp.zeros(2)})
    np.testing.assert_allclose([seen[name][10] for name in seen], [1.0, -1.0], atol=1e-6)
