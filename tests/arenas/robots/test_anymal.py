"""ANYmal: the compiled body, its motors, what it feels, when it has fallen, and that it stands and trots."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from arenas.robots.anymal import JOINTS, anymal, gait, torques
from tests.arenas.robots.yard import Yard, steadily

HAA, HFE, KFE = slice(0, 4), slice(4, 8), slice(8, 12)


@pytest.fixture(scope="module")
def yard():
    return Yard(anymal())


def standing(yard):
    """MuJoCo's own data of the robot in its default pose at its standing height."""
    data = mujoco.MjData(yard.scene.model)
    data.qpos[:] = yard.scene.rest
    mujoco.mj_forward(yard.scene.model, data)
    return data


# The compiled body ---------------------------------------------------------------------------------------------------


def test_masses_are_the_urdfs(yard):
    model = yard.scene.model
    assert model.body_subtreemass[yard.at.base] == pytest.approx(52.135, abs=1e-3)
    masses = [model.body(f"solo/0/{name}").mass[0] for name in ("base", "LF_HIP", "RH_THIGH", "RF_SHANK")]
    np.testing.assert_allclose(masses, [26.37317, 2.781, 3.071, 0.58842])


def test_joints_are_in_the_order_of_harl_a_with_the_urdfs_ranges_and_axes(yard):
    model = yard.scene.model
    assert JOINTS == (
        "LF_HAA", "LH_HAA", "RF_HAA", "RH_HAA", "LF_HFE", "LH_HFE", "RF_HFE", "RH_HFE",
        "LF_KFE", "LH_KFE", "RF_KFE", "RH_KFE",
    )  # fmt: skip
    ids = [model.joint(f"solo/0/{name}").id for name in JOINTS]
    left, right, free = [-0.72, 0.49], [-0.49, 0.72], [-9.42478, 9.42478]
    np.testing.assert_allclose(model.jnt_range[ids], [left, left, right, right] + 8 * [free])
    np.testing.assert_allclose(model.jnt_axis[ids], 4 * [[1, 0, 0]] + 8 * [[0, 1, 0]])
    np.testing.assert_allclose(model.jnt_actfrcrange[ids], 12 * [[-80, 80]])
    assert [model.actuator(i).name for i in yard.at.ctrl] == [f"solo/0/{name}" for name in JOINTS]
    np.testing.assert_array_equal(model.actuator_trnid[yard.at.ctrl, 0], ids)


def test_the_default_pose_stands_on_four_feet_549_mm_high(yard):
    data = standing(yard)
    assert yard.robot.rest_height == pytest.approx(0.549, abs=1e-3)
    feet = np.array([data.geom(f"solo/0/{leg}_foot").xpos for leg in ("LF", "LH", "RF", "RH")])
    np.testing.assert_allclose(feet[:, 2], 0.030, atol=1e-3)
    np.testing.assert_allclose(feet[:, :2] * [[1, 1], [-1, 1], [1, -1], [-1, -1]], 4 * [feet[0, :2]], atol=1e-9)
    np.testing.assert_allclose(yard.robot.rest, [0] * 4 + [0.4, -0.4] * 2 + [-0.8, 0.8] * 2)


def test_left_and_right_are_mirror_images(yard):
    """The two sides' inertia about the robot's own axes is the same but for the signs that a mirror turns."""
    model = yard.scene.model
    for limb in ("HIP", "THIGH", "SHANK"):
        tensors = []
        for leg, f, s in (("LF", 1, 1), ("RF", 1, -1), ("LH", -1, 1), ("RH", -1, -1)):
            body, turn = model.body(f"solo/0/{leg}_{limb}"), np.empty(9)
            mujoco.mju_quat2Mat(turn, body.iquat)
            turn = turn.reshape(3, 3)
            mirror = np.diag([f, s, 1])
            tensors.append(mirror @ turn @ np.diag(body.inertia) @ turn.T @ mirror)
            np.testing.assert_allclose(mirror @ body.ipos, model.body(f"solo/0/LF_{limb}").ipos)
        np.testing.assert_allclose(tensors, [tensors[0]] * 4, atol=1e-9)


def test_only_cheap_shapes_touch(yard):
    model = yard.scene.model
    shapes = [mujoco.mjtGeom(int(model.geom_type[i])) for i in range(model.ngeom) if model.geom_contype[i] == 2]
    assert len(shapes) == 14
    assert set(shapes) == {mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_SPHERE}


def test_limbs_and_torso_touch_the_other_robot_and_legs_their_own_kind(yard):
    """Whole bodies collide, not feet alone: every shape of one robot meets every shape of another."""
    from arenas.scene.scene import build

    model = build({"blue": [anymal()], "red": [anymal()]}, timestep=0.005).model
    data = mujoco.MjData(model)
    data.qpos[7:19] = data.qpos[26:38] = 0.0
    data.qpos[2] = data.qpos[21] = 2.0  # in the air, one inside the other
    mujoco.mj_forward(model, data)
    pairs = {(model.geom(c.geom1).name, model.geom(c.geom2).name) for c in data.contact}
    own = {a.split("/", 2)[2] for a, b in pairs if a.split("/")[0] != b.split("/")[0]}
    assert {"torso_left", "LF_thigh", "RH_shank", "LH_foot"} <= own
    data.qpos[0] = 5.0
    data.qpos[7:10] = [-0.72, 0.0, 0.0]  # a left leg under the body, a right one too: shanks cross
    data.qpos[13:16] = [0.72, 0.0, 0.0]
    mujoco.mj_forward(model, data)
    pairs = {frozenset((model.geom(c.geom1).name, model.geom(c.geom2).name)) for c in data.contact}
    assert frozenset(("blue/0/LF_shank", "blue/0/RF_shank")) in pairs


# Its motors ----------------------------------------------------------------------------------------------------------


def test_an_action_moves_the_targets_by_half_a_radian_per_unit_unclipped(yard):
    action = jnp.arange(12.0) - 3
    np.testing.assert_allclose(
        yard.robot.command(action), np.array(yard.robot.rest) + 0.5 * np.arange(-3, 9), rtol=1e-6
    )


@pytest.mark.parametrize(
    ("error", "speed", "torque"),
    [
        (0.5, 0.0, 20.0),  # 40 N·m/rad
        (0.0, 2.0, -10.0),  # 5 N·m·s/rad
        (9.0, 0.0, 80.0),  # effort
        (9.0, 5.0, 40.0),  # 120·(1 − 5/7.5)
        (9.0, 8.0, 0.0),  # too fast to push
        (-9.0, 8.0, -80.0),  # but not to brake
        (-9.0, -5.0, -40.0),
        (-9.0, -8.0, 0.0),
        (9.0, -8.0, 80.0),
    ],
)
def test_torque_is_clipped_by_effort_and_speed(error, speed, torque):
    one = jnp.ones(12)
    np.testing.assert_allclose(torques(0.3 * one, speed * one, (0.3 + error) * one), torque * np.ones(12), rtol=1e-5)


def test_in_free_fall_it_falls_freely():
    yard = Yard(anymal(), lifted=1.0)
    played = yard.play(yard.robot.scripts["idle"], 0.4)
    assert yard.base(played)[0, 2] - yard.base(played)[-1, 2] == pytest.approx(9.81 * (0.4**2 - 0.02**2) / 2, rel=0.05)
    assert not played.verdict.events["fall"].any()


def test_the_law_acts_before_every_substep_on_its_own_joints(yard):
    """The last torque fits the state one substep before, and not the one in which the action was chosen."""
    state = jax.jit(yard.reset)(jax.random.key(0))
    action = jnp.zeros(12).at[11].set(1.0)
    targets, at = yard.robot.command(action), yard.at

    def law(qpos, qvel, command):
        return jnp.zeros(12).at[at.ctrl].set(torques(qpos[at.joint_qpos], qvel[at.joint_qvel], targets))

    before = jax.jit(lambda physics: yard.engine.step(physics, jnp.zeros(12), 3, law))(state.physics)
    last = jax.jit(yard.step)(state, {"solo/0": action}).physics.ctrl[at.ctrl]
    np.testing.assert_allclose(
        last, torques(before.qpos[at.joint_qpos], before.qvel[at.joint_qvel], targets), atol=1e-4
    )
    first = torques(state.physics.qpos[at.joint_qpos], state.physics.qvel[at.joint_qvel], targets)
    assert abs(float(last[11] - first[11])) > 3.0


# Standing, feeling, falling -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1])
def test_under_zero_action_it_keeps_standing_for_ten_seconds(yard, seed):
    """Soft motors sag under 52 kg, and it stays where it then is: feet hold, nothing creeps."""
    played = yard.play(yard.robot.scripts["idle"], 10.0, seed=seed)
    height = yard.base(played)[:, 2]
    assert height.min() > 0.42
    assert abs(height[-1] - height[-250]) < 0.01
    assert not played.verdict.events["fall"].any()
    assert not played.void.any()


def test_it_feels_harl_as_45_numbers(yard):
    """Rolled on its left side's height: turned by 90° about x; moving up in the world is then moving left."""
    state = jax.jit(yard.reset)(jax.random.key(0))
    half = jnp.sqrt(0.5)
    qpos = state.physics.qpos.at[yard.at.qpos + 3 : yard.at.qpos + 7].set(jnp.array([half, half, 0.0, 0.0]))
    qpos = qpos.at[yard.at.joint_qpos[5]].set(0.0)  # LH_HFE, 0.4 above its default
    qvel = jnp.zeros(18).at[:6].set(jnp.array([1.0, 0.0, 2.0, 3.0, 4.0, 5.0])).at[yard.at.joint_qvel[9]].set(6.0)
    action = jnp.arange(12.0)
    proprioception_size = yard.observe(yard.engine.make(qpos, qvel), (), {"solo/0": action})["solo/0"]
    assert proprioception_size.shape == (45,) == (yard.robot.proprioception_size,)
    np.testing.assert_allclose(proprioception_size[:9], [1, 2, 0, 3, 4, 5, 0, -1, 0], atol=1e-6)
    assert proprioception_size[9 + 5] == pytest.approx(0.4, abs=1e-6)
    np.testing.assert_allclose(proprioception_size[21:33], 6.0 * (np.arange(12) == 9))
    np.testing.assert_allclose(proprioception_size[33:], action)


def test_it_has_fallen_when_low_or_on_its_side():
    upright, side, flipped = [1, 0, 0, 0], [0.7071, 0.7071, 0, 0], [0, 1, 0, 0]
    poses = [([0, 0, 0.45], upright), ([0, 0, 0.15], upright), ([0, 0, 0.45], side), ([0, 0, 0.45], flipped)]
    fallen = [bool(anymal().fallen(jnp.array([*at, *turn]))) for at, turn in poses]
    assert fallen == [False, True, True, True]
    original = anymal(fall_height=0.10, fall_up=-1.0)
    fallen = [bool(original.fallen(jnp.array([*at, *turn]))) for at, turn in poses]
    assert fallen == [False, False, False, False]
    assert original.fallen(jnp.array([0.0, 0.0, 0.0900, *upright]))  # centre of mass at 0.0985 m: belly on the ground


def test_without_torque_it_goes_down_and_has_fallen():
    """A limp robot collapses on its shapes and not through the ground."""
    from dataclasses import replace

    yard = Yard(replace(anymal(), law=lambda angles, speeds, targets: jnp.zeros(12)))
    played = yard.play(steadily(*[0.0] * 12), 3.0)
    assert 0.05 < yard.base(played)[-1, 2] < 0.25
    assert played.verdict.events["fall"][-1]


# Trotting ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1])
def test_the_trot_walks_metres_in_ten_seconds_and_never_falls(yard, seed):
    played = yard.play(yard.robot.scripts["trot"], 10.0, seed=seed)
    x, y = yard.base(played)[-1, :2]
    assert x > 2.2
    assert abs(y) < 1.5
    assert not played.verdict.events["fall"].any()


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_gait_turns_where_it_is_told(yard, side):
    played = yard.play(lambda observation, key: gait(observation, 1.0, side, 0.02), 6.0)
    base = yard.base(played)
    heading = np.unwrap(2 * np.arctan2(base[:, 6], base[:, 3]))
    assert side * heading[-1] > 1.0
    assert not played.verdict.events["fall"].any()


def test_the_gait_keeps_its_clock_in_its_last_action():
    """A whole step takes 1 / 3.19 Hz at any rate of decisions; standing and turning do not disturb the clock."""
    from arenas.robots.anymal import PACE, _phase

    observation = jnp.zeros(45).at[8].set(-1.0).at[1].set(0.3)
    step = jax.jit(gait)
    for decision, turn in ((0.02, 0.0), (0.05, 1.0)):
        action = jnp.zeros(12)
        for n in range(1, 8):
            action = step(observation.at[33:45].set(action), 0.7, turn, decision)
            phase = (2 * np.pi * PACE * decision * n + np.pi) % (2 * np.pi) - np.pi
            assert float(_phase(action[:4])) == pytest.approx(phase, abs=1e-3)
