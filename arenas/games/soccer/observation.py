"""Observations of soccer's robots: HARL-A's seven vectors, some of which are zeros in the curriculum's earlier stages.

| index of an ANYmal | index of a rover | content                                                                  |
|--------------------|------------------|--------------------------------------------------------------------------|
| 0-44               |                  | proprioception                                                           |
|                    | 0-2              | velocity, m/s                                                            |
| 45-47              | 3-5              | the ball; in the walk the point to walk to                               |
| 48-50              | 6-8              | the ball's velocity relative to the robot, m/s                           |
| 51-53              | 9-11             | middle of the goal that it attacks, 0.05 m above the ground              |
| 54-56              | 12-14            | the other goal                                                           |
| 57-59              | 15-17            | team-mate                                                                |
| 60-62, 63-65       | 18-20, 21-23     | enemies 0 and 1                                                          |
| 66-                | 24-              | tail: further team-mates, further enemies, then zeros                    |

All are in the robot's full base frame, including roll and pitch, positions in metres. Absent robots are zeros. The tail
has `buffer` numbers, or three for each robot without a vector if those are more.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from arenas.description import Part
from arenas.games.soccer.observation_layout import (
    ENEMIES,
    GOAL_HEIGHT,
    MATES,
    OWN_SIZE,
    VECTORS,
    agents_without_vector,
    feels_joints,
    parts,
    size,
)
from arenas.games.sumo.observation_layout import other_names
from arenas.games.sumo.walk import WalkObservation
from arenas.robots.robot import Body, Robot
from arenas.robots.rotations import into_body

WHERE = "position in its own frame"


class Ball(NamedTuple):
    """The ball in the world."""

    position: Array  # (3,) m
    velocity: Array  # (3,) m/s


def fill(robot: Robot, body: Body, vectors: Sequence[Array], buffer: int = 0) -> Array:
    """Return the observation (size,) of the seven vectors (3,), and those after them, in the robot's frame."""
    begins = robot.observe_self(body) if feels_joints(robot.kind) else into_body(body.pose[3:], body.velocity[:3])
    unused = jnp.zeros(max(0, buffer - 3 * (len(vectors) - VECTORS)))
    return jnp.concatenate([begins, *vectors, unused])


def walk_observation(buffer: int) -> WalkObservation:
    """Return the walk's layout: its goal in the place of the ball, all else zeros."""
    none = [jnp.zeros(3)] * (VECTORS - 1)
    return WalkObservation(
        size(OWN_SIZE["anymal"], 0, buffer),
        OWN_SIZE["anymal"],
        lambda robot, body, goal: fill(robot, body, [goal, *none], buffer),
        lambda robot, goal: parts(robot.kind, robot.sensed_parts, [f"{goal}: {WHERE}", *[""] * (VECTORS - 1)], buffer),
    )


class ObservationBuilder:
    """Observations of two teams, or of one alone: `teams` are the agents' names by team."""

    def __init__(self, robots: Mapping[str, Robot], teams: Sequence[Sequence[str]], goal_at: float, buffer: int):
        self.robots, self.buffer, self._goal_at = robots, buffer, goal_at
        pairs = [(own, [name for team in teams if team is not own for name in team]) for own in teams]
        self._sides = {me: ([name for name in own if name != me], other) for own, other in pairs for me in own}

    def size(self, agent: str) -> int:
        """Return the size of an agent's observation."""
        mates, enemies = self._sides[agent]
        robot = self.robots[agent]
        own = robot.proprioception_size if feels_joints(robot.kind) else OWN_SIZE[robot.kind]
        return size(own, agents_without_vector(1 + len(mates), len(enemies)), self.buffer)

    def parts(self, agent: str) -> tuple[Part, ...]:
        """Describe an agent's observation."""
        mates, enemies = self._sides[agent]
        called = dict(zip([*mates, *enemies], other_names(len(mates), len(enemies)), strict=True))
        slot_agents = [f"{called[you]}: {WHERE}" if you else "" for you in self.slot_agents(agent)]
        seen = [
            f"the ball: {WHERE}", "of the ball relative to the robot, in its own frame",
            f"the goal that it attacks: {WHERE}", f"the other goal: {WHERE}", *slot_agents,
        ]  # fmt: skip
        robot = self.robots[agent]
        return parts(robot.kind, robot.sensed_parts, seen, self.buffer)

    def slot_agents(self, agent: str) -> list[str | None]:
        """Return the team-mate and the two enemies with vectors, None for absent ones, and then all further robots."""
        mates, enemies = self._sides[agent]
        placed = [*mates, *[None] * MATES][:MATES], [*enemies, *[None] * ENEMIES][:ENEMIES]
        return [*placed[0], *placed[1], *mates[MATES:], *enemies[ENEMIES:]]

    def observe(self, bodies: Mapping[str, Body], ball: Ball, attacks: Mapping[str, Array]) -> dict[str, Array]:
        """Return every agent's observation as in the table above; `attacks` is 1 for an agent that plays towards +x,
        else -1.
        """
        return {agent: self._observe(agent, bodies, ball, attacks[agent]) for agent in self.robots}

    def _observe(self, agent: str, bodies: Mapping[str, Body], ball: Ball, attacks: Array) -> Array:
        body = bodies[agent]
        quat = body.pose[3:]
        goal = jnp.stack([attacks * self._goal_at, jnp.zeros(()), jnp.asarray(GOAL_HEIGHT)])
        own = goal * jnp.array([-1.0, 1.0, 1.0])
        points = [ball.position, goal, own, *(bodies[you].pose[:3] if you else None for you in self.slot_agents(agent))]
        there, *rest = (jnp.zeros(3) if point is None else into_body(quat, point - body.pose[:3]) for point in points)
        moves = into_body(quat, ball.velocity - body.velocity[:3])
        return fill(self.robots[agent], body, [there, moves, *rest], self.buffer)
