"""Compilation of robots, props and ground into one MjModel, with the indices of each by name."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from arenas.arena_settings import Solver
from arenas.errors import ArenaError
from arenas.robots.robot import Robot
from arenas.scene.colours import TEAM_COLOURS
from arenas.scene.props import Prop


@dataclass(frozen=True)
class Indices:
    """Indices of one robot's numbers in the model's arrays."""

    base: int  # body id of the base
    qpos: int  # first of a free base's 7 positions: x, y, z, quaternion w first; of a planar base's 3: x, z, pitch
    qvel: int  # first of the base's 6 velocities: linear in the world frame, angular in the body frame; or of its 3
    ctrl: np.ndarray  # (robot.nu,) actuators, in the robot's own order
    joint_qpos: np.ndarray  # (robot joints,) in the robot's own order
    joint_qvel: np.ndarray
    own_qpos: np.ndarray  # all positions of this robot, passive joints too
    own_qvel: np.ndarray  # all its velocities
    height: float | None = None  # m, of a planar base whose z is 0: it moves in the world's x and z; None: a free base

    @property
    def planar(self) -> bool:
        """Return whether the base moves in the world's x and z alone."""
        return self.height is not None

    def pose(self, qpos: Array) -> Array:
        """Return the base's pose (7,) in the world from qpos (nq,): x, y, z in metres, quaternion w first."""
        if self.height is None:
            return qpos[self.qpos : self.qpos + 7]
        x, z, pitch = qpos[self.qpos : self.qpos + 3]
        zero = jnp.zeros(())
        return jnp.stack([x, zero, self.height + z, jnp.cos(pitch / 2), zero, jnp.sin(pitch / 2), zero])

    def velocity(self, qvel: Array) -> Array:
        """Return the base's velocity (6,) from qvel (nv,): linear in the world, m/s; angular in its frame, rad/s."""
        if self.height is None:
            return qvel[self.qvel : self.qvel + 6]
        x, z, pitch = qvel[self.qvel : self.qvel + 3]
        zero = jnp.zeros(())
        return jnp.stack([x, zero, z, zero, pitch, zero])


@dataclass(frozen=True)
class PropIndices:
    """Indices of one prop's numbers; `qpos` and `qvel` are None if it cannot move."""

    body: int
    geoms: np.ndarray  # ids
    qpos: int | None  # first of its 7 positions
    qvel: int | None  # first of its 6 velocities


@dataclass(frozen=True)
class Scene:
    """A compiled model with the indices of each agent and prop by name, such as `blue/0` and `ball`."""

    model: mujoco.MjModel
    xml: str  # the compiled model as MJCF, which is enough to replay a recording
    agents: Mapping[str, Indices]  # agents with a body
    props: Mapping[str, PropIndices]
    rest: np.ndarray  # (nq,) all bodies at their built places, robots' joints at their rest angles


def build(
    teams: Mapping[str, Sequence[Robot]], props: Sequence[Prop] = (), *, solver: Solver | None = None, timestep: float
) -> Scene:
    """Put each team's robots, under the prefix `team/index/`, and the props, under `name/`, on one ground; compile.

    Robots without a body leave no trace in the model. The solver takes as many line-search steps as the robot asks for
    that needs most. Raises ArenaError if two of them share a name.
    """
    solver = solver or Solver()
    steps = [robot.ls_iterations for members in teams.values() for robot in members]
    solver = replace(solver, ls_iterations=max([solver.ls_iterations, *steps]))
    names = [*teams, *(prop.name for prop in props)]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise ArenaError(f"{', '.join(sorted(twice))}: teams and props of a scene need names of their own")
    spec = _ground(solver, timestep)
    robots: dict[str, Robot] = {}
    for team, (name, members) in enumerate(teams.items()):
        for index, robot in enumerate(members):
            if robot.build is not None:
                robots[f"{name}/{index}"] = robot
                _attach(spec, robot.build(TEAM_COLOURS[team % len(TEAM_COLOURS)]), f"{name}/{index}/")
    for prop in props:
        body = _attach(spec, prop.build(), f"{prop.name}/")
        if prop.free:
            body.add_freejoint(name=f"{prop.name}/base")
    model = spec.compile()
    agents = {agent: _indices(model, agent, robot) for agent, robot in robots.items()}
    rest = model.qpos0.copy()
    for agent, robot in robots.items():
        if robot.rest:
            rest[agents[agent].joint_qpos] = robot.rest
    return Scene(model, spec.to_xml(), agents, {prop.name: _prop_indices(model, prop) for prop in props}, rest)


def _ground(solver: Solver, timestep: float) -> mujoco.MjSpec:
    """Make a spec with options, ground and light, and nothing that moves."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.modelname = "arena"
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    pyramidal = solver.cone == "pyramidal"
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL if pyramidal else mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.iterations, spec.option.ls_iterations = solver.iterations, solver.ls_iterations
    spec.option.impratio = solver.impratio
    # The ground is as slippery as chassis (0.3); tyres set their own friction by priority.
    spec.worldbody.add_geom(
        name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05], contype=1, conaffinity=0,
        friction=[0.3, 0.005, 0.0001], rgba=[0.32, 0.34, 0.37, 1],
    )  # fmt: skip
    spec.worldbody.add_light(pos=[0, 0, 6], dir=[0, 0, -1])
    return spec


def _attach(spec: mujoco.MjSpec, part: mujoco.MjSpec, prefix: str) -> mujoco.MjsBody:
    return spec.worldbody.add_frame().attach_body(part.worldbody.first_body(), prefix, "")


def _indices(model: mujoco.MjModel, agent: str, robot: Robot) -> Indices:
    base = model.body(f"{agent}/{robot.base}").id
    root = model.body_jntadr[base]
    planar = model.jnt_type[root] != mujoco.mjtJoint.mjJNT_FREE
    joints = [model.joint(f"{agent}/{name}").id for name in robot.joints]
    own = [model.joint(i) for i in range(model.njnt) if model.joint(i).name.startswith(f"{agent}/")]
    return Indices(
        base=base,
        qpos=int(model.jnt_qposadr[root]),
        qvel=int(model.jnt_dofadr[root]),
        ctrl=np.array([model.actuator(f"{agent}/{name}").id for name in robot.actuators], int),
        joint_qpos=model.jnt_qposadr[joints],
        joint_qvel=model.jnt_dofadr[joints],
        own_qpos=np.concatenate([np.arange(j.qposadr[0], j.qposadr[0] + len(j.qpos0)) for j in own]),
        own_qvel=np.concatenate([np.arange(j.dofadr[0], j.dofadr[0] + len(j.damping)) for j in own]),
        height=float(model.body_pos[base][2]) if planar else None,
    )


def _prop_indices(model: mujoco.MjModel, prop: Prop) -> PropIndices:
    prefix = f"{prop.name}/"
    body = next(i for i in range(model.nbody) if model.body(i).name.startswith(prefix))
    geoms = np.array([i for i in range(model.ngeom) if model.geom(i).name.startswith(prefix)], int)
    joint = model.body_jntadr[body]
    qpos, qvel = (int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])) if prop.free else (None, None)
    return PropIndices(int(body), geoms, qpos, qvel)
