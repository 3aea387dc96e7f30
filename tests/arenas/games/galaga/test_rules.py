"""3D Galaga: who is hit, who has arrived, who wins. Tanks and drones are put down by hand and judged."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.arenas.galaga_worlds import PIVOT, ending, game, judged, put, variant

FAR = (9.0, 9.0, 9.0)  # a goal that nobody is near
AWAY = (0.0, math.pi)  # a barrel that points to -x, level


@pytest.fixture(scope="module")
def duel():
    return variant("galaga-1v1")


@pytest.fixture(scope="module")
def pairs():
    return variant("galaga-2v2")


def quaternion(elevation, azimuth):
    """The shortest turn from +x to a direction, as HARL-A has it: by the angle acos(v_x) about x cross v."""
    way = np.array(towards(elevation, azimuth, 1.0)) - [0.0, 0.0, PIVOT]
    axis = np.cross([1.0, 0.0, 0.0], way)
    half = math.acos(way[0]) / 2
    return np.array([math.cos(half), *(math.sin(half) * axis / np.linalg.norm(axis))])


def gap(one, other):
    a, b = quaternion(*one), quaternion(*other)
    return min(np.abs(a - b).sum(), np.abs(a + b).sum())


def towards(elevation, azimuth, far=8.0):
    """A point that a tank at the origin sees in that direction."""
    level = far * math.cos(elevation)
    return level * math.cos(azimuth), level * math.sin(azimuth), PIVOT + far * math.sin(elevation)


# Hits -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", [(0.5, 0.3), (0.2, -2.0), (0.9, 3.0), (1.2, 1.5)])
@pytest.mark.parametrize("aside", [(1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
def test_a_drone_is_hit_when_the_quaternions_are_near_enough(duel, way, aside):
    near, far = 0.0, 0.2
    for _ in range(40):  # the error in rad of which the L1 distance is 0.05
        middle = (near + far) / 2
        off = way[0] + middle * aside[0], way[1] + middle * aside[1]
        near, far = (middle, far) if gap(way, off) < 0.05 else (near, middle)
    for share, hit in ((0.97, True), (1.03, False)):
        barrel = tuple(w + share * near * a for w, a in zip(way, aside, strict=True))
        after, verdict = judged(duel, put(duel, [towards(*way)], barrels=[barrel]), game([FAR]))
        assert bool(verdict.events["capture"][0]) == hit
        assert bool(after.alive[0]) == (not hit)
        assert ending(verdict) == ("tanks" if hit else "")


@pytest.mark.parametrize(
    ("drone", "hit"),
    [
        ((6.0, 0.0, PIVOT + 1.49), True),  # the barrel is level and points to +x
        ((6.0, 0.0, PIVOT + 1.51), False),
        ((50.0, 1.0, PIVOT + 1.0), True),  # the ray has no end,
        ((-1.0, 0.0, PIVOT + 1.0), True),  # and a beginning: behind it counts the way to the pivot
        ((-1.2, 0.0, PIVOT + 1.0), False),
    ],
)
def test_a_drone_is_hit_when_the_ray_passes_near(pairs, drone, hit):
    physics = put(pairs, [drone, (-9.0, 4.0, 3.0)], ((0.0, 0.0), (0.0, -4.0)), ((0.0, 0.0), AWAY))
    after, verdict = judged(pairs, physics, game([FAR, FAR]))
    assert after.alive.tolist() == [not hit, True]
    assert verdict.events["capture"].tolist() == [hit, False]


@pytest.mark.parametrize(("beyond", "hit"), [(0.85, True), (0.87, False)])
def test_a_barrel_that_is_held_up_covers_its_own_goal(pairs, beyond, hit):
    """Who is within 0.5 m of the goal has come 0.86 m through the ray: unseen only at 43 m/s, in one control step."""
    up = 1.5  # rad, as far as it goes
    away = np.array([-math.sin(up), 0.0, math.cos(up)])  # from the ray, to where the goal reaches farthest
    drone = (0.5 + beyond) * away + [0.0, 0.0, 2.05]
    physics = put(pairs, [tuple(drone), (-9.0, 4.0, 3.0)], ((0.0, 0.0), (0.0, -4.0)), ((up, 0.0), AWAY))
    assert judged(pairs, physics, game([(0.0, 0.0, 2.05), FAR]))[0].alive.tolist() == [not hit, True]


def test_any_tank_hits_any_drone(pairs):
    physics = put(pairs, [(-5.0, 0.0, 3.0), (6.0, 3.0, 1.0)], ((0.0, -3.0), (0.0, 3.0)), ((0.0, 0.0), (0.0, 0.0)))
    assert judged(pairs, physics, game([FAR, FAR]))[0].alive.tolist() == [True, False]
    physics = put(pairs, [(-5.0, 0.0, 3.0), (6.0, 3.0, 1.0)], ((0.0, 3.0), (0.0, -3.0)), ((0.0, 0.0), (0.0, 0.0)))
    assert judged(pairs, physics, game([FAR, FAR]))[0].alive.tolist() == [True, False]


@pytest.mark.parametrize(("height", "crash"), [(0.24, True), (0.26, False)])
def test_a_drone_that_comes_too_low_is_dead(pairs, height, crash):
    physics = put(pairs, [(-6.0, 0.0, height), (-6.0, 2.0, 3.0)], ((3.0, 1.0), (3.0, -1.0)), ((0.0, 0.0),) * 2)
    after, verdict = judged(pairs, physics, game([FAR, FAR]))
    assert after.alive.tolist() == [not crash, True]
    assert verdict.events["crash"].tolist() == [False, crash]
    assert ending(verdict) == ""


def test_alone_a_drone_may_lie_on_the_ground(duel):
    after, verdict = judged(duel, put(duel, [(-6.0, 0.0, 0.015)]), game([FAR]))
    assert after.alive[0]
    assert ending(verdict) == ""


# Goals ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("off", "reached"), [(0.19, True), (0.21, False)])
def test_a_drone_near_its_goal_has_won(duel, off, reached):
    after, verdict = judged(duel, put(duel, [(-4.0, 3.0, 4.0 + off)]), game([(-4.0, 3.0, 4.0)]))
    assert bool(after.reached[0]) == reached
    assert ending(verdict) == ("drones" if reached else "")
    assert verdict.events["goal"].tolist() == [False, reached]


def test_the_goal_of_a_drone_is_above_the_tank_of_its_number_now(pairs):
    tanks = ((3.0, 1.0), (5.0, -2.0))
    physics = put(pairs, [(-6.0, 0.0, 3.0), (5.0, -2.0, 2.5)], tanks, ((0.0, 0.0),) * 2)
    after, verdict = judged(pairs, physics, game([FAR, FAR]))
    np.testing.assert_allclose(after.goals, [(3.0, 1.0, 2.05), (5.0, -2.0, 2.05)], atol=1e-6)
    assert ending(verdict) == "drones"
    swapped = put(pairs, [(5.0, -2.0, 2.5), (-6.0, 0.0, 3.0)], tanks, ((0.0, 0.0),) * 2)
    assert ending(judged(pairs, swapped, game([FAR, FAR]))[1]) == ""  # that is the other's goal


def test_goals_and_targets_go_round_where_teams_are_unequal():
    arena = variant("galaga-2v2", tanks=2, drones=3)
    goals = jax.jit(arena.place)(jax.random.key(0))[2].goals
    np.testing.assert_allclose(goals[2], goals[0], atol=1e-6)
    assert not np.allclose(goals[1], goals[0])
    many = variant("galaga-2v2", tanks=3, drones=2)
    assert many._targets(jnp.array([True, True])).tolist() == [0, 1, 0]


# The dead -------------------------------------------------------------------------------------------------------------


def test_the_dead_stay_dead_and_are_paid_for_once(pairs):
    ray = put(pairs, [(6.0, 0.0, 1.0), (-6.0, 0.0, 3.0)], ((0.0, 0.0), (0.0, -4.0)), ((0.0, 0.0), AWAY))
    shot, verdict = judged(pairs, ray, game([FAR, FAR]))
    np.testing.assert_allclose(verdict.rewards["hit"], [1.0, 0.0])
    again, verdict = judged(pairs, ray, shot)
    assert not verdict.rewards["hit"].any()
    assert not verdict.events["capture"].any()
    free = put(pairs, [(6.0, 4.0, 3.0), (-6.0, 0.0, 3.0)], ((0.0, 0.0), (0.0, -4.0)), ((0.0, 0.0), AWAY))
    later, verdict = judged(pairs, free, again)
    assert later.alive.tolist() == [False, True]
    assert pairs.alive(free, later).tolist() == [True, True, False, True]


def test_the_dead_cannot_arrive_and_give_no_hints(pairs):
    above = put(pairs, [(3.0, 1.0, 2.05), (-6.0, 0.0, 3.0)], ((3.0, 1.0), (3.0, -1.0)), ((0.0, 0.0),) * 2)
    before = put(pairs, [(0.0, 1.0, 2.05), (-6.0, 0.0, 3.0)], ((3.0, 1.0), (3.0, -1.0)), ((0.0, 0.0),) * 2)
    goals = [(3.0, 1.0, 2.05), (3.0, -1.0, 2.05)]
    after, verdict = judged(pairs, above, game(goals, alive=[False, True]), before)
    assert not after.reached.any()
    assert ending(verdict) == ""
    assert not verdict.rewards["goal"].any()
    assert float(verdict.shapings["approach"][1]) == 0.0
    assert float(judged(pairs, above, game(goals), before)[1].shapings["approach"][1]) == pytest.approx(0.05 * 3.0 / 2)


def test_a_tank_is_shown_the_next_that_lives(pairs):
    drones = [(-6.0, 2.0, 3.0), (-5.0, -2.0, 3.0)]
    physics = put(pairs, drones, ((3.0, 1.0), (3.0, -1.0)), ((0.0, 0.0),) * 2)
    still = {name: jnp.zeros(robot.action_size) for name, robot in pairs.robots.items()}
    observe = jax.jit(pairs.observe)
    for alive, shown in (([True, True], (0, 1)), ([False, True], (1, 1)), ([True, False], (0, 0))):
        seen = observe(physics, game([FAR, FAR], alive=alive), still)
        for k, tank in enumerate(((3.0, 1.0, 0.05), (3.0, -1.0, 0.05))):
            np.testing.assert_allclose(seen[f"blue/{k}"][10:13], np.subtract(drones[shown[k]], tank), atol=1e-5)


@pytest.fixture(scope="module")
def stepping(pairs):
    """A decision, and the state of a world in which drone 0 is dead in the air."""
    state = jax.jit(pairs.reset)(jax.random.key(3))
    dead = state._replace(
        game=state.game._replace(alive=jnp.array([False, True])), alive=jnp.array([True, True, False, True])
    )
    return jax.jit(pairs.step), dead


def test_what_a_dead_drone_does_changes_nothing(pairs, stepping):
    step, state = stepping
    still = {agent.name: jnp.zeros(agent.action_size) for agent in pairs.agents}
    for action in (jnp.ones(4), jnp.full(4, jnp.nan)):
        one, other = step(state, still), step(state, still | {"red/0": action})
        for ours, theirs in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
            np.testing.assert_array_equal(np.asarray(ours), np.asarray(theirs))
    assert not one.observations["red/0"].any()
    assert one.observations["red/1"].any()
    alive = step(state, still | {"red/1": jnp.ones(4)})
    assert not np.array_equal(alive.physics.qpos, one.physics.qpos)


@pytest.mark.parametrize(("defects", "weights"), [((), 0.0), (("drift",), 0.95)])
def test_a_dead_drone_falls_and_drifts_where_that_is_reproduced(pairs, stepping, defects, weights):
    state = stepping[1]
    arena = variant("galaga-2v2", defects) if defects else pairs
    full = {agent.name: jnp.ones(agent.action_size) for agent in pairs.agents}
    after = jax.jit(arena.step)(state, full)
    speed = after.physics.qvel[pairs.scene.agents["red/0"].qvel + 2]
    assert float(speed) == pytest.approx(-9.81 * (1 - weights) * 0.02, rel=0.01)


# Wins -----------------------------------------------------------------------------------------------------------------


ABOVE, ASIDE = (3.0, 1.0, 2.05), (-6.0, 2.0, 3.0)  # at drone 0's goal, and nowhere
UP = (1.4, 0.0)  # a barrel that points at what is above its tank


@pytest.mark.parametrize(
    ("drones", "barrels", "alive", "end", "hit", "goal", "loss"),
    [
        ((ASIDE, (-6.0, 0.0, 0.2)), (0.0, 0.0), [True, True], "", 1, 0, (0, 0)),
        ((ASIDE, (-6.0, 0.0, 0.2)), (0.0, 0.0), [False, True], "tanks", 1, 0, (0, -1)),
        ((ABOVE, (-6.0, 0.0, 0.2)), (0.0, 0.0), [True, True], "drones", 1, 1, (-1, 0)),
        ((ABOVE, ASIDE), UP, [True, True], "drones", 1, 1, (-1, 0)),  # hit as it arrives, and one is left
        ((ABOVE, ASIDE), UP, [True, False], "draw", 1, 1, (0, 0)),  # and none is left
    ],
)
def test_who_wins_and_who_is_paid(pairs, drones, barrels, alive, end, hit, goal, loss):
    physics = put(pairs, drones, ((3.0, 1.0), (3.0, -3.0)), (barrels, (0.0, 0.0)))
    verdict = judged(pairs, physics, game([FAR, FAR], alive=alive))[1]
    assert ending(verdict) == end
    np.testing.assert_allclose(verdict.rewards["hit"], [hit, 0.0])
    np.testing.assert_allclose(verdict.rewards["goal"], [0.0, goal])
    np.testing.assert_allclose(verdict.rewards["loss"], loss)


@pytest.mark.parametrize(
    ("alive", "reached", "end"),
    [
        ([True, True], [False, False], ""),
        ([True, True], [True, False], "drones"),  # the second arrives now
        ([False, True], [False, False], "tanks"),  # two cannot arrive any more
        ([False, True], [True, False], "drones"),  # who has arrived may be shot
    ],
)
def test_the_rules_may_ask_for_more_goals(alive, reached, end):
    arena = variant("galaga-2v2", goals=2)
    second = (3.0, -3.0, 2.05) if any(reached) else ASIDE
    physics = put(arena, ((-6.0, 0.0, 3.0), second), ((3.0, 1.0), (3.0, -3.0)), ((0.0, 0.0),) * 2)
    assert ending(judged(arena, physics, game([FAR, FAR], alive=alive, reached=reached))[1]) == end


@pytest.mark.parametrize(
    ("timeout", "end", "score"), [("draw", "cut", 0.5), ("tanks", "tanks", 1.0), ("drones", "drones", 0.0)]
)
@pytest.mark.parametrize("name", ["galaga-1v1", "galaga-2v2"])
def test_no_time_left_is_cut_off_or_an_outcome(name, timeout, end, score):
    arena = variant(name, timeout=timeout)
    count = len(arena.drones)
    goals = [FAR] * count
    drones = [(-6.0, 2.0 - k, 3.0) for k in range(count)]
    tanks = ((3.0, 1.0), (3.0, -3.0))[:count]
    level = ((0.0, 0.0),) * count
    early = judged(arena, put(arena, drones, tanks, level, time=19.98), game(goals))[1]
    late = judged(arena, put(arena, drones, tanks, level, time=20.0), game(goals))[1]
    assert ending(early) == ""
    assert ending(late) == end
    assert late.score.tolist() == [score, 1.0 - score]
    assert not any(term.any() for term in late.rewards.values())


# Defects --------------------------------------------------------------------------------------------------------------


def test_a_late_end_pays_a_drone_twice_and_a_tank_once():
    arena = variant("galaga-1v1", ["late_end"])
    there = put(arena, [(-4.0, 3.0, 4.0)])
    first, verdict = judged(arena, there, game([(-4.0, 3.0, 4.1)]))
    assert (ending(verdict), float(verdict.rewards["goal"][1])) == ("", 1.0)
    verdict = judged(arena, there, first)[1]
    assert (ending(verdict), float(verdict.rewards["goal"][1])) == ("drones", 1.0)
    aimed = put(arena, [towards(0.5, 0.3)], barrels=[(0.5, 0.3)])
    first, verdict = judged(arena, aimed, game([FAR]))
    assert (ending(verdict), float(verdict.rewards["hit"][0])) == ("", 1.0)
    verdict = judged(arena, aimed, first)[1]
    assert (ending(verdict), float(verdict.rewards["hit"][0])) == ("tanks", 0.0)


def test_a_drone_that_leaves_the_ray_lives_again():
    arena = variant("galaga-2v2", ["revive"])
    physics = put(arena, [(-6.0, 2.0, 3.0), (-6.0, 0.0, 3.0)], ((3.0, 1.0), (3.0, -3.0)), ((0.0, 0.0),) * 2)
    after, verdict = judged(arena, physics, game([FAR, FAR], alive=[False, True]))
    assert after.alive.all()
    assert ending(verdict) == ""
    assert arena._targets(jnp.array([False, True])).tolist() == [0, 1]  # and its tank aims at it all along


def test_the_dead_may_be_paid_for_in_every_step():
    arena = variant("galaga-2v2", ["paid_while_dead"])
    physics = put(arena, [(-6.0, 2.0, 3.0), (-6.0, 0.0, 3.0)], ((3.0, 1.0), (3.0, -3.0)), ((0.0, 0.0),) * 2)
    verdict = judged(arena, physics, game([FAR, FAR], alive=[False, True]))[1]
    np.testing.assert_allclose(verdict.rewards["hit"], [1.0, 0.0])
