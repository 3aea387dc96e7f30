"""The actuation laws of all robots of a scene as one law."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from arenas.physics.engine import Law
from arenas.robots.robot import Robot
from arenas.scene.scene import Scene


def compose_laws(scene: Scene, robots: Mapping[str, Robot]) -> Law | None:
    """Combine the robots' laws, each over its own joints and actuators, into one. None if no robot has a law."""
    laws = [(scene.agents[agent], robot.law) for agent, robot in robots.items() if robot.law]
    if not laws:
        return None
    driven = np.concatenate([at.ctrl for at, _ in laws])
    plain = np.setdiff1d(np.arange(scene.model.nu), driven)
    place = np.argsort(np.concatenate([driven, plain]))

    def law(qpos: Any, qvel: Any, command: Any) -> Any:
        ctrl = [own(qpos[..., at.joint_qpos], qvel[..., at.joint_qvel], command[..., at.ctrl]) for at, own in laws]
        arrays = command.__array_namespace__()  # jax.numpy, or numpy in the C engine
        return arrays.concat([*ctrl, command[..., plain]], axis=-1)[..., place]

    return law
