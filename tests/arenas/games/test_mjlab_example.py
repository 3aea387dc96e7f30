"""The terms of docs/examples/mjlab_velocity.py. Skipped where mjlab, or a package that it imports, is missing."""

import re
import warnings
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from arenas.games.sumo.settings import SumoRules
from arenas.robots.files.catalogue import robot_file
from arenas.robots.rotations import into_body

FILE = Path(__file__).parents[3] / "docs" / "examples" / "mjlab_velocity.py"
WORLDS = 3


@pytest.fixture(scope="module")
def task():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pytest.importorskip("mjlab.tasks.velocity.config.go1.env_cfgs", exc_type=ImportError)
        return arenas.python_file(FILE)


def test_the_robot_has_the_numbers_of_mjlab_s_configuration(task):
    def of(table, name):
        return next(value for pattern, value in table.items() if re.fullmatch(pattern, name))

    robot = task.TASK.scene.entities["robot"]
    motors = {pattern: motor for motor in robot.articulation.actuators for pattern in motor.target_names_expr}
    for name, drive in robot_file("go1").drives.items():
        motor, scale = of(motors, name), of(task.TASK.actions["joint_pos"].scale, name)
        expected = motor.stiffness, motor.damping, motor.effort_limit, motor.armature, scale
        found = drive.kp, drive.kd, drive.effort, drive.armature, drive.scale
        np.testing.assert_allclose(found, expected, rtol=5e-4)
        assert drive.home == pytest.approx(of(robot.init_state.joint_pos, name))


def test_rewards_are_mjlab_s_for_the_side_that_has_the_task(task):
    terms = {name: f"{FILE}:{name}" for name in task.TERMS}
    settings = arenas.settings("sumo-1v1")
    settings = replace(
        settings, blue=("go1",), rules=SumoRules(ring=(2.0, 3.0), decide_every=1, timestep=0.005),
        reward=replace(settings.reward, terms=terms), observation_terms={"command": f"{FILE}:command"},
    )  # fmt: skip
    arena = settings.build(engine="c", threads=1, worlds=WORLDS)
    states = jax.vmap(arena.reset)(jax.random.split(jax.random.key(0), WORLDS))
    actions = {a.name: jnp.full((WORLDS, a.action_size), 0.3) for a in arena.agents}
    for _ in range(5):
        states = jax.jit(jax.vmap(arena.step))(states, actions)
    rewards = {name: np.asarray(states.verdict.rewards[name]) for name in task.TERMS}
    assert all((found[:, 1] == 0).all() for found in rewards.values()), "red has no such task"
    for world in range(WORLDS):
        physics = jax.tree.map(lambda x, world=world: x[world], states.physics)
        game = jax.tree.map(lambda x, world=world: x[world], states.game)
        now = {name: values[world] for name, values in actions.items()}
        body, command = arena.body("blue/0", physics, now), task.command(arena, "blue/0", physics, game, now)
        moves = into_body(body.pose[3:], body.velocity[:3])
        error = float(((command[:2] - moves[:2]) ** 2).sum() + moves[2] ** 2)
        assert rewards["track_linear_velocity"][world, 0] == pytest.approx(2.0 * 0.02 * np.exp(-error / 0.25), rel=1e-4)
        tilt = float((into_body(body.pose[3:], jnp.array([0.0, 0.0, -1.0]))[:2] ** 2).sum())
        assert rewards["upright"][world, 0] == pytest.approx(1.0 * 0.02 * np.exp(-tilt / 0.2), rel=1e-4)
        spread = np.array([0.3, 0.3, 0.6] * 4)  # of a walking command, hip, thigh and calf
        away = np.asarray(body.angles) - np.array(arena.robots["blue/0"].rest)
        expected = 0.02 * np.exp(-np.mean((away / spread) ** 2))
        assert rewards["pose"][world, 0] == pytest.approx(expected, rel=1e-4)
        np.testing.assert_allclose(states.observations["blue/0"][world, -3:], command, rtol=1e-5)
