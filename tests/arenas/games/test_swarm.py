"""Swarm: who is caught, who is through, who wins, and what numbers can play. By hand on the C engine."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arenas.contract.check import check_arena
from arenas.contract.check_run import WORLDS
from arenas.games.pursuit.swarm.match import GameState, Swarm
from arenas.games.pursuit.swarm.observation import read
from arenas.games.pursuit.swarm.settings import SwarmReward, SwarmRules, SwarmSettings
from tests.arenas.hooks import judging, observing
from tests.arenas.placing import put

SMALL = SwarmSettings(pucks=3, rovers=1)  # two must reach the zone of 0.8 m; the rover reaches 0.5 m
APART = {"swarm/0": (3.0, 0.0), "swarm/1": (0.0, 3.0), "swarm/2": (-3.0, 0.0), "guards/0": (0.0, -3.0)}


@pytest.fixture(scope="module")
def swarm() -> Swarm:
    return SMALL.build(engine="c", threads=1)


def state(free=(True, True, True), through=(False, False, False)) -> GameState:
    return GameState(jnp.array(free), jnp.array(through))


def judged(arena, game, places, time=2.0, before=None):
    now = put(arena, {**APART, **places}, time)
    return judging(arena)(put(arena, {**APART, **before}, time) if before else now, now, game)


@pytest.mark.parametrize(("gap", "caught"), [(0.499, True), (0.501, False)])
def test_a_puck_in_reach_of_a_rover_is_caught_and_out(swarm, gap, caught):
    game, verdict = judged(swarm, state(), {"swarm/1": (gap, -3.0)})
    assert game.free.tolist() == [True, not caught, True]
    assert not game.through.any()
    assert verdict.events["capture"].tolist() == [False, caught]
    np.testing.assert_allclose(verdict.rewards["caught"], [-caught / 3, caught / 3], rtol=1e-6)
    assert swarm.alive(put(swarm, APART), game).tolist() == [True, not caught, True, True]
    assert not verdict.terminated


@pytest.mark.parametrize(("far", "arrives"), [(0.799, True), (0.801, False)])
def test_a_puck_that_reaches_the_zone_counts_and_is_out(swarm, far, arrives):
    game, verdict = judged(swarm, state(), {"swarm/0": (0.0, far)})
    assert game.through.tolist() == [arrives, False, False]
    assert game.free.tolist() == [not arrives, True, True]
    assert verdict.events["through"].tolist() == [arrives, False]
    np.testing.assert_allclose(verdict.rewards["through"], [arrives / 3, -arrives / 3], rtol=1e-6)


def test_a_puck_in_reach_within_the_zone_is_caught_and_one_that_is_out_neither_reaches_nor_is_caught(swarm):
    game, _ = judged(swarm, state(), {"swarm/0": (0.0, 0.7), "guards/0": (0.0, 0.3)})
    assert (game.free.tolist(), game.through.tolist()) == ([False, True, True], [False, False, False])
    game, verdict = judged(swarm, game, {"swarm/0": (0.0, 0.1)})
    assert (game.free.tolist(), game.through.tolist()) == ([False, True, True], [False, False, False])
    assert not any(term.any() for term in verdict.rewards.values())


@pytest.mark.parametrize(
    ("free", "through", "places", "time", "score"),
    [
        ((True, True, False), (False, False, True), {"swarm/0": (0.5, 0.0)}, 2.0, (1, 0)),  # the second of two
        ((True, True, False), (False, False, True), {}, 2.0, None),
        ((True, True, False), (False, False, False), {"swarm/0": (0.3, -3.0)}, 2.0, (0, 1)),  # one is left
        ((True, False, False), (False, False, True), {}, 2.0, None),  # one is through and one may be
        ((True, True, True), (False, False, False), {}, 15.0, (0, 1)),
        ((True, True, False), (False, False, True), {"swarm/0": (0.5, 0.0)}, 15.0, (1, 0)),  # in the last step
    ],
)
def test_half_of_the_pucks_win_and_the_guards_when_that_is_out_of_reach_or_time_is_up(
    swarm, free, through, places, time, score
):
    _, verdict = judged(swarm, state(free, through), places, time)
    assert (bool(verdict.terminated), bool(verdict.truncated)) == (score is not None, False)
    win = verdict.rewards["win"].tolist()
    if score is None:
        assert win == [0, 0]
    else:
        assert verdict.score.tolist() == list(score)
        assert win == [2 * each - 1 for each in score]


def test_metres_nearer_to_the_zone_are_a_hint_mean_over_the_pucks_in_the_game(swarm):
    before, after = {"swarm/0": (3.0, 0.0), "swarm/2": (-3.0, 0.0)}, {"swarm/0": (2.8, 0.0), "swarm/2": (-1.0, 0.0)}
    _, verdict = judged(swarm, state(free=(True, True, False)), after, before=before)
    np.testing.assert_allclose(verdict.shapings["approach"], [0.1, -0.1], atol=1e-6)


def seen(arena, places, game):
    physics = put(arena, {**APART, **places})
    return observing(arena)(physics, game, {name: jnp.zeros(2) for name in arena.robots})


def test_others_are_seen_in_blocks_with_a_flag_and_zeros_once_they_are_out(swarm):
    found = seen(swarm, {}, state(free=(True, True, False), through=(False, False, True)))
    view = read(found["swarm/0"], "puck", SMALL)
    np.testing.assert_allclose(view.zone, [-3, 0])
    np.testing.assert_allclose(view.pucks, [[-3, 3, 0, 0, 1], [0, 0, 0, 0, 0]])
    np.testing.assert_allclose(view.rovers, [[-3, -3, 0, 0, 1, 0, 1]])
    np.testing.assert_allclose(found["swarm/0"][4:7], [0.5, 0.0, 1 / 15], rtol=1e-6)
    np.testing.assert_allclose(read(found["guards/0"], "leatherback", SMALL).pucks[:, :2], [[3, 3], [0, 6], [0, 0]])


def test_the_sets_that_networks_may_encode_are_the_blocks(swarm):
    found = seen(swarm, {}, state())
    for agent, kind in (("swarm/1", "puck"), ("guards/0", "leatherback")):
        sets = {each.name: found[agent][np.array(each.places, int)] for each in swarm.observation_entities(agent)}
        view = read(found[agent], kind, SMALL)
        wanted = {"pucks": view.pucks, "leatherbacks": view.rovers}
        assert set(sets) == {name for name, blocks in wanted.items() if len(blocks)}
        for name, blocks in sets.items():
            np.testing.assert_allclose(blocks, wanted[name], err_msg=name)


def test_a_rover_sees_in_its_own_heading(swarm):
    physics = put(swarm, APART)
    at = swarm.scene.agents["guards/0"].qpos
    physics = physics._replace(qpos=physics.qpos.at[at + 3 : at + 7].set(jnp.sqrt(jnp.array([0.5, 0, 0, 0.5]))))
    found = observing(swarm)(physics, state(), {name: jnp.zeros(2) for name in swarm.robots})["guards/0"]
    np.testing.assert_allclose(found[2:4], [3, 0], atol=1e-5)  # the zone is to the north, which is ahead
    np.testing.assert_allclose(found[7:9], [0, 1], atol=1e-6)
    np.testing.assert_allclose(read(found, "leatherback", SMALL).pucks[0], [3, -3, 0, 0, 1], atol=1e-5)


def test_with_room_for_more_a_robot_sees_the_same_whatever_the_numbers():
    two = replace(SMALL, pucks=2, rovers=2, room_pucks=3, room_rovers=3)
    three = replace(two, pucks=3, rovers=3)
    assert two.outline().teams["swarm"][0] == three.outline().teams["swarm"][0]
    few, many = (each.build(engine="c", threads=1) for each in (two, three))
    places = {**APART, "guards/1": (1.0, 2.0)}
    one = seen(few, places, GameState(jnp.ones(2, bool), jnp.zeros(2, bool)))["swarm/0"]
    all_ = read(seen(many, places, state())["swarm/0"], "puck", three)
    np.testing.assert_allclose(read(one, "puck", two).pucks, [all_.pucks[0], np.zeros(5)])
    np.testing.assert_allclose(read(one, "puck", two).rovers, [*all_.rovers[:2], np.zeros(7)])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"room_pucks": 4}, "room_pucks: 4 is fewer than play, 8; give 8 or more, or none"),
        ({"rules": SwarmRules(side=4.0)}, r"too narrow for 8 pucks and 2 rovers .* it must be 4\.4 m or more"),
    ],
)
def test_numbers_that_cannot_be_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        replace(SwarmSettings(), **given)


@pytest.mark.slow
def test_it_keeps_the_contract():
    short = replace(SMALL, room_rovers=2, rules=SwarmRules(episode=1.0))
    assert [check for check in check_arena(short.build(engine="c", worlds=WORLDS), short) if not check.ok] == []


def test_pucks_pass_through_rovers_and_not_through_each_other_or_walls(swarm):
    model = swarm.scene.model

    def touch(one: str, other: str) -> bool:
        a, b = (model.geom(name).id for name in (one, other))
        bits = (model.geom_contype[a] & model.geom_conaffinity[b]) | (model.geom_contype[b] & model.geom_conaffinity[a])
        return bool(bits)

    assert not touch("swarm/0/puck", "guards/0/chassis")
    assert touch("swarm/0/puck", "swarm/1/puck")
    assert touch("swarm/0/puck", "north/wall")
    assert touch("guards/0/chassis", "north/wall")


@pytest.mark.slow
@pytest.mark.parametrize(("swarm_script", "guards_script", "low", "high"), [("sprinter", "idle", 0.99, 1.0)])
def test_scripts_play_as_they_are_described(swarm_script, guards_script, low, high):
    arena = SwarmSettings(pucks=4, reward=SwarmReward()).build(engine="c", worlds=16)
    scripts = arena.scripts()

    def decide(world, key):
        names = {"puck": swarm_script, "leatherback": guards_script}
        actions = {a.name: scripts[names[a.kind]][a.kind](world.observations[a.name], key) for a in arena.agents}
        return arena.step(world, actions), None

    def episode(key):
        return jax.lax.scan(decide, arena.reset(key), jax.random.split(key, arena.timing.decisions))[0]

    end = jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(0), 16))
    assert low <= float(end.verdict.score[:, 0].mean()) <= high
