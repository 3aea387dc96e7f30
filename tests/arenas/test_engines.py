"""Three engines, one behaviour: the same motion, derived fields of the new state, and bad numbers told at once.

The scene: a ball that rolls under a motor-driven arm, with sensors. Its motion has contact, friction and fast dynamics
(accelerations up to 1,800 rad/s²) and compiles in seconds.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from arenas.engines import DERIVED, DYNAMICS, KINEMATICS, EngineError, choose, make_engine

XML = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast" cone="pyramidal" iterations="10" ls_iterations="20"/>
  <worldbody>
    <geom type="plane" size="0 0 .05"/>
    <body name="ball" pos="0 0 .15">
      <freejoint/>
      <geom type="sphere" size=".1" mass="1"/>
      <site name="centre"/>
      <body pos="0 0 .12">
        <joint name="arm" axis="0 1 0" damping=".02"/>
        <geom type="capsule" size=".03" fromto="0 0 0 0 0 .2" mass=".2" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="arm"/></actuator>
  <sensor><framelinvel objtype="body" objname="ball"/><gyro site="centre"/><accelerometer site="centre"/></sensor>
</mujoco>
"""
WORLDS, STEPS = 3, 100  # half a second
# Largest gaps measured against C over that time, on MJX and on Warp: qpos 7e-7, qvel 8e-6, qacc 3e-4, sensors 9e-6.
TOLERANCE = {"qpos": 1e-5, "qvel": 1e-4, "xpos": 1e-5, "xquat": 1e-5, "sensordata": 1e-4, "actuator_force": 1e-5}
TOLERANCE["qacc"] = 3e-3


def engine(name, derived=(), **sizes):
    return make_engine(name, mujoco.MjModel.from_xml_string(XML), derived, worlds=WORLDS, **sizes)


def start(model):
    """Balls thrown forwards at 0, 1 and 2 m/s."""
    qpos = jnp.tile(jnp.asarray(model.qpos0, jnp.float32), (WORLDS, 1))
    return qpos, jnp.zeros((WORLDS, model.nv)).at[:, 0].set(jnp.arange(WORLDS))


def friction(qpos, qvel, command):
    """An actuation law: the motor's torque falls with the arm's speed."""
    return command - 0.01 * qvel[6:]


def motion(engine, law=friction, substeps=1):
    """Physics after each control step (WORLDS, STEPS // substeps, ...), without the engine's own buffers."""

    def run(qpos, qvel):
        def step(physics, t):
            physics = engine.step(physics, 0.2 * jnp.sin(0.1 * t)[None], substeps, law)
            return physics, physics._replace(carry=())

        return jax.lax.scan(step, engine.make(qpos, qvel), jnp.arange(0.0, STEPS, substeps))[1]

    return jax.device_get(jax.jit(jax.vmap(run))(*start(engine.model)))


@pytest.fixture(scope="module")
def reference():
    return motion(engine("c", DERIVED))


def assert_same_motion(one, other, derived):
    assert not one.unstable.any()
    np.testing.assert_allclose(one.time, other.time)
    for name in ("qpos", "qvel", *derived):
        ours, theirs = getattr(one, name), getattr(other, name)
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=TOLERANCE[name], err_msg=name)


def test_mjx_moves_as_c_does(reference):
    assert_same_motion(motion(engine("jax", KINEMATICS)), reference, KINEMATICS)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["jax", "warp"])
def test_accelerators_derive_what_c_does(name, reference):
    assert_same_motion(motion(engine(name, DERIVED)), reference, DERIVED)


def test_derived_fields_belong_to_the_new_state(reference):
    model = mujoco.MjModel.from_xml_string(XML)
    for world, step in ((0, 0), (1, 30), (2, STEPS - 1)):
        data = mujoco.MjData(model)
        data.qpos, data.qvel, data.ctrl = (x[world, step] for x in (reference.qpos, reference.qvel, reference.ctrl))
        mujoco.mj_forward(model, data)
        for name in DERIVED:
            np.testing.assert_allclose(
                getattr(reference, name)[world, step], getattr(data, name), rtol=1e-4, atol=1e-3, err_msg=name
            )


@pytest.mark.parametrize("derived", [KINEMATICS, DYNAMICS])
def test_derived_fields_follow_a_placing(derived):
    c = engine("c", derived)
    qpos, qvel = start(c.model)
    fresh = jax.vmap(c.make)(qpos, qvel)
    moved = jax.jit(jax.vmap(lambda p: c.step(p, jnp.ones(1), 4)))(fresh)
    where = jnp.array([True, False, True])
    placed = jax.jit(jax.vmap(c.place))(moved, qpos, qvel, where)
    for name in derived:
        new, old, back = (np.asarray(getattr(x, name)) for x in (fresh, moved, placed))
        np.testing.assert_array_equal(back[np.array([0, 2])], new[np.array([0, 2])], err_msg=name)
        np.testing.assert_array_equal(back[1], old[1], err_msg=name)
        assert not np.array_equal(new[0], old[0])


def test_fields_that_nobody_asked_for_are_none(reference):
    assert engine("c").make(*(x[0] for x in start(engine("c").model))).xpos is None
    assert reference.xpos.shape == (WORLDS, STEPS, 3, 3)


def test_a_law_is_applied_before_every_substep():
    c = engine("c")
    physics = jax.vmap(c.make)(*start(c.model))
    command = jnp.ones((WORLDS, 1))
    at_once = jax.vmap(lambda p, u: c.step(p, u, 4, friction))(physics, command)
    one_by_one = held = physics
    for _ in range(4):
        one_by_one = jax.vmap(lambda p, u: c.step(p, u, 1, friction))(one_by_one, command)
        held = jax.vmap(lambda p, u: c.step(p, u, 1))(held, friction(None, physics.qvel.T, command.T).T)
    np.testing.assert_array_equal(at_once.qvel, one_by_one.qvel)
    np.testing.assert_allclose(at_once.time, 0.02, rtol=1e-6)
    assert np.abs(at_once.qvel - held.qvel).max() > 0.1  # as if the law had been asked once


def test_the_identity_is_no_law():
    c = engine("c")
    same, none = (motion(c, law, substeps=4) for law in (lambda qpos, qvel, command: command, None))
    np.testing.assert_allclose(same.qpos, none.qpos, atol=1e-5)  # float32 between substeps, float64 within


def test_time_does_not_drift():
    """A float32 sum of 0.02 s is off by 0.01 s after two minutes, and an episode would end a control step late."""
    c = engine("c")
    qpos, qvel = (x[0] for x in start(c.model))

    def step(physics, _):
        physics = c.step(physics, jnp.zeros(1), 4)
        return physics, physics.time

    steps = 7500
    times = jax.jit(lambda: jax.lax.scan(step, c.make(qpos, qvel), length=steps)[1])()
    np.testing.assert_allclose(times, 0.02 * np.arange(1, steps + 1), rtol=1e-6)


@pytest.mark.parametrize(
    ("qvel", "command"), [(np.nan, 0.0), (1e30, 0.0), (2e4, 0.0), (0.0, np.nan)], ids=["nan", "huge", "fast", "action"]
)
def test_bad_numbers_are_told_and_not_reset_in_silence(qvel, command, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    c = engine("c", DERIVED)
    qpos, rest = start(c.model)
    physics = jax.vmap(c.make)(qpos.at[:, 0].set(5.0), rest.at[0, 1].set(qvel))
    after = jax.jit(jax.vmap(lambda p, u: c.step(p, u, 2)))(physics, jnp.zeros((WORLDS, 1)).at[0].set(command))
    assert after.unstable.tolist() == [True, False, False]
    assert after.qpos[0, 0] != c.model.qpos0[0]  # where MuJoCo's own reset would have put it
    np.testing.assert_allclose(after.qpos[1:, 0], [5.01, 5.02], atol=1e-2)
    again = jax.jit(jax.vmap(c.place))(after, qpos, rest, after.unstable)
    assert not again.unstable.any()
    assert np.isfinite(again.qacc).all()
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir())  # no MUJOCO_LOG.TXT


@pytest.mark.slow
def test_a_full_contact_buffer_on_warp_voids_until_the_next_start():
    box = XML.replace('type="sphere" size=".1"', 'type="box" size=".1 .1 .1"').replace('pos="0 0 .15"', 'pos="0 0 .09"')
    warp = make_engine("warp", mujoco.MjModel.from_xml_string(box), worlds=WORLDS, contacts=1)
    step = jax.jit(jax.vmap(lambda p: warp.step(p, jnp.zeros(1), 1)))
    qpos, qvel = start(warp.model)
    full = step(jax.vmap(warp.make)(qpos, qvel))
    assert full.unstable.all()
    above = jax.jit(jax.vmap(warp.place))(full, qpos.at[:, 2].set(1.0), qvel, jnp.ones(WORLDS, bool))
    assert not step(above).unstable.any()


def test_names_that_no_engine_has():
    with pytest.raises(EngineError, match=r"^unknown engine 'physx': choose auto, c, jax or warp$"):
        engine("physx")
    with pytest.raises(EngineError, match="cannot derive xpoz; it can derive xpos, xquat, sensordata"):
        engine("c", ("xpoz",))


@pytest.mark.parametrize(("backend", "name"), [("cpu", "c"), ("tpu", "c"), ("gpu", "warp")])
def test_auto_is_warp_on_a_gpu_and_c_elsewhere(backend, name, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    assert choose("auto") == name
