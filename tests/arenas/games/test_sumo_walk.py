"""Sumo's first stage: what is rewarded, what ends it, what is seen. ANYmals are put down by hand and judged."""

import math
from dataclasses import asdict

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import arenas
from arenas.games.sumo.clearance import clearance
from arenas.games.sumo.stages import PAPER_WALK, WalkReward, WalkRules, WalkSettings
from arenas.games.sumo.walk import GameState, Walk
from arenas.games.terms import weights_of
from arenas.physics.engine import Physics
from tests.arenas.hooks import judging, observing

DT = 0.02  # s
STILL = jnp.zeros(12)
ON_SIDE, ON_BACK = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0), (0.0, 1.0, 0.0, 0.0)


@pytest.fixture(scope="session")
def walk() -> Walk:
    """The arena with weights of 1, so that terms can be read off."""
    ones = WalkReward(**dict.fromkeys(weights_of(WalkReward()), 1.0))
    return WalkSettings(reward=ones).build(engine="c")


@pytest.fixture(scope="session")
def put(walk):
    """An ANYmal put down: `put(x, y, heading, height, quat, velocity, rates, joints, speeds, torques, time)`."""

    def put(
        x=0.0, y=0.0, heading=0.0, height=0.55, quat=None, velocity=(0, 0, 0), rates=(0, 0, 0), joints=None,
        speeds=0.0, torques=0.0, time=1.0,
    ):  # fmt: skip
        at, model = walk.scene.agents["blue/0"], walk.scene.model
        qpos, qvel = walk.scene.rest.copy(), np.zeros(model.nv)
        quat = [math.cos(heading / 2), 0, 0, math.sin(heading / 2)] if quat is None else quat
        qpos[at.qpos : at.qpos + 7] = [x, y, height, *quat]
        qvel[at.qvel : at.qvel + 6] = [*velocity, *rates]
        if joints is not None:
            qpos[at.joint_qpos] = joints
        qvel[at.joint_qvel] = speeds
        total_size = (jnp.asarray(v, jnp.float32) for v in (qpos, qvel, np.full(model.nu, torques), time))
        return Physics(*total_size, causes=jnp.zeros((), jnp.uint8), carry=())

    return put


def game(goal=(6.0, 0.0), action=STILL, last=STILL, air=(0.0,) * 4):
    return GameState(*(jnp.asarray(x, jnp.float32) for x in (goal, action, last, air)))


def terms(walk, before, after, played):
    return {name: float(value[0]) for name, value in judging(walk)(before, after, played)[1].rewards.items()}


# Above the ground -----------------------------------------------------------------------------------------------------


def thrown(walk, seed):
    """MuJoCo's data of an ANYmal anyhow, at a height where some of it may touch the ground."""
    rng, model = np.random.default_rng(seed), walk.scene.model
    at, data = walk.scene.agents["blue/0"], mujoco.MjData(walk.scene.model)
    quat = rng.normal(size=4) if seed % 2 else np.array([1.0, *rng.normal(scale=0.2, size=3)])
    data.qpos[at.qpos : at.qpos + 7] = [*rng.normal(size=2), rng.uniform(0.05, 0.6), *(quat / np.linalg.norm(quat))]
    data.qpos[at.joint_qpos] = walk.scene.rest[at.joint_qpos] + rng.normal(scale=0.5, size=12)
    mujoco.mj_forward(model, data)
    low = clearance(jnp.asarray(data.qpos[at.qpos : at.qpos + 7]), jnp.asarray(data.qpos[at.joint_qpos]))
    return model, data, low


def lowest(model, data, name):
    """The lowest point of a capsule or sphere as MuJoCo has it."""
    geom, shape = model.geom(f"blue/0/{name}"), data.geom(f"blue/0/{name}")
    half = geom.size[1] if geom.type[0] == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
    return shape.xpos[2] - half * abs(shape.xmat[8]) - geom.size[0]


@pytest.mark.parametrize("seed", range(6))
def test_lowest_points_are_those_of_mujocos_shapes(walk, seed):
    model, data, low = thrown(walk, seed)
    torso = min(lowest(model, data, f"torso_{side}") for side in ("left", "right"))
    assert float(low.torso) == pytest.approx(torso, abs=1e-5)
    for i, leg in enumerate(("LF", "LH", "RF", "RH")):
        assert float(low.limbs[i]) == pytest.approx(lowest(model, data, f"{leg}_thigh"), abs=1e-5)
        assert float(low.feet[i]) == pytest.approx(lowest(model, data, f"{leg}_foot"), abs=1e-5)


def test_what_is_below_the_ground_is_what_touches_it(walk):
    touched = set()
    for seed in range(24):
        model, data, low = thrown(walk, seed)
        pairs = [{model.geom(c.geom1).name, model.geom(c.geom2).name} for c in data.contact]
        own = {name.removeprefix("blue/0/") for pair in pairs if "ground" in pair for name in pair}
        assert (low.torso <= 0) == bool(own & {"torso_left", "torso_right"})
        for i, leg in enumerate(("LF", "LH", "RF", "RH")):
            assert (low.limbs[i] <= 0) == (f"{leg}_thigh" in own)
            assert (low.feet[i] <= 0) == (f"{leg}_foot" in own)
        touched |= own
    assert {"torso_left", "LF_thigh", "RH_foot"} <= touched  # the draw has all of them


# Terms ----------------------------------------------------------------------------------------------------------------


def test_a_robot_that_stands_earns_its_distance_and_loses_nothing(walk, put):
    found = terms(walk, put(), put(), game())
    assert found.pop("distance") == pytest.approx(DT * (1 - math.tanh(6 / 5)), rel=1e-4)
    assert found.pop("tracking") == pytest.approx(DT * math.exp(-4), rel=1e-4)  # 1 m/s is asked for
    assert found.pop("turning") == pytest.approx(DT, rel=1e-4)  # it faces the goal
    assert found == dict.fromkeys(found, 0.0)


def tilted(angle):
    return (math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0)


# the state after, before, the game, and what one term is then
TERMS = [
    ("reached", {"x": 5.1}, {}, {}, 1.0),
    ("reached", {"x": 4.9}, {}, {}, 0.0),
    ("fall", {"height": 0.08}, {}, {}, 1.0),
    ("progress", {"x": 0.03}, {"x": 0.01}, {}, 0.02),
    ("progress", {"y": 0.8}, {}, {"goal": (0.0, 3.0)}, 0.8),
    ("tracking", {"velocity": (0.5, 0, 0)}, {}, {}, DT * math.exp(-1)),
    ("tracking", {"velocity": (0, 1, 0), "heading": 1.0}, {}, {"goal": (0.0, 9.0)}, DT),  # whichever way it faces
    ("turning", {"rates": (0, 0, 0.5)}, {}, {}, DT * math.exp(-1)),
    ("turning", {"rates": (0, 0, 1)}, {}, {"goal": (-5.0, 5.0)}, DT),  # at most 1 rad/s is asked for
    ("turning", {"rates": (0, 0, -0.5), "heading": 0.5}, {}, {}, DT),
    ("distance", {}, {}, {"goal": (0.0, 10.0)}, DT * (1 - math.tanh(2))),
    ("vertical", {"velocity": (0, 0, -3)}, {}, {}, DT * 9),
    ("roll_pitch", {"rates": (1, 2, 4)}, {}, {}, DT * 5),
    ("torque", {"torques": 3.0}, {}, {}, DT * 12 * 9),
    ("acceleration", {"speeds": 0.5}, {"speeds": 0.4}, {}, DT * 12 * (0.1 / DT) ** 2),
    ("action_change", {}, {}, {"action": STILL + 0.5, "last": STILL + 0.2}, DT * 12 * 0.09),
    ("thigh_contact", {"height": 0.16, "joints": [0] * 4 + [1.1, -1.1] * 2 + [-0.8, 0.8] * 2}, {}, {}, DT * 4),
    ("tilt", {"quat": tilted(0.2)}, {}, {}, DT * math.sin(0.2) ** 2),
]


@pytest.mark.parametrize(("term", "after", "before", "played", "value"), TERMS)
def test_each_term_by_number(walk, put, term, after, before, played, value):
    assert terms(walk, put(**before), put(**after), game(**played))[term] == pytest.approx(value, rel=1e-4, abs=1e-7)


def test_every_term_has_been_measured(walk):
    assert {term for term, *_ in TERMS} | {"air_time"} == set(walk.weights)


def test_a_foot_that_lands_is_paid_for_its_time_in_the_air(walk, put):
    """Feet are 1 mm up at 0.55 m. All are lifted for 0.7 s and land; then they stay."""
    up, down = put(height=0.60), put(height=0.548)
    played = game(air=(0.68, 0.68, 0.0, 0.38))
    played, verdict = judging(walk)(up, up, played)
    np.testing.assert_allclose(played.air, [0.70, 0.70, 0.02, 0.40], rtol=1e-5)
    assert verdict.rewards["air_time"] == 0.0
    played, verdict = judging(walk)(up, down, played)
    assert float(verdict.rewards["air_time"][0]) == pytest.approx(DT * (0.2 + 0.2 - 0.48 - 0.1), rel=1e-3)
    np.testing.assert_array_equal(played.air, 0.0)
    played, verdict = judging(walk)(down, down, played)
    assert verdict.rewards["air_time"] == 0.0


def test_weights_are_settings_and_the_papers_are_known(put):
    paper = WalkSettings(reward=PAPER_WALK).build(engine="c")
    after = put(x=0.02, velocity=(1, 0, 0.5), rates=(0.1, 0, 0), torques=10.0, speeds=0.1)
    found = terms(paper, put(), after, game(action=STILL + 1.0))
    assert found.pop("distance") == pytest.approx(2.0 * DT * (1 - math.tanh(5.98 / 5)), rel=1e-4)
    assert found.pop("vertical") == pytest.approx(-2.0 * DT * 0.25, rel=1e-4)
    assert found.pop("roll_pitch") == pytest.approx(-0.05 * DT * 0.01, rel=1e-4)
    assert found.pop("torque") == pytest.approx(-2.5e-5 * DT * 1200, rel=1e-4)
    assert found.pop("acceleration") == pytest.approx(-2.5e-7 * DT * 12 * 25, rel=1e-4)
    assert found.pop("action_change") == pytest.approx(-0.01 * DT * 12, rel=1e-4)
    assert all(value == 0 for value in found.values())
    weights = asdict(PAPER_WALK)
    assert (weights["reached"], weights["air_time"], weights["thigh_contact"], weights["tilt"]) == (10, 0.5, -1, -5)


# Ends -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("state", "score", "terminated", "truncated"),
    [
        ({}, 0.0, False, False),
        ({"x": 5.5}, 1.0, True, False),
        ({"height": 0.08}, 0.0, True, False),  # the torso touches
        ({"height": 0.10}, 0.0, False, False),  # and here it does not, however low it is
        ({"height": 0.3, "quat": ON_SIDE}, 0.0, True, False),
        ({"height": 0.3, "quat": ON_BACK}, 0.0, True, False),
        ({"height": 0.4, "quat": tilted(0.9)}, 0.0, True, False),  # on its nose
        ({"time": 19.98}, 0.0, False, False),
        ({"time": 20.0}, 0.0, False, True),
        ({"x": 5.5, "time": 20.0}, 1.0, True, False),  # in the last control step
        ({"height": 0.08, "time": 20.0}, 0.0, True, False),
    ],
)
def test_success_is_to_arrive_and_the_clock_only_cuts(walk, put, state, score, terminated, truncated):
    joints = [0.0] * 4 + [1.5, -1.5] * 2 + [-2.5, 2.5] * 2 if "height" in state else None  # legs drawn in
    after = put(joints=joints, **state)
    verdict = judging(walk)(put(), after, game())[1]
    assert (bool(verdict.terminated), bool(verdict.truncated)) == (terminated, truncated)
    if terminated or truncated:
        np.testing.assert_array_equal(verdict.score, [score])
    assert bool(verdict.events["reached"][0]) == (score == 1.0)
    assert bool(verdict.events["fall"][0]) == (terminated and not score)


def test_as_in_the_paper_lying_on_the_side_is_no_fall(put):
    paper = WalkSettings(rules=WalkRules(fall_up=-1.0)).build(engine="c")
    side = put(height=0.3, quat=ON_SIDE)
    assert not judging(paper)(side, side, game())[1].terminated


# Start and sight ------------------------------------------------------------------------------------------------------


def test_it_starts_standing_with_goals_all_over_the_square(walk):
    qpos, qvel, played = jax.vmap(walk.place)(jax.random.split(jax.random.key(0), 4000))
    assert (np.abs(qvel) == 0).all()
    np.testing.assert_array_equal(qpos[:, :2], 0.0)
    np.testing.assert_allclose(qpos[:, 2], 0.5492, atol=1e-6)
    np.testing.assert_allclose(qpos[:, 7:], np.tile(walk.scene.rest[7:], (4000, 1)), atol=1e-6)
    assert np.abs(played.goal).max() <= 10.0
    np.testing.assert_allclose(
        np.quantile(played.goal, [0.1, 0.5, 0.9], axis=0), [[-8] * 2, [0] * 2, [8] * 2], atol=0.6
    )
    heading = 2 * np.arctan2(qpos[:, 6], qpos[:, 3]) % (2 * np.pi)
    np.testing.assert_allclose(np.quantile(heading, [0.25, 0.5, 0.75]), [1.57, 3.14, 4.71], atol=0.3)


def test_start_and_goal_are_rules():
    rules = WalkRules(goal=3.0, heading="fixed")
    qpos, _, played = jax.vmap(WalkSettings(rules=rules).build(engine="c").place)(
        jax.random.split(jax.random.key(0), 200)
    )
    np.testing.assert_allclose(qpos[:, 3:7], [[math.sqrt(0.5), 0, 0, math.sqrt(0.5)]] * 200, atol=1e-6)
    assert 2.8 < np.abs(played.goal).max() <= 3.0


@pytest.mark.parametrize("buffer", [0, 50])
def test_it_sees_the_goal_in_slot_a_and_zeros(put, buffer):
    arena = WalkSettings(buffer=buffer).build(engine="c")
    seen = observing(arena)(put(x=1.0, y=2.0, heading=math.pi / 2), game(goal=(4.0, 4.0)), {"blue/0": STILL + 0.3})
    seen = np.asarray(seen["blue/0"])
    assert seen.shape == (56 + buffer,) == (arena.observation_size("blue/0"),)
    np.testing.assert_allclose(seen[33:45], 0.3, rtol=1e-6)
    np.testing.assert_allclose(seen[45:48], [2.0, -3.0, 0.25 - 0.55], atol=1e-5)  # ahead, left, up
    np.testing.assert_array_equal(seen[48:], 0.0)


def test_the_goal_is_drawn_with_its_reach(walk, put):
    np.testing.assert_allclose(walk.markers(put(), game(goal=(4.0, -4.0)))["goal"], [4.0, -4.0, 1.0])


# Played ---------------------------------------------------------------------------------------------------------------


def test_the_seeker_reaches_a_near_goal_and_decisions_are_noted(walk):
    """From the verbs: 2.2 m straight ahead, in less than 20 s."""
    seek = walk.scripts()["seeker"]["anymal"]

    def decide(state, key):
        state = walk.step(state, {"blue/0": seek(state.observations["blue/0"], key)})
        return state, (state.verdict, state.game.action, state.game.last, state.actions["blue/0"], state.done)

    @jax.jit
    def run(key):
        state = walk.reset(key)
        quat = walk.scene.rest[:7]
        physics = walk.engine.place(
            state.physics, state.physics.qpos.at[3:7].set(quat[3:7]), state.physics.qvel, jnp.ones((), bool)
        )
        state = state._replace(physics=physics, game=state.game._replace(goal=jnp.array([2.2, 0.0])))
        return jax.lax.scan(decide, state, jax.random.split(key, 999))[1]

    verdict, action, last, told, done = jax.device_get(run(jax.random.key(3)))
    (end,) = np.flatnonzero(np.diff(done)) + 1
    assert verdict.events["reached"][end, 0]
    assert verdict.terminated[end]
    np.testing.assert_array_equal(verdict.score[end], [1.0])
    np.testing.assert_array_equal(action[: end + 1], told[: end + 1])
    np.testing.assert_array_equal(last[1 : end + 1], action[:end])
    np.testing.assert_array_equal(last[0], 0.0)
    gained = verdict.rewards["progress"].sum()  # weight 1
    assert 1.2 <= gained < 1.25


def test_the_settings_are_listed_and_need_no_registration():
    assert arenas.settings("anymal-walk") == WalkSettings()
