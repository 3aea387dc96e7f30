"""Robots and props are values: a game composes what they bring and asks for no kind."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import arenas
from arenas.arena_settings import Solver
from arenas.contract.check import check_arena
from arenas.contract.check_run import WORLDS
from arenas.errors import ArenaError
from arenas.game import check_scripts
from arenas.games.sumo.match import Sumo
from arenas.robots.leatherback import leatherback
from arenas.robots.puck import PUCK
from arenas.robots.rotations import into_body
from arenas.scene.props import ball, block, goal, wall
from arenas.scene.scene import build
from tests.arenas.walker import REST, WALKER, spring

ROVER = leatherback()
MIXED = {"blue": (WALKER, ROVER), "red": (ROVER, WALKER)}


@pytest.fixture(scope="module")
def mixed():
    return Sumo(arenas.settings("sumo-2v2"), MIXED, engine="c", worlds=WORLDS)


@pytest.mark.slow
def test_sumo_takes_robots_of_another_kind(mixed):
    assert [p for p in check_arena(mixed) if not p.ok] == []
    assert mixed.teams[0].roster == "walker:42:2+leatherback:38:2"
    assert {name: set(kinds) for name, kinds in mixed.scripts().items()} == {
        "idle": {"walker", "leatherback"},
        "random": {"walker", "leatherback"},
        "pusher": {"leatherback"},
        "centre-holder": {"leatherback"},
    }
    assert mixed.playable_scripts(mixed.teams[0]) == ("idle", "random")
    assert set(check_scripts(mixed, "pusher")) == {"leatherback"}


def test_robots_start_in_their_rest_pose_and_feel_their_own_joints(mixed):
    state = jax.jit(mixed.reset)(jax.random.key(0))
    at = mixed.scene.agents["red/1"]
    np.testing.assert_allclose(state.physics.qpos[at.joint_qpos], REST, atol=1e-6)
    np.testing.assert_allclose(state.physics.qpos[at.qpos + 2], 0.2, atol=1e-6)
    moved = state.physics.qpos.at[at.joint_qpos].set(jnp.array([0.5, -0.1]))
    actions = {a.name: jnp.full(2, 0.7) for a in mixed.agents}
    seen = jax.jit(mixed.observe)(state.physics._replace(qpos=moved), state.game, actions)["red/1"]
    np.testing.assert_allclose(seen[0:6], [0.2, 0.2, 0.0, 0.0, 0.7, 0.7], atol=1e-6)


def test_each_robot_falls_by_its_own_rule(mixed):
    qpos = jnp.asarray(mixed.scene.rest, jnp.float32)
    walker, rover = (mixed.scene.agents[name].qpos for name in ("blue/0", "red/0"))
    physics = jax.jit(mixed.reset)(jax.random.key(0)).physics
    assert mixed.fallen(physics._replace(qpos=qpos)).tolist() == [False] * 4
    down = qpos.at[walker + 2].set(0.05).at[rover + 2].set(0.05)  # low is a fall for walkers alone
    assert mixed.fallen(physics._replace(qpos=down)).tolist() == [True, False, False, False]
    on_back = qpos.at[rover + 3 : rover + 7].set(jnp.array([0.0, 1.0, 0.0, 0.0]))
    assert mixed.fallen(physics._replace(qpos=on_back)).tolist() == [False, False, True, False]


def test_laws_act_on_their_own_robot_alone(mixed):
    rng = np.random.default_rng(0)
    model = mixed.scene.model
    qpos, qvel, command = (jnp.asarray(rng.normal(size=n), jnp.float32) for n in (model.nq, model.nv, model.nu))
    ctrl = np.asarray(mixed.law(qpos, qvel, command))
    for agent, at in mixed.scene.agents.items():
        own = command[at.ctrl]
        if agent in ("blue/0", "red/1"):
            own = spring(qpos[at.joint_qpos], qvel[at.joint_qvel], own)
        np.testing.assert_allclose(ctrl[at.ctrl], own, rtol=1e-6)
    left, right = (mixed.scene.model.actuator(f"blue/0/{side}_motor").id for side in ("left", "right"))
    assert mixed.scene.agents["blue/0"].ctrl.tolist() == [left, right]


def test_robots_without_laws_cost_none():
    assert arenas.load("sumo-1v1", engine="c").law is None


def test_sumo_is_for_two_teams():
    with pytest.raises(ArenaError, match=r"^sumo needs two teams; these are blue$"):
        Sumo(arenas.settings("sumo-2v2"), {"blue": (ROVER,)}, engine="c")


def test_slots_are_of_kinds_that_have_a_layout():
    with pytest.raises(ArenaError, match=r"\"slots\" is of anymal, leatherback, minitank; for .* walker use \"rich\"$"):
        Sumo(replace(arenas.settings("sumo-2v2"), observation="slots"), MIXED, engine="c")


def test_a_rest_pose_is_of_all_joints():
    with pytest.raises(ValueError, match=r"^robot walker: rest has 1 angles for 2 joints$"):
        replace(WALKER, rest=(0.1,))


def test_world_vectors_turn_into_the_body():
    quarter = jnp.array([np.cos(np.pi / 4), 0.0, 0.0, np.sin(np.pi / 4)])  # nose to +y
    np.testing.assert_allclose(into_body(quarter, jnp.array([0.0, 2.0, 1.0])), [2.0, 0.0, 1.0], atol=1e-6)
    rng = np.random.default_rng(1)
    quat, vector = rng.normal(size=4), rng.normal(size=3)
    quat /= np.linalg.norm(quat)
    back = np.zeros(9)
    mujoco.mju_quat2Mat(back, quat)
    np.testing.assert_allclose(into_body(jnp.array(quat), jnp.array(vector)), back.reshape(3, 3).T @ vector, atol=1e-5)


PITCH = (
    ball(radius=0.12, mass=0.4),
    block("crate", half=(0.2, 0.2, 0.2), mass=1.0, at=(3.0, 0.0)),
    wall("north", at=(0.0, 2.0, 0.2), half=(4.0, 0.05, 0.2)),
    goal("west-goal", at=(-4.0, 0.0, 0.3), half=(0.2, 0.6, 0.3)),
)


def test_props_are_found_by_name_and_stand_where_they_were_built():
    scene = build({"blue": (ROVER,), "red": (PUCK,)}, PITCH, timestep=0.005)
    model, props = scene.model, scene.props
    assert set(props) == {"ball", "crate", "north", "west-goal"}
    assert (props["north"].qpos, props["west-goal"].qvel) == (None, None)
    np.testing.assert_allclose(scene.rest[props["crate"].qpos : props["crate"].qpos + 3], [3.0, 0.0, 0.2])
    np.testing.assert_allclose(model.body_pos[props["west-goal"].body], [-4.0, 0.0, 0.3])
    assert [model.geom(i).name for i in props["ball"].geoms] == ["ball/ball"]
    assert model.nq == sum(len(at.own_qpos) for at in scene.agents.values()) + 14
    assert len(scene.agents["blue/0"].own_qvel) == 12


def test_props_touch_what_they_should():
    """A ball falls onto the ground and rolls into a wall; it flies through a goal."""
    scene = build({"blue": (ROVER,)}, PITCH, timestep=0.005)
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.rest
    at = scene.props["ball"]
    data.qpos[at.qpos : at.qpos + 3] = [2.0, 1.0, 0.3]
    data.qvel[at.qvel + 1] = 3.0
    other = mujoco.MjData(scene.model)
    other.qpos[:] = scene.rest
    other.qpos[at.qpos : at.qpos + 3] = [-3.0, 0.0, 0.12]
    other.qvel[at.qvel] = -3.0
    for _ in range(200):
        mujoco.mj_step(scene.model, data)
        mujoco.mj_step(scene.model, other)
    assert data.qpos[at.qpos + 1] < 2.0 - 0.05 - 0.1
    assert data.qpos[at.qpos + 2] == pytest.approx(0.12, abs=0.01)
    assert other.qpos[at.qpos] < -4.5


def test_names_are_given_once():
    with pytest.raises(ArenaError, match=r"^ball: teams and props of a scene need names of their own$"):
        build({"ball": (PUCK,)}, PITCH, timestep=0.005)


def test_solver_options_reach_the_model():
    solver = Solver(iterations=3, ls_iterations=7, cone="elliptic", impratio=5.0)
    option = build({"blue": (PUCK,)}, solver=solver, timestep=0.004).model.opt
    assert (option.iterations, option.ls_iterations, option.impratio, option.timestep) == (3, 7, 5.0, 0.004)
    assert option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
