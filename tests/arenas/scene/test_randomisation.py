"""Domain randomisation: bodies are as drawn and move as such bodies do, and by default nothing is drawn."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import arenas
from arenas.errors import ArenaError
from arenas.games.sumo.stages import BlockPushSettings, WalkSettings
from arenas.scene.randomisation import HARL_A, Randomisation

ROVERS = arenas.settings("block-push-leatherback")
ENGINES = ["c", pytest.param("jax", marks=pytest.mark.gpu), pytest.param("warp", marks=pytest.mark.slow)]


def built(randomisation, settings=ROVERS, engine="c"):
    return replace(settings, randomisation=randomisation).build(engine=engine, worlds=2)


def test_off_by_default_and_then_nothing_is_drawn():
    for settings in (WalkSettings(), BlockPushSettings(), ROVERS):
        assert settings.randomisation == Randomisation()
        arena = settings.build(engine="c")
        assert arena.randomise(jax.random.key(0)) == {}
        assert jax.jit(arena.reset)(jax.random.key(0)).physics.model == {}


def test_each_robot_and_episode_has_its_own_numbers_within_the_ranges():
    arena = built(HARL_A, BlockPushSettings())
    fields = jax.jit(jax.vmap(arena.randomise))(jax.random.split(jax.random.key(0), 500))
    model, agents = arena.scene.model, arena.scene.agents
    owner = np.array([model.body(i).name.split("/")[0] for i in range(model.nbody)])
    bases = [agents[name].base for name in ("blue/0", "red/0")]
    added = np.asarray(fields["body_mass"])[:, bases] - model.body_mass[bases]
    share = np.asarray(fields["geom_friction"])[..., 0] / model.geom_friction[:, 0]
    feet = [model.geom(f"{name}/LF_foot").id for name in ("blue/0", "red/0")]
    for drawn, (low, high) in ((added, (-5.0, 5.0)), (share[:, feet], (0.6, 0.8))):
        np.testing.assert_allclose(
            np.quantile(drawn, [0.0, 0.5, 1.0]), [low, (low + high) / 2, high], atol=0.05 * (high - low)
        )
        assert abs(np.corrcoef(drawn.T)[0, 1]) < 0.15  # the two robots do not share it
    for i, team in enumerate(("blue", "red")):  # one number for all of a robot's shapes
        own = owner[model.geom_bodyid] == team
        np.testing.assert_allclose(share[:, own], np.repeat(share[:, feet[i]][:, None], own.sum(), axis=1), rtol=1e-5)
    others = ~np.isin(owner[model.geom_bodyid], ["blue", "red"])  # ground and blocks
    np.testing.assert_allclose(share[:, others], 1.0)
    np.testing.assert_allclose(fields["geom_friction"][..., 1:], np.tile(model.geom_friction[:, 1:], (500, 1, 1)))
    rest = np.delete(np.arange(model.nbody), bases)
    np.testing.assert_allclose(fields["body_mass"][:, rest], np.tile(model.body_mass[rest], (500, 1)), rtol=1e-6)
    heavier = np.asarray(fields["body_mass"])[:, bases] / model.body_mass[bases]
    np.testing.assert_allclose(
        fields["body_inertia"][:, bases], heavier[..., None] * model.body_inertia[bases], rtol=1e-5
    )


@pytest.mark.parametrize("engine", ENGINES)
def test_rovers_slide_as_far_as_their_own_friction_and_mass_let_them(engine):
    """Both are thrown to the side, next to MuJoCo with the same numbers in its model; another draw ends elsewhere."""
    arena = built(Randomisation(friction=(0.3, 2.0), base_mass=(0.0, 4.0)), engine=engine)
    speed = np.zeros(arena.scene.model.nv)
    speed[[arena.scene.agents[name].qvel + 1 for name in ("blue/0", "red/0")]] = 2.0  # m/s along y
    reset, step, place = (jax.jit(jax.vmap(f)) for f in (arena.reset, arena.step, arena.engine.place))
    state = reset(jax.random.split(jax.random.key(1), 2))
    qpos = jnp.asarray(arena.scene.rest, jnp.float32)
    qpos = qpos.at[jnp.array([arena.scene.agents["blue/0"].qpos, arena.scene.agents["red/0"].qpos])].set(
        jnp.array([-1.0, 1.0])
    )
    qpos = jnp.tile(qpos.at[jnp.array([arena.scene.props["block-blue"].qpos])].set(3.0), (2, 1))
    physics = state.physics
    state = state._replace(physics=place(physics, qpos, jnp.tile(speed, (2, 1)), jnp.ones(2, bool), physics.model))
    for _ in range(10):
        state = step(state, {name: jnp.zeros((2, 2)) for name in ("blue/0", "red/0")})
    ends = np.asarray(state.physics.qpos)
    for world in range(2):
        model = mujoco.MjModel.from_xml_string(arena.scene.xml)
        data = mujoco.MjData(model)
        for name in ("geom_friction", "body_mass", "body_inertia"):
            getattr(model, name)[:] = np.asarray(state.physics.model[name][world])
        data.qpos[:], data.qvel[:] = qpos[world], speed
        mujoco.mj_step(model, data, 10 * arena.timing.substeps)
        np.testing.assert_allclose(ends[world], data.qpos, atol=2e-4)
    assert np.abs(ends[0] - ends[1]).max() > 0.02


def test_the_configuration_hash_knows_of_it():
    assert built(HARL_A, WalkSettings()).config_hash != WalkSettings().build(engine="c").config_hash


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"friction": (0.5,)}, r"^friction: \[0.5\] must be \[\] or two numbers"),
        ({"friction": (0.8, 0.6)}, r"^friction: \[0.8, 0.6\] must be"),
        ({"base_mass": (1.0, -1.0)}, r"^base_mass: \[1.0, -1.0\] must be"),
    ],
)
def test_what_is_no_range_is_refused(setting, message):
    with pytest.raises(ValueError, match=message):
        Randomisation(**setting)


def test_a_robot_must_keep_some_mass():
    with pytest.raises(ArenaError, match=r"^randomisation.base_mass = \[-5.0, 5.0\]: the base of blue/0 weighs 3.4 kg"):
        built(HARL_A)
