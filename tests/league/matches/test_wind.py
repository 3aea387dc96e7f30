"""Gusts of wind on a robot of a game: what pushes, what it does, and what the robot sees meanwhile."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from experiments.wind import GUST, STEP, WindyArena, fall_times, gusts, main
from league.config.schema import ConfigError


def test_gusts_begin_each_fifty_steps_decay_and_have_directions_of_their_own():
    forces = gusts(STEP, 200.0, 500, np.random.default_rng(0))
    size = np.linalg.norm(forces, axis=-1)
    assert size.shape == (500, 500)
    assert (size[:GUST] == 0).all()
    np.testing.assert_allclose(size[GUST:], np.tile(200.0 * 0.9 ** np.arange(GUST), 9)[:, None] * np.ones(500))
    assert (forces[..., 2] == 0).all()
    directions = np.arctan2(forces[GUST::GUST, :, 1], forces[GUST::GUST, :, 0])
    assert np.abs(np.exp(1j * directions).mean()) < 0.05  # all directions, in 4,500 gusts


def test_the_impulse_of_a_gust_hardly_depends_on_the_time_of_a_decision():
    ours, theirs = (gusts(dt, 200.0, 1, np.random.default_rng(0)) for dt in (0.02, STEP))
    one, other = (np.linalg.norm(f, axis=-1).sum() * dt for f, dt in ((ours, 0.02), (theirs, STEP)))
    assert one == pytest.approx(other, rel=0.03)


@pytest.fixture(scope="module")
def windy():
    return WindyArena(arenas.settings("sumo-ants").build(engine="c"), "blue/0", "torso")


@pytest.mark.slow
def test_wind_moves_the_robot_along_and_another_robot_is_seen_where_it_began(windy):
    keys = jax.random.split(jax.random.key(1), 3)
    world, nothing = windy.place(keys), jnp.zeros((3, 8))
    seen = jax.vmap(windy.arena.reset)(keys).observations["blue/0"]
    np.testing.assert_allclose(windy.observe(world, nothing), seen, atol=1e-5)
    other = windy.arena.scene.agents["red/0"].own_qpos[:2]
    away = np.linalg.norm(world.physics.qpos[:, other] - world.seen[0][:, other], axis=-1)
    assert (away > 10).all()
    mine = windy.arena.scene.agents["blue/0"].own_qvel[:2]
    calm, blown = (windy.step(world, nothing, jnp.tile(jnp.array([f, 0.0, 0.0]), (3, 1)))[0] for f in (0.0, 100.0))
    gained = np.asarray(blown.physics.qvel[:, mine] - calm.physics.qvel[:, mine])
    assert (gained[:, 0] > 0.1).all()
    assert np.abs(gained[:, 1]).max() < 0.5 * gained[:, 0].min()


@pytest.mark.slow
def test_a_robot_falls_once_and_one_below_no_height_stands_to_the_end(windy):
    forces = gusts(windy.dt, 0.0, 2, np.random.default_rng(0))[:4]

    def policy(observations: np.ndarray) -> np.ndarray:
        return np.zeros((len(observations), 8))

    assert (fall_times(windy, policy, forces, -1.0, 0) == 7.5).all()
    assert fall_times(windy, policy, forces, 100.0, 0) == pytest.approx(windy.dt)


def test_what_cannot_be_pushed_is_told_in_a_line(tmp_path, capsys):
    with pytest.raises(ConfigError, match=r"has no body 'head': \(bodies: torso, [^/]*\)$"):
        WindyArena(arenas.settings("sumo-ants").build(engine="c"), "blue/0", "head")
    with pytest.raises(SystemExit) as ended:
        main([str(tmp_path), "--arena", "sumo-ants", "--player", "blue"])
    assert ended.value.code == 2
    assert "has no folder with a blue.safetensors" in capsys.readouterr().err
