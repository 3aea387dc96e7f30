"""Forces from outside: every engine moves a pushed body as MuJoCo does, and keeps its push with the world."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from arenas.errors import ArenaError
from arenas.physics.registry import make_engine
from arenas.robots.nature import disturbance
from arenas.scene.pushes import Pushes
from tests.arenas.physics.test_engines import WORLDS, XML, start

PUSHED = (1, 2)  # ball and arm
STEPS = 50
PUSH = np.array([[[0.5, 0.2, 1.0, 0.0, 0.0, 0.02], [0.3, 0.0, -0.2, 0.0, 0.05, 0.0]]], np.float32)
PUSHES = PUSH * np.arange(WORLDS, dtype=np.float32)[:, None, None]  # (WORLDS, 2, 6) N, N·m; world 0 is not pushed
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("jax", "warp")]


@cache
def worlds_of(name) -> tuple[Any, ...]:
    """An engine, its worlds (WORLDS, ...) at the start under PUSHES, and two substeps of them, compiled."""
    engine = make_engine(name, mujoco.MjModel.from_xml_string(XML), ("qacc",), PUSHED, worlds=WORLDS)
    fresh = jax.jit(jax.vmap(engine.make))(*start(engine.model))
    return engine, fresh, jax.jit(jax.vmap(lambda p: engine.step(p, jnp.zeros(1), 2)))


def pushed(name):
    """Physics (WORLDS, ...) after STEPS substeps under PUSHES."""
    _, fresh, step = worlds_of(name)
    physics = fresh._replace(push=jnp.asarray(PUSHES))
    for _ in range(STEPS // 2):
        physics = step(physics)
    return physics


@pytest.fixture(scope="module")
def reference():
    return pushed("c")


def test_a_pushed_body_moves_as_by_mujocos_own_field(reference):
    for world in range(WORLDS):
        model = mujoco.MjModel.from_xml_string(XML)
        data = mujoco.MjData(model)
        data.qvel[0] = world
        data.xfrc_applied[list(PUSHED)] = PUSHES[world]
        mujoco.mj_step(model, data, STEPS)
        np.testing.assert_allclose(reference.qpos[world], data.qpos, atol=1e-5)
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(reference.qacc[world], data.qacc, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("name", SLOW)
def test_engines_agree_on_motion_and_accelerations_of_pushed_bodies(name, reference):
    found = pushed(name)
    np.testing.assert_allclose(found.qpos, reference.qpos, atol=1e-5)
    np.testing.assert_allclose(found.qacc, reference.qacc, rtol=1e-3, atol=3e-3)


@pytest.mark.parametrize("name", ["c", *SLOW])
def test_a_push_is_saved_and_ends_with_the_episode(name):
    here, fresh, step = worlds_of(name)
    world = step(fresh._replace(push=jnp.asarray(PUSHES)))
    loaded = jax.jit(jax.vmap(here.load))(jax.jit(jax.vmap(here.save))(world))
    for name in ("qpos", "qacc", "push"):
        np.testing.assert_allclose(getattr(loaded, name), getattr(world, name), atol=1e-6)
    np.testing.assert_allclose(step(loaded).qpos, step(world).qpos, atol=1e-7)
    placed = jax.jit(jax.vmap(here.place))(world, *start(here.model), jnp.array([True, False, True]))
    assert not placed.push[jnp.array([0, 2])].any()
    np.testing.assert_array_equal(placed.push[1], PUSHES[1])
    np.testing.assert_allclose(placed.qacc[2], fresh.qacc[2], atol=1e-4)


def test_an_engine_without_pushes_has_no_room_for_them():
    here = make_engine("c", mujoco.MjModel.from_xml_string(XML))
    physics = here.make(*(x[0] for x in start(here.model)))
    assert physics.push is None
    assert "push" not in here.save(physics)


def test_forces_of_all_agents_on_a_body_add_up():
    model = mujoco.MjModel.from_xml_string(XML)
    pushes = Pushes(model, {"a": disturbance(["ball"], 2.0, "xz"), "b": disturbance(["ball"], 3.0, "y")})
    assert pushes.bodies == (1,)
    total = pushes.total({"a": jnp.array([0.5, -4.0]), "b": jnp.array([1.0])})
    np.testing.assert_array_equal(total, [[1.0, 3.0, -2.0, 0.0, 0.0, 0.0]])  # the second is clipped to -1


def test_forces_are_drawn_with_the_largest_that_there_may_be():
    model = mujoco.MjModel.from_xml_string(XML)
    pushes = Pushes(model, {"a": disturbance(["ball"], 2.0, "xz"), "b": disturbance(["ball"], 1.0, "y")})
    drawn = pushes.markers(pushes.total({"a": jnp.array([0.5, -4.0]), "b": jnp.array([1.0])}))
    assert list(drawn) == ["ball"]
    np.testing.assert_allclose(drawn["ball"], [1.0, 1.0, -2.0, 3.0])
    nobody = Pushes(model, {})
    assert nobody.markers(nobody.total({})) == {}


def test_a_body_that_is_not_there_is_told_in_one_line():
    with pytest.raises(ArenaError, match=r"^no body 'bal' to push: did you mean ball\? \(bodies: ball, .*\)$"):
        Pushes(mujoco.MjModel.from_xml_string(XML), {"a": disturbance(["bal"], 1.0)})
