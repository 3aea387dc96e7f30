"""Robots that move in a plane: their bases and their bodies are those of their models."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from arenas.games.disturbance import DisturbanceSettings
from arenas.robots.kinematics import HeightReader

pytest.importorskip("gymnasium")


def built(robot, *bodies):
    """A disturbed walk of a robot, on the C engine."""
    return DisturbanceSettings(blue=(robot,), bodies=bodies).build(engine="c", threads=1)


@pytest.mark.parametrize("name", ["hopper", "walker2d", "half_cheetah"])
def test_a_planar_base_is_where_mujoco_has_it(name):
    arena = built(name, "base")
    model, at = arena.scene.model, arena.scene.agents["blue/0"]
    rng, data = np.random.default_rng(0), mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = rng.uniform(-0.7, 0.7, model.nq), rng.uniform(-1, 1, model.nv)
    mujoco.mj_forward(model, data)
    qpos = jnp.asarray(data.qpos, jnp.float32)
    np.testing.assert_allclose(at.pose(qpos)[:3], data.xpos[at.base], atol=1e-6)
    np.testing.assert_allclose(at.pose(qpos)[3:], data.xquat[at.base], atol=1e-6)
    moves = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, at.base, moves, 0)
    np.testing.assert_allclose(at.velocity(jnp.asarray(data.qvel, jnp.float32)), [*moves[3:], *moves[:3]], atol=1e-6)
    feet = [f"blue/0/{foot}" for foot in arena.robot.feet]
    low = HeightReader(model, at.base, feet).read(qpos)
    for height, foot in zip(low.feet, feet, strict=True):
        geom = int(np.flatnonzero(model.geom_bodyid == model.body(foot).id)[0])
        up = data.geom_xmat[geom].reshape(3, 3)[2, 2]
        radius, half = model.geom_size[geom, :2]
        assert float(height) == pytest.approx(data.geom_xpos[geom, 2] - radius - half * abs(up), abs=1e-5)


def test_a_planar_walker_is_the_model_s_own():
    """Total mass and joint order of gymnasium's hopper, and free fall of its base."""
    arena = built("hopper")
    model = arena.scene.model
    assert model.body_mass.sum() == pytest.approx(15.8, abs=0.05)
    assert [model.joint(i).name for i in range(6)] == [
        f"blue/0/{name}" for name in ("base_x", "base_z", "base_pitch", "thigh_joint", "leg_joint", "foot_joint")
    ]
    data = mujoco.MjData(model)
    data.qpos[1] = 5.0
    mujoco.mj_step(model, data, 20)
    assert data.qvel[1] == pytest.approx(-9.81 * 0.1, rel=1e-3)
