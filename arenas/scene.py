"""From robots and ground to one MjModel, and from names to indices, once."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from arenas.robots.robot import Robot

TEAM_COLOURS = ((0.16, 0.42, 0.90, 1.0), (0.88, 0.22, 0.20, 1.0), (0.16, 0.66, 0.36, 1.0), (0.90, 0.66, 0.12, 1.0))


@dataclass(frozen=True)
class Indices:
    """Where one robot's numbers stand in the model's arrays."""

    base: int  # body id of the free base
    qpos: int  # first of the base's 7 positions: x, y, z, quaternion w first
    qvel: int  # first of the base's 6 velocities: linear in the world frame, angular in the body frame
    ctrl: np.ndarray  # (robot.nu,) actuators, in the robot's own order
    joint_qpos: np.ndarray  # (robot joints,) in the robot's own order
    joint_qvel: np.ndarray


@dataclass(frozen=True)
class Scene:
    """A compiled model with the indices of each agent, keyed by agent name such as `blue/0`."""

    model: mujoco.MjModel
    xml: str  # the compiled model as MJCF: with it a recording replays alone
    agents: Mapping[str, Indices]


def build(teams: Mapping[str, Sequence[Robot]], *, timestep: float) -> Scene:
    """Attach each team's robots to one ground plane under the prefix `team/index/` and compile.

    Newton with 10 iterations and 20 line-search steps is converged on contact-rich scenes and leaves its loop early, so
    the cap costs little (measured against a converged solve; fewer iterations were not faster).
    """
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.modelname = "arena"
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    spec.option.iterations, spec.option.ls_iterations = 10, 20
    # The ground slides as little as chassis do (0.3); tyres bring their own grip by priority.
    spec.worldbody.add_geom(
        name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05], contype=1, conaffinity=0,
        friction=[0.3, 0.005, 0.0001], rgba=[0.32, 0.34, 0.37, 1],
    )  # fmt: skip
    spec.worldbody.add_light(pos=[0, 0, 6], dir=[0, 0, -1])
    robots: dict[str, Robot] = {}
    for team, (name, members) in enumerate(teams.items()):
        for index, robot in enumerate(members):
            agent = f"{name}/{index}"
            robots[agent] = robot
            frame = spec.worldbody.add_frame()
            frame.attach_body(
                robot.build(TEAM_COLOURS[team % len(TEAM_COLOURS)]).worldbody.first_body(), f"{agent}/", ""
            )
    model = spec.compile()
    return Scene(model, spec.to_xml(), {agent: _indices(model, agent, robot) for agent, robot in robots.items()})


def _indices(model: mujoco.MjModel, agent: str, robot: Robot) -> Indices:
    base = model.body(f"{agent}/{robot.base}").id
    free = model.body_jntadr[base]
    joints = [model.joint(f"{agent}/{name}").id for name in robot.joints]
    return Indices(
        base=base,
        qpos=int(model.jnt_qposadr[free]),
        qvel=int(model.jnt_dofadr[free]),
        ctrl=np.array([model.actuator(f"{agent}/{name}").id for name in robot.actuators]),
        joint_qpos=model.jnt_qposadr[joints],
        joint_qvel=model.jnt_dofadr[joints],
    )
