"""MiniTank: the compiled body, a turret that turns on the spot, and where its barrel points."""

import jax.numpy as jnp
import numpy as np
import pytest

from arenas.robots.minitank import aim, from_x, minitank
from tests.arenas.robots.yard import Yard, steadily


@pytest.fixture(scope="module")
def yard():
    return Yard(minitank())


def test_the_compiled_body_has_the_numbers_of_its_table(yard):
    model = yard.scene.model
    assert model.body_subtreemass[yard.at.base] == pytest.approx(3.0)
    assert yard.robot.joints == ("arm_joint", "rotor_joint")
    arm, rotor = (model.joint(f"solo/0/{name}") for name in yard.robot.joints)
    np.testing.assert_allclose(arm.range, [-0.1, 1.5])
    assert not rotor.limited[0]
    np.testing.assert_allclose(model.actuator_actrange[yard.at.ctrl], [[-5, 5], [-5, 5]])
    assert model.body("solo/0/arm").pos[2] + model.body("solo/0/rotor").pos[2] == pytest.approx(0.06)


def test_it_stands_still_at_its_height_and_its_barrel_does_not_droop(yard):
    played = yard.play(yard.robot.scripts["idle"], 2.0)
    np.testing.assert_allclose(yard.base(played)[-1], [0, 0, 0.05, 1, 0, 0, 0], atol=1e-3)
    np.testing.assert_allclose(
        played.physics.qpos[-1][yard.at.joint_qpos], played.physics.qpos[0][yard.at.joint_qpos], atol=1e-3
    )


def test_a_tank_turns_on_the_spot(yard):
    """Full speed after 0.2 s, as HARL-A's 0.5 rad/s per control step; one turn in 1.36 s while the base stays."""
    played = yard.play(steadily(0.0, 1.0), 1.5)
    speeds = played.physics.qvel[:, yard.at.joint_qvel]
    np.testing.assert_allclose(speeds[4], [0, 5 * 0.5], atol=0.4)  # it lags by 12 ms
    np.testing.assert_allclose(speeds[-1], [0, 5], atol=0.01)
    assert played.physics.qpos[-1][yard.at.joint_qpos[1]] > 2 * np.pi
    np.testing.assert_allclose(yard.base(played)[:, :3], np.tile([0, 0, 0.05], (75, 1)), atol=2e-3)
    assert np.abs(yard.base(played)[:, 6]).max() < 0.01  # half of what the base turned under the turret, rad


def test_the_speed_limit_is_the_games():
    slow = Yard(minitank(speed_limit=2.0))
    played = slow.play(steadily(1.0, -1.0), 0.5)
    np.testing.assert_allclose(played.physics.qvel[-1][slow.at.joint_qvel], [2, -2], atol=0.05)


def test_the_barrel_points_where_joints_and_base_turn_it(yard):
    """Against MuJoCo's own kinematics: the barrel geom's axis."""
    import mujoco

    model, data = yard.scene.model, mujoco.MjData(yard.scene.model)
    data.qpos[:] = yard.scene.rest
    data.qpos[yard.at.qpos + 3 : yard.at.qpos + 7] = np.array([0.9, 0.1, -0.2, 0.4]) / np.sqrt(1.02)
    data.qpos[yard.at.joint_qpos] = [0.7, 2.0]
    mujoco.mj_kinematics(model, data)
    tip = data.geom("solo/0/barrel").xpos - data.body("solo/0/arm").xpos
    pose, angles = data.qpos[yard.at.qpos : yard.at.qpos + 7], data.qpos[yard.at.joint_qpos]
    np.testing.assert_allclose(aim(jnp.asarray(pose), jnp.asarray(angles)), tip / np.linalg.norm(tip), atol=1e-5)


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, 1, 0), (0, 0, -1), (-1, 0, 0), (0.6, -0.48, 0.64)])
def test_the_aim_is_the_shortest_turn_from_x(direction):
    import mujoco

    quat = np.asarray(from_x(jnp.asarray(direction, jnp.float32)), float)
    turned = np.empty(3)
    mujoco.mju_rotVecQuat(turned, np.array([1.0, 0, 0]), quat)
    np.testing.assert_allclose(turned, direction, atol=1e-6)
    assert 2 * np.arccos(min(1.0, quat[0])) == pytest.approx(np.arccos(direction[0]), abs=1e-3)


def test_it_feels_the_targets_just_applied_and_its_barrel(yard):
    played = yard.play(steadily(0.3, 1.0), 0.4)
    proprioception_size = played.observations["solo/0"][-1]
    assert proprioception_size.shape == (6,) == (yard.robot.proprioception_size,)
    np.testing.assert_allclose(proprioception_size[:2], [25 * 0.3 * 0.4, 5.0], atol=0.2)
    expected = from_x(aim(yard.base(played)[-1], played.physics.qpos[-1][yard.at.joint_qpos]))
    np.testing.assert_allclose(proprioception_size[2:], expected, atol=1e-5)


def test_a_tank_on_its_back_has_fallen(yard):
    assert not yard.robot.fallen(jnp.array([0, 0, 0.05, 1, 0, 0, 0]))
    assert yard.robot.fallen(jnp.array([0, 0, 0.1, 0, 1, 0, 0]))
