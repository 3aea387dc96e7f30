"""Worlds that rest on the C engine: they stay as they are, and others move as they do without them."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from arenas.physics.engine import DERIVED
from arenas.physics.mujoco_c import CEngine

FALLING = """
<mujoco>
  <worldbody>
    <geom type="plane" size="5 5 0.1"/>
    <body pos="0 0 0.3"><freejoint/><geom size="0.1" mass="1"/><site name="s"/></body>
  </worldbody>
  <sensor><accelerometer name="a" site="s"/></sensor>
</mujoco>
"""
WORLDS = 3


@pytest.fixture(scope="module")
def engine():
    return CEngine(mujoco.MjModel.from_xml_string(FALLING), derived=DERIVED)


@pytest.fixture(scope="module")
def step(engine):
    """A control step of all worlds, of which some may rest."""
    return jax.jit(jax.vmap(lambda physics, rests: engine.step(engine.rest(physics, rests), jnp.zeros(0), 4)))


@pytest.fixture(scope="module")
def moving(engine, step):
    """Balls that fall with 0, 1 and 2 m/s."""
    qpos = jnp.tile(jnp.asarray(engine.model.qpos0), (WORLDS, 1))
    start = jax.vmap(engine.make)(qpos, jnp.zeros((WORLDS, 6)).at[:, 2].set(-jnp.arange(WORLDS)))
    return step(start, jnp.zeros(WORLDS, bool))


def same(found, expected, worlds):
    """All but `resting` and the time is the same in these worlds."""
    found, expected = (each._replace(resting=None, time=None) for each in (found, expected))
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[worlds], b[worlds]), found, expected)


def test_who_rests_stays_as_it_is_and_others_move_as_ever(step, moving):
    all_moved = step(moving, jnp.zeros(WORLDS, bool))
    some_moved = step(moving, jnp.arange(WORLDS) == 0)
    assert (all_moved.qpos[0] != moving.qpos[0]).any()
    same(some_moved, moving, slice(0, 1))
    same(some_moved, all_moved, slice(1, None))
    np.testing.assert_array_equal(some_moved.time, all_moved.time)


def test_who_rested_goes_on_where_it_was(step, moving):
    rested = step(moving, jnp.ones(WORLDS, bool))
    same(step(rested, jnp.zeros(WORLDS, bool)), step(moving, jnp.zeros(WORLDS, bool)), slice(None))


def test_a_world_that_rested_is_placed_as_any_other(engine, step, moving):
    rested = step(moving, jnp.ones(WORLDS, bool))
    place = jax.vmap(lambda physics, where: engine.place(physics, engine.model.qpos0, jnp.zeros(6), where))
    begun = place(rested, jnp.arange(WORLDS) == 1)
    np.testing.assert_allclose(begun.xpos[1, 1], [0.0, 0.0, 0.3])
    np.testing.assert_array_equal(begun.xpos[0], moving.xpos[0])
    assert begun.resting.tolist() == [True, False, True]
