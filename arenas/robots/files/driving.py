"""Driving of robots on wheels: joints by velocity on both sides of the base whose axles lie across it."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.robots.files.body import home_pose
from arenas.robots.files.robot_file import RobotFile
from arenas.robots.files.source import Source

ACROSS = 0.7  # least share of an axle along the base's y axis
SPEED, TURN = 0.4, 0.3  # shares of the wheels' speed: ahead, and by which the sides differ in a full turn
SLOW = 0.6  # m from its aim, within which it slows down in proportion where it should stop

Drive = Callable[[Array, bool], Array]  # position (2,) m ahead and left, stop there? -> action (joints,)


def wheel_drive(source: Source, robot: RobotFile) -> Drive | None:
    """Return a drive towards a position, as of a tank: sides at different speeds. None without wheels on both sides.

    Other joints stay at the zero action.
    """
    data, ids = home_pose(source, robot.drives), {source.joint(j): j for j in source.joints}
    base = data.xpos[source.base]
    forward, side = np.zeros(len(robot.drives)), np.zeros(len(robot.drives))
    for n, (name, drive) in enumerate(robot.drives.items()):
        axle, y = data.xaxis[ids[name]], float(data.xanchor[ids[name]][1] - base[1])
        if drive.control == "velocity" and abs(axle[1]) > ACROSS and abs(y) > 1e-3:
            forward[n], side[n] = np.sign(axle[1] * drive.scale), np.sign(y)
    if not {-1.0, 1.0} <= set(side):
        return None

    def drive_towards(position: Array, stops: bool) -> Array:
        bearing = jnp.arctan2(position[1], position[0])
        speed = jnp.clip(jnp.linalg.norm(position) / SLOW, 0.0, 1.0) if stops else jnp.ones(())
        ahead = SPEED * jnp.maximum(0.0, jnp.cos(bearing))
        turn = TURN * jnp.clip(2.0 * bearing, -1.0, 1.0)
        return jnp.asarray(forward, jnp.float32) * speed * (ahead - jnp.asarray(side, jnp.float32) * turn)

    return drive_towards
