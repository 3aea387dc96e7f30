"""The whole state that a critic may see: what it holds, in every arena, and what a game may say instead."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import arenas
from arenas.contract.check_run import CheckRun
from arenas.contract.shape_checks import check_shapes
from arenas.description import Part, total_size, with_indices
from tests.arenas.race import Race, RaceSettings


def placed(arena):
    """Each part's place in the vector."""
    found, first = {}, 0
    for part in arena.privileged_parts():
        found[part.name] = slice(first, first + part.size)
        first += part.size
    return found


@pytest.mark.parametrize(
    "name",
    [
        "block-push-anymal",
        "pursuit",
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("sumo-2v2", "galaga-1v1", "soccer-2v2")),
    ],
)
def test_every_body_is_told_as_mujoco_has_it(name):
    arena = arenas.settings(name).build(engine="c", threads=1)
    at, model = placed(arena), arena.scene.model
    state = jax.jit(arena.reset)(jax.random.key(3))
    rng = np.random.default_rng(0)
    qpos, qvel = np.array(state.physics.qpos), rng.normal(size=model.nv).astype(np.float32)
    for joint in range(model.njnt):
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            turn = rng.normal(size=4)
            qpos[model.jnt_qposadr[joint] + 3 :][:4] = turn / np.linalg.norm(turn)
        else:
            qpos[model.jnt_qposadr[joint]] = rng.normal()
    physics = state.physics._replace(qpos=jnp.asarray(qpos), qvel=jnp.asarray(qvel), time=jnp.float32(0.0))
    whole = np.asarray(arena.privileged_state(state._replace(physics=physics)))
    data = mujoco.MjData(model)
    data.qpos, data.qvel = qpos, qvel
    mujoco.mj_forward(model, data)
    movers = {name: scene.base for name, scene in arena.scene.agents.items()}
    movers |= {name: prop.body for name, prop in arena.scene.props.items() if prop.qpos is not None}
    for body, number in movers.items():
        axes = data.xmat[number].reshape(3, 3)
        np.testing.assert_allclose(whole[at[f"{body} place"]], data.xpos[number], atol=1e-5)
        np.testing.assert_allclose(whole[at[f"{body} ahead"]], axes[:, 0], atol=1e-5)
        np.testing.assert_allclose(whole[at[f"{body} up"]], axes[:, 2], atol=1e-5)
        dof = model.jnt_dofadr[model.body_jntadr[number]]
        np.testing.assert_allclose(whole[at[f"{body} velocity"]], qvel[dof : dof + 3], rtol=1e-6)
        np.testing.assert_allclose(whole[at[f"{body} spin"]], qvel[dof + 3 : dof + 6], rtol=1e-6)
    for agent, index in arena.scene.agents.items():
        own = np.sort(index.own_qvel)[6:]
        if own.size:
            np.testing.assert_allclose(whole[at[f"{agent} joint speeds"]], qvel[own] / 10, rtol=1e-5)
    assert whole[at["time left"]] == 1.0
    assert not any(f"{prop} place" in at for prop, index in arena.scene.props.items() if index.qpos is None)


def test_endless_angles_are_told_as_sine_and_cosine_and_others_as_they_are():
    arena = arenas.settings("sumo-1v1").build(engine="c", threads=1)
    at, model = placed(arena), arena.scene.model
    state = jax.jit(arena.reset)(jax.random.key(3))
    hinges = [j for j in range(model.njnt) if model.joint(j).name.startswith("red/0/") and model.jnt_type[j] == 3]
    wheels = [j for j in hinges if not model.jnt_limited[j]]
    assert (len(hinges), len(wheels)) == (6, 4)
    turned = state.physics.qpos.at[model.jnt_qposadr[wheels]].set(jnp.array([0.1, 2.0, 30.0, -400.0]))
    steered = turned.at[model.jnt_qposadr[[j for j in hinges if j not in wheels]]].set(jnp.array([0.2, 0.3]))
    whole = arena.privileged_state(state._replace(physics=state.physics._replace(qpos=steered)))
    expected = [*np.sin([0.1, 2.0, 30.0, -400.0]), *np.cos([0.1, 2.0, 30.0, -400.0])]
    np.testing.assert_allclose(whole[at["red/0 wheels"]], expected, atol=1e-4)
    np.testing.assert_allclose(whole[at["red/0 joints"]], [0.2, 0.3], rtol=1e-6)


def test_the_games_numbers_the_last_actions_and_the_time_are_told_too():
    arena = RaceSettings().build(engine="c", threads=1)
    at = placed(arena)
    state = jax.jit(arena.reset)(jax.random.key(0))
    actions = {"blue/0": jnp.array([0.5, -0.25]), "red/0": jnp.array([0.1, 0.2])}
    after = jax.jit(arena.step)(state, actions)
    whole = arena.privileged_state(after)
    np.testing.assert_array_equal(whole[at["game"]], after.game)
    np.testing.assert_array_equal(whole[at["blue/0 action"]], actions["blue/0"])
    np.testing.assert_allclose(whole[at["time left"]], 1 - after.physics.time / arena.rules.episode, rtol=1e-6)
    assert whole.shape == (arena.privileged_size,)
    assert [index for index, _ in with_indices(arena.privileged_parts())][-1] == str(arena.privileged_size - 1)
    bad = after._replace(physics=after.physics._replace(qvel=after.physics.qvel.at[0].set(jnp.nan)))
    assert np.isfinite(arena.privileged_state(bad)).all()


def test_who_is_out_of_a_game_is_told_where_anybody_can_be():
    assert "alive" not in placed(RaceSettings().build(engine="c", threads=1))
    arena = arenas.settings("galaga-1v1").build(engine="c", threads=1)
    state = jax.jit(arena.reset)(jax.random.key(0))
    dead = state._replace(game=state.game._replace(alive=jnp.zeros_like(state.game.alive)))
    np.testing.assert_array_equal(arena.privileged_state(dead)[placed(arena)["alive"]], [1.0, 0.0])


def test_a_game_without_bodies_has_none():
    arena = arenas.settings("rock-paper-scissors").build(engine="c", threads=1)
    assert (arena.privileged_parts(), arena.privileged_size) == ((), 0)


class Gap(Race):
    def privileged(self, physics, game, actions):
        return jnp.stack([jnp.linalg.norm(physics.qpos[:2] - game), jnp.linalg.norm(physics.qpos[7:9] - game)])


class ToldGap(Gap):
    def privileged_parts(self):
        return (Part("distances", 2, "m", "from the flag"),)


def test_a_game_may_say_something_else_if_it_says_what():
    assert check_shapes(CheckRun(ToldGap(RaceSettings(), engine="c"), jax.random.key(0))) == ""
    problem = check_shapes(CheckRun(Gap(RaceSettings(), engine="c"), jax.random.key(0)))
    assert problem.startswith("the privileged state is float32 (2,), not float32 (")
    assert total_size(ToldGap(RaceSettings(), engine="c").privileged_parts()) == 2


@pytest.mark.parametrize("name", arenas.names())
def test_every_arenas_settings_lead_to_a_state_as_large_as_its_words(name):
    settings = arenas.settings(name)
    arena = settings.build(engine="c", threads=1)
    if arena.privileged_size:
        told = jax.eval_shape(lambda key: arena.privileged_state(arena.reset(key)), jax.random.key(0))
        assert told.shape == (arena.privileged_size,)
        assert told.dtype == jnp.float32
