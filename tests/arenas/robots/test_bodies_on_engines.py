"""Every body on every engine: it compiles, steps, and goes where it goes in C. And its MJCF alone is the same body."""

from collections.abc import Callable

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from arenas.arena_settings import EngineName, Timing
from arenas.robots.anymal import anymal
from arenas.robots.crazyflie import crazyflie, crazyflie_rates
from arenas.robots.minitank import minitank
from arenas.robots.robot import Robot
from tests.arenas.robots.yard import Yard, steadily

SHORT = Timing(timestep=0.005, substeps=2, hold=1)  # 50 steps in 25 decisions
BODIES: dict[str, Callable[[], Robot]] = {
    "anymal": anymal, "crazyflie": crazyflie, "crazyflie-rates": crazyflie_rates, "minitank": minitank
}  # fmt: skip
ACTIONS = {
    "anymal": np.linspace(-0.5, 0.5, 12), "crazyflie": [-0.5, 0.02, 0.0, 0.1],
    "crazyflie-rates": [-0.2, 0.9, -0.3, 0.8], "minitank": [0.5, -1.0],
}  # fmt: skip


def final(kind: str, engine: EngineName) -> np.ndarray:
    """Positions (nq,) after a quarter of a second that begins 5 mm above the ground."""
    yard = Yard(BODIES[kind](), lifted=0.005, timing=SHORT, engine=engine)
    state = yard.play(steadily(*ACTIONS[kind]), 0.25)
    assert not state.physics.unstable.any()
    assert jnp.isfinite(state.physics.qpos).all()
    return np.asarray(state.physics.qpos[-1])


@pytest.mark.parametrize("kind", sorted(BODIES))
def test_a_body_is_whole_in_the_mjcf_that_recordings_keep(kind):
    """MuJoCo's writer leaves out an inertia without a place; the file then was no model at all."""
    scene = Yard(BODIES[kind]()).scene
    read = mujoco.MjModel.from_xml_string(scene.xml)
    for name in ("body_mass", "body_inertia", "body_ipos", "geom_size", "jnt_range", "dof_damping", "dof_armature"):
        np.testing.assert_allclose(getattr(read, name), getattr(scene.model, name), rtol=1e-4, atol=1e-9, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["jax", "warp"])
@pytest.mark.parametrize("kind", sorted(BODIES))
def test_a_body_moves_as_in_c(kind, engine):
    """Positions after a landing and fifty steps. Measured gaps: ANYmal 1.5e-4 (jax) and 2e-6 (warp), drone 2e-7."""
    np.testing.assert_allclose(final(kind, engine), final(kind, "c"), atol=1e-3)
