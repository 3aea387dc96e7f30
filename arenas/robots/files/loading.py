"""Robots from files as values, with ANYmal's proprioception and action: their motion, and all driven joints.

A unit of action moves a position target by the drive's `scale` from home, sets a velocity target, or is a torque. The
action is not clipped, but targets are where the drive has a range of them, and so are the joints' efforts.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.description import Part
from arenas.errors import RobotError
from arenas.robots.files.body import build_body, check_names
from arenas.robots.files.catalogue import model_path, robot_file
from arenas.robots.files.driving import wheel_drive
from arenas.robots.files.robot_file import RobotFile
from arenas.robots.files.source import Source, read_source
from arenas.robots.robot import MOTION, Body, Robot, idle_script, random_script
from arenas.robots.rotations import into_body, up_z

UNITS = {"position": "rad of the target from home", "velocity": "rad/s of the target", "torque": "N·m"}


@dataclass(frozen=True)
class Gains:
    """The drives as arrays (joints,), in their order."""

    home: np.ndarray
    scale: np.ndarray
    kp: np.ndarray
    kd: np.ndarray
    effort: np.ndarray  # infinite without a limit
    offset: np.ndarray  # command of the zero action: home of position targets, else 0
    direct: np.ndarray  # 1 where the command is a torque
    low: np.ndarray  # of commands; infinite without a limit
    high: np.ndarray

    @classmethod
    def of(cls, robot: RobotFile) -> "Gains":
        """Return the gains of a robot file."""
        drives = robot.drives.values()
        home = np.array([drive.home for drive in drives], np.float32)
        position = np.array([drive.control == "position" for drive in drives], np.float32)
        torque = np.array([drive.control == "torque" for drive in drives], np.float32)
        scale, kp, kd = (np.array([getattr(d, key) for d in drives], np.float32) for key in ("scale", "kp", "kd"))
        effort = np.array([drive.effort or np.inf for drive in drives], np.float32)
        ranges = [(d.target_low, d.target_high) if d.target_low or d.target_high else (-np.inf, np.inf) for d in drives]
        low, high = np.array(ranges, np.float32).T
        return cls(home, scale, kp * position, kd * (1 - torque), effort, home * position, torque, low, high)

    def command(self, action: Array) -> Array:
        """Return the commands (joints,) of an action: targets, or torques."""
        return jnp.clip(jnp.asarray(self.offset) + self.scale * action, self.low, self.high)

    def torques(self, angles: Array, speeds: Array, command: Array) -> Array:
        """Return the torques (joints,) in N·m that the motors apply; all arguments (joints,)."""
        velocity = (1 - self.direct) * (self.kp == 0)
        wanted = self.kp * (command - angles) + self.kd * (velocity * command - speeds) + self.direct * command
        return jnp.clip(wanted, -self.effort, self.effort)


def file_robot(name: str) -> Robot:
    """Make the robot of a file, or one whose model comes in a wheel. Raises RobotError, one line.

    It knows the scripts `idle`, which holds the standing pose where targets are positions, and `random`; where it has
    wheels, games have scripts that drive it.
    """
    return robot_of(robot_file(name))


def robot_of(settings: RobotFile) -> Robot:
    """Make the robot of these settings. Raises RobotError, one line, if its model is missing or does not fit them."""
    source = source_of(settings)
    gains, count = Gains.of(settings), len(settings.drives)
    names = ", ".join(settings.drives)
    controls = {drive.control for drive in settings.drives.values()}
    unit = " or ".join(UNITS[control] for control in UNITS if control in controls)
    return Robot(
        kind=settings.name,
        action_size=count,
        build=lambda colour: build_body(source, settings, colour),
        base=settings.base,
        joints=tuple(settings.drives),
        actuators=tuple(settings.drives),
        rest_height=settings.height,
        rest=tuple(map(float, gains.home)),
        command=gains.command,
        proprioception=_sensing(gains),
        fallen=lambda pose: (pose[2] < settings.fall_height) | (up_z(pose[3:]) < settings.fall_up),
        scripts={"idle": idle_script(count), "random": random_script(count)},
        proprioception_parts=(
            *MOTION, Part("joint angles", count, "rad", f"less the standing pose: {names}"),
            Part("joint speeds", count, "rad/s", "in the same order"), Part("last action", count),
        ),
        action_parts=(Part("drives", count, "", f"in units of each one's scale, {unit}: {names}"),),
        drive=wheel_drive(source, settings),
        radius=settings.width / 2,
        feet=settings.feet,
        torques=gains.torques,
        ls_iterations=settings.ls_iterations,
        identity=settings.identity,
    )  # fmt: skip


def source_of(settings: RobotFile) -> Source:
    """Read the model of a robot file, again only after it changed. Raises RobotError."""
    path = model_path(settings)
    source = _read(str(path), path.stat().st_mtime_ns, settings.free_base)
    check_names(source, settings)
    if source.planar != settings.planar:
        moves = "in a plane alone" if source.planar else "freely"
        raise RobotError(
            f"robot {settings.name}: base {settings.base} moves {moves}: set planar = {source.planar!s:.5}"
        )
    return source


@cache
def _read(path: str, changed: int, free_base: bool) -> Source:
    from pathlib import Path

    return read_source(Path(path), free_base)


def _sensing(gains: Gains) -> Callable[[Body], Array]:
    def sense(body: Body) -> Array:
        """Return velocity, rates, down direction, joints from home, their speeds, the last action."""
        quat = body.pose[3:]
        down = into_body(quat, jnp.array([0.0, 0.0, -1.0]))
        moves = into_body(quat, body.velocity[:3])
        return jnp.concatenate([moves, body.velocity[3:], down, body.angles - gains.home, body.speeds, body.action])

    return sense
