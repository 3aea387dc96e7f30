"""Three engines, one behaviour: the same motion, derived fields of the new state, and bad numbers told at once.

The scene: a ball that rolls under a motor-driven arm, with sensors. Its motion has contact, friction and fast dynamics
(accelerations up to 1,800 rad/s²) and compiles in seconds.
"""

from functools import cache

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from arenas.arena_settings import Solver
from arenas.errors import EngineError
from arenas.physics.engine import DERIVED, DYNAMICS, KINEMATICS, VARIABLE
from arenas.physics.mujoco_c import accepts_batches
from arenas.physics.registry import make_engine, resolve_engine

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
  <actuator><general joint="arm" biastype="affine"/></actuator>
  <sensor><framelinvel objtype="body" objname="ball"/><gyro site="centre"/><accelerometer site="centre"/></sensor>
</mujoco>
"""
WORLDS, STEPS = 3, 100  # half a second
# Every engine, and always the one that `auto` means on the device that there is.
HERE = [
    name if name == resolve_engine("auto") else pytest.param(name, marks=pytest.mark.slow)
    for name in ("c", "jax", "warp")
]
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


@pytest.mark.slow
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


def many(qpos, qvel, command):
    """The same law for one world or many at once, in JAX or NumPy."""
    return command - 0.01 * qvel[..., 6:]


def blind(qpos, qvel, command):
    """A law that takes arrays of many worlds without complaint, and mixes them."""
    return command - 0.01 * qvel.mean()


@pytest.mark.parametrize("law", [friction, many])
def test_a_law_is_applied_before_every_substep(law):
    c = engine("c")
    physics = jax.vmap(c.make)(*start(c.model))
    command = jnp.ones((WORLDS, 1))
    at_once = jax.vmap(lambda p, u: c.step(p, u, 4, law))(physics, command)
    one_by_one = held = physics
    for _ in range(4):
        one_by_one = jax.vmap(lambda p, u: c.step(p, u, 1, friction))(one_by_one, command)
        held = jax.vmap(lambda p, u: c.step(p, u, 1))(held, friction(None, physics.qvel.T, command.T).T)
    for name in ("qpos", "qvel", "ctrl"):
        ours, theirs = getattr(at_once, name), getattr(one_by_one, name)
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)
        if law is friction:  # the other is applied to float64, between whose substeps nothing is rounded
            np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_allclose(at_once.time, 0.02, rtol=1e-6)
    assert np.abs(at_once.qvel - held.qvel).max() > 0.1  # as if the law had been asked once


def test_only_a_law_that_tells_worlds_apart_is_applied_to_many_at_once():
    model = engine("c").model
    assert accepts_batches(many, model)
    for other in (friction, blind, lambda qpos, qvel, command: jnp.sin(command)):
        assert not accepts_batches(other, model)


@pytest.mark.parametrize("law", [None, many])
def test_control_steps_made_ahead_are_those_made_one_by_one(law):
    c = engine("c", ("xpos",))
    physics, command = jax.vmap(c.make)(*start(c.model)), jnp.ones((WORLDS, 1))
    ahead = jax.jit(jax.vmap(lambda p, u: c.step_many(p, u, 4, law, 3)))(physics, command)
    moved = jax.jit(jax.vmap(lambda p, u, m: c.step(p, u, 4, law, m)))
    single = jax.jit(jax.vmap(lambda p, u: c.step(p, u, 4, law)))
    one_by_one = physics
    for i in range(3):
        physics = moved(physics, command, jax.tree.map(lambda x: x[:, i], ahead))  # noqa: B023  (called at once)
        one_by_one = single(one_by_one, command)
        for name in ("qpos", "qvel", "ctrl", "time", "xpos"):
            np.testing.assert_array_equal(getattr(physics, name), getattr(one_by_one, name), err_msg=name)
    assert not physics.unstable.any()


def test_where_xla_has_no_cpu_the_host_is_called_with_copies(monkeypatch):
    c = engine("c")
    physics = jax.vmap(c.make)(*start(c.model))

    def step():
        return jax.jit(jax.vmap(lambda p: c.step(p, jnp.ones(1), 4)))(physics)

    in_place = step()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    copied = step()
    for name in ("qpos", "qvel", "ctrl", "causes"):
        np.testing.assert_array_equal(getattr(in_place, name), getattr(copied, name), err_msg=name)


def test_what_blows_up_on_the_way_is_told_from_there_on():
    c = engine("c")
    physics = jax.vmap(c.make)(*start(c.model))
    physics = physics._replace(qvel=physics.qvel.at[1, 0].set(jnp.nan))
    ahead = jax.vmap(lambda p: c.step_many(p, jnp.ones(1), 4, None, 2))(physics)
    assert ahead is not None
    np.testing.assert_array_equal(ahead.failed, [[False, False], [True, True], [False, False]])


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


def varied(model):
    """Every field that may vary, (WORLDS, ...): the model's own in world 0, ever further off in the next."""
    fields = {name: np.stack([getattr(model, name)] * WORLDS) for name in VARIABLE}
    steps = np.arange(WORLDS)
    for values in fields.values():
        values *= (1.0 + 0.25 * steps).reshape(-1, *[1] * (values.ndim - 1))
    fields["dof_armature"][:, 6] += 0.01 * steps  # these are zero in the model
    fields["jnt_stiffness"][:, 1] += 0.5 * steps
    fields["actuator_biasprm"][:, 0, 2] -= 0.1 * steps
    return {name: np.asarray(values, np.float32) for name, values in fields.items()}


def moved(engine, fields):
    """qpos (WORLDS, nq) after 50 substeps of worlds with model fields of their own."""

    def run(qpos, qvel, own):
        worlds = jax.vmap(engine.make)(qpos, qvel, own)
        step = jax.vmap(lambda p: engine.step(p, 0.2 * jnp.ones(1), 1))
        return jax.lax.fori_loop(0, 50, lambda _, p: step(p), worlds).qpos

    return np.asarray(jax.jit(run)(*start(engine.model), fields))


def by_hand(name, values):
    """The same with plain MuJoCo and one field written into each world's model."""
    rows = []
    for world in range(WORLDS):
        model = mujoco.MjModel.from_xml_string(XML)
        getattr(model, name)[:] = values[world]
        if name == "body_mass":
            model.body_subtreemass[:] = [values[world].sum(), values[world].sum(), values[world][2]]
        data = mujoco.MjData(model)
        data.qvel[0], data.ctrl[0] = world, 0.2
        mujoco.mj_step(model, data, 50)
        rows.append(data.qpos.copy())
    return np.stack(rows)


@pytest.mark.parametrize("name", VARIABLE)
def test_worlds_may_have_model_fields_of_their_own(name):
    c = engine("c")
    values = varied(c.model)[name]
    found = moved(c, {name: values})
    np.testing.assert_allclose(found, by_hand(name, values), atol=1e-4)
    assert np.abs(found - by_hand(name, np.stack([values[0]] * WORLDS)))[1:].max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["jax", "warp"])
def test_accelerators_read_the_same_model_fields(name):
    c, other = engine("c"), engine(name)
    fields = varied(c.model)
    found = moved(other, fields)
    np.testing.assert_allclose(found, moved(c, fields), atol=2e-4)
    assert np.abs(found - moved(other, {}))[1:].max() > 1e-2


def test_a_new_start_draws_the_model_anew_where_it_is_one():
    c = engine("c")
    fields = varied(c.model)
    run = jax.vmap(lambda p: c.step(p, jnp.ones(1), 4))
    worlds = run(jax.vmap(c.make)(*start(c.model), fields))
    where = jnp.array([True, False, True])
    placed = jax.vmap(c.place)(worlds, *start(c.model), where, jax.tree.map(lambda x: x[::-1], fields))
    for name, values in placed.model.items():
        assert name in (*VARIABLE, "body_subtreemass")
        np.testing.assert_array_equal(values[1], worlds.model[name][1])
        np.testing.assert_array_equal(values[0], worlds.model[name][2])


def test_a_loaded_world_has_the_sums_that_were_saved():
    """Another batch may add masses in another order, and a loaded world continues bit for bit."""
    c = engine("c")
    qpos, qvel = (x[0] for x in start(c.model))
    saved = c.save(c.make(qpos, qvel, {"body_mass": jnp.asarray(varied(c.model)["body_mass"][0])}))
    summed = jnp.nextafter(saved["model/body_subtreemass"], jnp.inf)
    loaded = c.load({**saved, "model/body_subtreemass": summed})
    np.testing.assert_array_equal(loaded.model["body_subtreemass"], summed)


def test_fields_that_cannot_vary_are_told():
    c = engine("c")
    qpos, qvel = (x[0] for x in start(c.model))
    with pytest.raises(EngineError, match=r"^model field 'geom_type' cannot differ between worlds; geom_friction, "):
        c.make(qpos, qvel, {"geom_type": jnp.zeros(3)})
    with pytest.raises(EngineError, match=r"^model field body_mass has shape \(2,\), not \(3,\) as the model's$"):
        c.make(qpos, qvel, {"body_mass": jnp.ones(2)})


@cache
def pushed(name):
    """An engine, its worlds with model fields of their own at the start, and one control step of them, compiled."""
    one = engine(name, DERIVED)
    begin, step = jax.vmap(one.make), jax.vmap(lambda p: one.step(p, 0.3 * jnp.ones(1), 2))
    return one, jax.jit(begin)(*start(one.model), varied(one.model)), step, jax.jit(step)


@pytest.mark.optimised
@pytest.mark.parametrize("name", HERE)
def test_a_saved_world_goes_on_bit_for_bit(name):
    one, worlds, _, step = pushed(name)
    worlds = step(worlds)
    saved = jax.device_get(jax.vmap(one.save)(worlds))
    assert all(isinstance(value, np.ndarray) for value in saved.values())
    loaded = jax.jit(jax.vmap(one.load))(saved)
    for ours, theirs in ((worlds, loaded), (step(worlds), step(loaded))):
        for x, y in zip(*map(jax.tree.leaves, (ours._replace(carry=()), theirs._replace(carry=()))), strict=True):
            np.testing.assert_array_equal(x, y)


# Without its barrier a GPU (jax 0.11.2, Warp) stacks zeros here. Run it on every machine that there is.
@pytest.mark.parametrize("name", HERE)
def test_what_a_scan_stacks_is_what_single_calls_give(name):
    _, worlds, step, alone = pushed(name)

    def stacking(physics, _):
        physics = step(physics)
        return physics, physics._replace(carry=())

    _, stacked = jax.jit(lambda p: jax.lax.scan(stacking, p, length=4))(worlds)
    for t in range(4):
        worlds = alone(worlds)
        for field in ("qpos", "qvel", *KINEMATICS):
            np.testing.assert_allclose(getattr(stacked, field)[t], getattr(worlds, field), atol=1e-5, err_msg=field)


@pytest.mark.slow
def test_a_full_contact_buffer_on_warp_voids_until_the_next_start():
    box = XML.replace('type="sphere" size=".1"', 'type="box" size=".1 .1 .1"').replace('pos="0 0 .15"', 'pos="0 0 .09"')
    warp = make_engine("warp", mujoco.MjModel.from_xml_string(box), worlds=WORLDS, buffers=Solver(contacts=1))
    step = jax.jit(jax.vmap(lambda p: warp.step(p, jnp.zeros(1), 1)))
    qpos, qvel = start(warp.model)
    full = step(jax.jit(jax.vmap(warp.make))(qpos, qvel))
    assert full.unstable.all()
    above = jax.jit(jax.vmap(warp.place))(full, qpos.at[:, 2].set(1.0), qvel, jnp.ones(WORLDS, bool))
    assert not step(above).unstable.any()


def test_names_that_no_engine_has():
    with pytest.raises(EngineError, match=r"^unknown engine 'physx': choose auto, c, jax or warp$"):
        engine("physx")
    with pytest.raises(EngineError, match="cannot derive xpoz; it can derive xpos, xquat, sensordata"):
        engine("c", ("xpoz",))
