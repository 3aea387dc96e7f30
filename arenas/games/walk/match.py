"""The walk of any robot with feet: rules and reward of `arenas.games.sumo.walk`, read from the robot's own shapes.

The observation is the robot's proprioception and then the goal (3,), 0.25 m above the ground, in its own frame.
"""

from collections.abc import Mapping, Sequence
from typing import Unpack

import jax.numpy as jnp
from jax import Array

from arenas.arena_settings import EngineOptions, Solver
from arenas.description import Part
from arenas.errors import ArenaError
from arenas.games.sumo.walk import WALKER, Walk, WalkObservation
from arenas.games.walk.settings import GOAL, RobotWalkSettings
from arenas.physics.engine import Physics
from arenas.robots.anymal import anymal
from arenas.robots.files.loading import file_robot
from arenas.robots.kinds import kind_of
from arenas.robots.kinematics import HeightReader, Heights
from arenas.robots.robot import Body, Robot
from arenas.scene.props import Prop

SPARE_CONTACTS, SPARE_ROWS = 4, 36  # of Warp's buffers, besides those of the kind


class RobotWalk(Walk):
    """A robot, called `blue/0`, and its goal."""

    def __init__(
        self,
        settings: RobotWalkSettings,
        others: Mapping[str, Sequence[Robot]] | None = None,
        props: Sequence[Prop] = (),
        **options: Unpack[EngineOptions],
    ):
        """Build the walk; `others` and `props` are those of `Walk`."""
        name = settings.blue[0]
        robot, room = walker_of(name), kind_of(name)
        solver = Solver(contacts=SPARE_CONTACTS + room.contacts, rows=SPARE_ROWS + room.rows)
        super().__init__(settings, observation(robot, settings.buffer), robot, solver, others, props, **options)
        feet = [f"{WALKER}/{foot}" for foot in robot.feet]
        self._heights = HeightReader(self.scene.model, self._at.base, feet)

    def heights(self, physics: Physics, body: Body) -> Heights:
        """Return the heights of torso, limbs and feet."""
        return self._heights.read(physics.qpos)

    def down(self, physics: Physics, body: Body, low: Heights) -> Array:
        """Return () bool: it has fallen by the walk's rule, or its own."""
        return super().down(physics, body, low) | self.fallen(physics)[0]


def walker_of(name: str) -> Robot:
    """Make the robot of a kind. Raises ArenaError, one line, for one without feet."""
    robot = anymal() if name == "anymal" else file_robot(name)
    if not robot.feet:
        raise ArenaError(f"robot {name} has no feet to walk on: name them in its robot file, feet = [bodies]")
    return robot


def observation(robot: Robot, buffer: int) -> WalkObservation:
    """Return the layout: proprioception, the goal, `buffer` zeros."""
    own = robot.proprioception_size
    zeros = (Part("buffer", buffer, "", "zeros, reserved for later stages"),) if buffer else ()
    return WalkObservation(
        own + GOAL + buffer,
        own,
        lambda robot, body, goal: jnp.concatenate([robot.observe_self(body), goal, jnp.zeros(buffer)]),
        lambda robot, goal: (
            *robot.sensed_parts,
            Part("goal", GOAL, "m", f"{goal}: position in its own frame"),
            *zeros,
        ),
    )
