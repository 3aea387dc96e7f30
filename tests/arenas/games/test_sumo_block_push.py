"""Sumo's second stage: who has won, what is paid, what is seen, where all start. Robots and blocks are put by hand."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import ks_2samp

import arenas
from arenas.games.sumo.block import AGENTS, BLOCKS, BlockPush, GameState
from arenas.games.sumo.settings import KINDS
from arenas.games.sumo.stages import BlockPushReward, BlockPushRules, BlockPushSettings
from arenas.physics.engine import Physics
from arenas.robots.anymal import REST_HEIGHT
from arenas.robots.leatherback import WHEEL_RADIUS
from tests.arenas.conftest import Worlds
from tests.arenas.hooks import judging, observing

DT = 0.02  # s
RING = GameState(jnp.asarray(3.0))
IN = ((1.0, 0.5), (-1.0, -0.5)), ((0.5, 1.5), (-0.5, -1.5))  # robots, blocks: blue's, red's


@pytest.fixture(scope="session")
def rovers() -> BlockPush:
    return arenas.load("block-push-leatherback", engine="c")


@pytest.fixture(scope="session")
def anymals() -> BlockPush:
    return arenas.load("block-push-anymal", engine="c")


def put(arena, robots=IN[0], blocks=IN[1], time=1.0, heading=(0.0, 0.0), height=None, flipped=()):
    """Everything as it stands at these places (x, y); `flipped` robots lie on their backs."""
    model, scene = arena.scene.model, arena.scene
    qpos = scene.rest.copy()
    for i, agent in enumerate(AGENTS):
        at, half = scene.agents[agent].qpos, heading[i] / 2
        quat = [0, 1, 0, 0] if i in flipped else [math.cos(half), 0, 0, math.sin(half)]
        qpos[at : at + 7] = [*robots[i], arena.robot.rest_height if height is None else height, *quat]
        block = scene.props[BLOCKS[i]].qpos
        qpos[block : block + 2] = blocks[i]
    total_size = (jnp.asarray(x, jnp.float32) for x in (qpos, np.zeros(model.nv), np.zeros(model.nu), time))
    return Physics(*total_size, causes=jnp.zeros((), jnp.uint8), carry=())


def judge(arena, before, after):
    return judging(arena)(before, after, RING)[1]


# Ends -----------------------------------------------------------------------------------------------------------------

OUT = (2.9, 0.9)  # 3.04 m from the centre
# what is out: blue's block, red's block, blue, red; and the score and reward of both
ENDS = [
    ((True, False, False, False), (1.0, 0.0), (10, 0)),
    ((False, True, False, False), (0.0, 1.0), (0, 10)),
    ((False, False, True, False), (0.0, 1.0), (-10, 0)),
    ((False, False, False, True), (1.0, 0.0), (0, -10)),
    ((True, True, False, False), (0.5, 0.5), (10, 10)),
    ((True, False, True, False), (0.5, 0.5), (0, 0)),  # out together with the own block
    ((True, False, False, True), (1.0, 0.0), (10, -10)),
    ((False, False, True, True), (0.5, 0.5), (-10, -10)),
]


@pytest.mark.parametrize("arena", ["rovers", "anymals"])
@pytest.mark.parametrize(("out", "score", "paid"), ENDS)
def test_the_own_block_out_wins_and_the_own_robot_out_loses(arena, out, score, paid, request):
    arena = request.getfixturevalue(arena)
    blocks = [OUT if gone else at for gone, at in zip(out[:2], IN[1], strict=True)]
    robots = [(-x, -y) if gone else at for gone, at, (x, y) in zip(out[2:], IN[0], (OUT, OUT), strict=True)]
    verdict = judge(arena, put(arena), put(arena, robots, blocks))
    assert verdict.terminated
    assert not verdict.truncated
    np.testing.assert_array_equal(verdict.score, score)
    np.testing.assert_array_equal(verdict.rewards["block_out"] + verdict.rewards["robot_out"], paid)
    np.testing.assert_array_equal(verdict.events["block_out"], out[:2])
    np.testing.assert_array_equal(verdict.events["out"], out[2:])


@pytest.mark.parametrize(("arena", "time"), [("rovers", 30.0), ("anymals", 20.0)])
def test_time_up_is_a_draw_that_cuts_the_game_off(arena, time, request):
    arena = request.getfixturevalue(arena)
    assert not judge(arena, put(arena), put(arena, time=time - DT)).truncated
    late = judge(arena, put(arena), put(arena, time=time))
    assert late.truncated
    assert not late.terminated
    np.testing.assert_array_equal(late.score, [0.5, 0.5])
    np.testing.assert_array_equal(late.rewards["robot_out"], [0.0, 0.0])
    last = judge(arena, put(arena), put(arena, blocks=(OUT, IN[1][1]), time=time))
    assert last.terminated
    assert not last.truncated


@pytest.mark.parametrize(("height", "fallen"), [(0.17, False), (0.155, True)])
def test_an_anymal_whose_centre_of_mass_is_below_17_cm_has_fallen(anymals, height, fallen):
    """It is 8.5 mm above the base's origin."""
    low = put(anymals, height=height)
    verdict = judge(anymals, put(anymals), low)
    assert bool(verdict.terminated) is fallen
    np.testing.assert_array_equal(verdict.events["fall"], [fallen] * 2)


@pytest.mark.parametrize(
    ("falls", "score", "paid"), [("lose", (1.0, 0.0), (0.0, -10.0)), ("end", (0.5, 0.5), (0.0, 0.0))]
)
def test_a_fall_loses_or_as_in_harl_a_only_ends_the_game(falls, score, paid):
    settings = BlockPushSettings(rules=BlockPushRules(falls=falls))
    arena = settings.build(engine="c")
    verdict = judge(arena, put(arena), put(arena, flipped=(1,)))
    assert verdict.terminated
    np.testing.assert_array_equal(verdict.score, score)
    np.testing.assert_array_equal(verdict.rewards["robot_out"], paid)


# Rewards --------------------------------------------------------------------------------------------------------------


def test_dense_terms_are_harl_as_by_number(rovers):
    verdict = judge(rovers, put(rovers), put(rovers))
    blocks = math.hypot(0.5, 1.5, 0.2)  # from the centre, on the ground, to the block's own
    apart = math.hypot(0.5, 1.0, 0.2 - 0.052)
    np.testing.assert_allclose(verdict.rewards["block"], [DT * math.tanh(blocks / 5)] * 2, rtol=1e-5)
    np.testing.assert_allclose(verdict.rewards["near"], [DT * (1 - math.tanh(apart / 5))] * 2, rtol=1e-5)
    np.testing.assert_allclose(verdict.rewards["time"], [-0.01, -0.01])
    assert set(verdict.rewards) == {"block_out", "robot_out", "block", "near", "time"}
    np.testing.assert_array_equal(verdict.shaping, [0.0, 0.0])


def test_an_anymals_terms_have_its_own_ring_and_no_price_of_time(anymals):
    verdict = judge(anymals, put(anymals), put(anymals))
    np.testing.assert_allclose(
        verdict.rewards["block"], [DT * math.tanh(math.hypot(0.5, 1.5, 0.2) / 5.5)] * 2, rtol=1e-5
    )
    np.testing.assert_array_equal(verdict.rewards["time"], [0.0, 0.0])


def test_hints_pay_metres(rovers):
    """Blue's block moves from 1.0 to 1.1 m, away from blue, and red comes 0.2 m nearer to its own."""
    blocks = ((1.0, 0.0), (-2.0, 0.0))
    before = put(rovers, ((0.0, 0.0), (0.0, 0.0)), blocks, height=0.2)
    after = put(rovers, ((0.0, 0.0), (-0.2, 0.0)), ((1.1, 0.0), (-2.0, 0.0)), height=0.2)
    verdict = judge(rovers, before, after)
    np.testing.assert_allclose(verdict.shapings["approach"], [0.5 * -0.1, 0.5 * 0.2], rtol=1e-4)
    np.testing.assert_allclose(verdict.shapings["push"], [0.1, 0.0], rtol=1e-4)


def test_every_weight_scales_its_own_term(rovers):
    reward = BlockPushReward(**dict.fromkeys(("block_out", "robot_out", "block", "near", "time"), 0.0), push=3.0)
    arena = replace(arenas.settings("block-push-leatherback"), reward=reward).build(engine="c")
    verdict = judge(arena, put(arena), put(arena, blocks=((1.0, 1.5), (-0.5, -1.5))))
    np.testing.assert_array_equal(verdict.reward, [0.0, 0.0])
    gained = math.hypot(1.0, 1.5) - math.hypot(0.5, 1.5)
    np.testing.assert_allclose(verdict.shapings["push"], [3 * gained, 0.0], rtol=1e-5)


# Sight and start ------------------------------------------------------------------------------------------------------


def test_slots_are_the_own_block_the_other_robot_and_its_block(rovers, anymals):
    """Blue looks along +y, from (1, 0.5); red along +x, from (-1, -0.5)."""
    for arena, first in ((rovers, 0), (anymals, 45)):
        actions = {agent: jnp.zeros(arena.robot.action_size) for agent in AGENTS}
        seen = observing(arena)(put(arena, heading=(math.pi / 2, 0.0)), RING, actions)
        h = arena.robot.rest_height
        blue, red = (np.asarray(seen[agent])[first:] for agent in AGENTS)
        np.testing.assert_allclose(blue[:9], [1.0, 0.5, 0.2 - h, -1.0, 2.0, 0.0, -2.0, 1.5, 0.2 - h], atol=1e-5)
        np.testing.assert_allclose(red[:9], [0.5, -1.0, 0.2 - h, 2.0, 1.0, 0.0, 1.5, 2.0, 0.2 - h], atol=1e-5)
        assert blue[9] == pytest.approx(math.hypot(1.0, 0.5, h), rel=1e-5)
        assert blue[-1] == 3.0
        assert len(seen["blue/0"]) == {0: 14, 45: 56}[first] == arena.observation_size("blue/0")


def test_a_buffer_is_zeros_at_the_end():
    arena = BlockPushSettings(buffer=50).build(engine="c")
    seen = observing(arena)(put(arena), RING, {agent: jnp.ones(12) for agent in AGENTS})["red/0"]
    assert seen.shape == (106,)
    assert seen[55] == 3.0
    np.testing.assert_array_equal(seen[56:], 0.0)


def drawn(settings, worlds=2000):
    arena = settings.build(engine="c")
    qpos, qvel, game = jax.jit(jax.vmap(arena.place))(jax.random.split(jax.random.key(0), worlds))
    at = np.array([*(arena.scene.agents[n].qpos for n in AGENTS), *(arena.scene.props[n].qpos for n in BLOCKS)])
    assert (np.abs(qvel) == 0).all()
    return np.asarray(qpos)[:, at[:, None] + np.arange(7)], np.asarray(game.radius)


@pytest.mark.parametrize("name", ["block-push-anymal", "block-push-leatherback"])
def test_all_start_within_their_share_of_the_ring_and_clear_of_each_other(name):
    settings = arenas.settings(name)
    poses, radius = drawn(settings)
    rules, xy = settings.rules, poses[..., :2]
    assert rules.ring[0] <= radius.min() < rules.ring[0] + 0.02
    assert rules.ring[1] - 0.02 < radius.max() <= rules.ring[1]
    assert (np.linalg.norm(xy, axis=2) < rules.spawn * radius[:, None]).all()
    hull, block = KINDS[settings.robot].hull / 2, 0.2 * math.sqrt(2)
    for one, other, apart in ((0, 1, 2 * hull), (0, 2, hull + block), (1, 2, hull + block), (2, 3, 2 * block)):
        assert np.linalg.norm(xy[:, one] - xy[:, other], axis=1).min() >= apart - 1e-3
    robot = {"anymal": REST_HEIGHT, "leatherback": WHEEL_RADIUS}[settings.robot]
    np.testing.assert_allclose(poses[..., 2], np.tile([robot, robot, 0.2, 0.2], (len(poses), 1)), atol=1e-6)
    for what in (0, 2):  # robots, blocks: neither team is better off
        ours, theirs = (np.linalg.norm(xy[:, what + i], axis=1) for i in (0, 1))
        assert ks_2samp(ours, theirs).pvalue > 0.01


@pytest.mark.parametrize(("robot", "facing"), [("anymal", math.pi / 2), ("leatherback", 0.0)])
def test_as_in_harl_a_all_may_face_one_way_and_overlap(robot, facing):
    settings = BlockPushSettings(robot=robot, rules=BlockPushRules(heading="fixed", overlap=True))
    poses, _ = drawn(settings)
    heading = 2 * np.arctan2(poses[..., 6], poses[..., 3])
    np.testing.assert_allclose(heading, np.tile([facing, facing, 0, 0], (len(poses), 1)), atol=1e-6)
    xy = poses[..., :2]
    gaps = np.linalg.norm(xy[:, :, None] - xy[:, None], axis=3)[:, *np.triu_indices(4, 1)]
    assert 0.6 < gaps.min() < 0.75  # the lattice's diagonal


def test_a_ring_without_room_is_refused():
    with pytest.raises(ValueError, match=r"^rules.ring: .* ring of 1.5 m; it must begin at 1.9 m or more"):
        BlockPushSettings(rules=BlockPushRules(ring=(1.5, 3.0)))
    with pytest.raises(ValueError, match=r"^ring: .* smallest <= largest"):
        BlockPushRules(ring=(3.0, 2.0))


# Played ---------------------------------------------------------------------------------------------------------------


def test_blocks_are_as_heavy_as_told(rovers, anymals):
    for arena, mass in ((rovers, 0.01), (anymals, 10.0)):
        masses = [arena.scene.model.body_mass[arena.scene.props[name].body] for name in BLOCKS]
        np.testing.assert_allclose(masses, mass)


def test_a_rover_pushes_its_block_out_and_wins(rovers):
    """Of sixteen that chase their block all have it out before the time is up, against robots that stay."""
    played = Worlds(rovers).play("pusher", "idle", 16)
    end = jax.tree.map(lambda x: x[-1], played)
    assert not end.void.any()
    np.testing.assert_array_equal(end.verdict.score, [[1.0, 0.0]] * 16)
    assert played.verdict.events["block_out"].any(axis=0)[:, 0].all()
    paid = played.verdict.rewards["block_out"].sum(axis=0)  # once
    np.testing.assert_array_equal(paid, [[10.0, 0.0]] * 16)


def test_blocks_change_hands_where_teams_change_places(rovers):
    physics = put(rovers, heading=(0.3, 1.0))
    speeds = jnp.arange(rovers.scene.model.nv, dtype=jnp.float32)
    qpos, qvel, _ = rovers.exchange(physics.qpos, speeds, RING)
    after = physics._replace(qpos=qpos, qvel=qvel)
    np.testing.assert_array_equal(
        rovers._places(after).blocks, np.asarray(rovers._places(physics).blocks)[::-1]
    )  # fmt: skip
    blue, red = (rovers.scene.props[name].qvel for name in BLOCKS)
    np.testing.assert_array_equal(qvel[blue : blue + 6], speeds[red : red + 6])
    np.testing.assert_array_equal(qvel[red : red + 6], speeds[blue : blue + 6])
