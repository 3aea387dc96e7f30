"""What soccer's robots see: HARL-A's seven vectors, some of which are zeros in the earlier stages of the curriculum.

| index of an ANYmal | index of a rover | what                                                                     |
|--------------------|------------------|--------------------------------------------------------------------------|
| 0-44               |                  | what it feels of itself                                                  |
|                    | 0-2              | velocity, m/s                                                            |
| 45-47              | 3-5              | the ball; in the walk the point to walk to                               |
| 48-50              | 6-8              | the ball's velocity less its own, m/s                                    |
| 51-53              | 9-11             | the goal that it plays at, its middle, 0.05 m above the ground           |
| 54-56              | 12-14            | the other goal                                                           |
| 57-59              | 15-17            | team-mate                                                                |
| 60-62, 63-65       | 18-20, 21-23     | enemies 0 and 1                                                          |
| 66-                | 24-              | tail: further team-mates, further enemies, then zeros                    |

All are in the robot's full base frame, roll and pitch too, positions in metres. Who is not there is zeros. The tail has
`buffer` numbers, or three for each robot that has no place where those are more.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from arenas.about import Part
from arenas.robots.robot import Body, Robot
from arenas.rotations import into_body
from arenas.soccer.layouts import BEGINNING, ENEMIES, GOAL_HEIGHT, MATES, VECTORS, extra, parts, size
from arenas.sumo.layouts import others
from arenas.sumo.walk import Sight as WalkSight

WHERE = "where, in its own frame"


class Ball(NamedTuple):
    """The ball in the world."""

    position: Array  # (3,) m
    velocity: Array  # (3,) m/s


def fill(robot: Robot, body: Body, vectors: Sequence[Array], buffer: int = 0) -> Array:
    """The observation (size,) of the seven vectors (3,), and those after them, in the robot's frame."""
    begins = robot.feels(body) if robot.kind == "anymal" else into_body(body.pose[3:], body.velocity[:3])
    unused = jnp.zeros(max(0, buffer - 3 * (len(vectors) - VECTORS)))
    return jnp.concatenate([begins, *vectors, unused])


def walking(buffer: int) -> WalkSight:
    """How the walk sees its point: where the ball will be; all else is zeros."""
    none = [jnp.zeros(3)] * (VECTORS - 1)
    return WalkSight(
        size("anymal", 0, buffer),
        BEGINNING["anymal"],
        lambda robot, body, goal: fill(robot, body, [goal, *none], buffer),
        lambda robot, goal: parts(robot.kind, robot.felt, [f"{goal}: {WHERE}", *[""] * (VECTORS - 1)], buffer),
    )


class Sight:
    """What the robots of two teams see, or of one alone: `teams` are the agents' names by side."""

    def __init__(self, robots: Mapping[str, Robot], teams: Sequence[Sequence[str]], goal_at: float, buffer: int):
        self.robots, self.buffer, self._goal_at = robots, buffer, goal_at
        pairs = [(own, [name for team in teams if team is not own for name in team]) for own in teams]
        self._sides = {me: ([name for name in own if name != me], other) for own, other in pairs for me in own}

    def size(self, agent: str) -> int:
        """Numbers in an agent's observation."""
        mates, enemies = self._sides[agent]
        return size(self.robots[agent].kind, extra(1 + len(mates), len(enemies)), self.buffer)

    def parts(self, agent: str) -> tuple[Part, ...]:
        """What an agent's observation is, in words."""
        mates, enemies = self._sides[agent]
        called = dict(zip([*mates, *enemies], others(len(mates), len(enemies)), strict=True))
        seats = [f"{called[you]}: {WHERE}" if you else "" for you in self.seats(agent)]
        seen = [
            f"the ball: {WHERE}", "of the ball, less its own, in its own frame",
            f"the goal that it plays at: {WHERE}", f"the other goal: {WHERE}", *seats,
        ]  # fmt: skip
        robot = self.robots[agent]
        return parts(robot.kind, robot.felt, seen, self.buffer)

    def seats(self, agent: str) -> list[str | None]:
        """The team-mate and the two enemies who have places, None where nobody is, and then who has none."""
        mates, enemies = self._sides[agent]
        placed = [*mates, *[None] * MATES][:MATES], [*enemies, *[None] * ENEMIES][:ENEMIES]
        return [*placed[0], *placed[1], *mates[MATES:], *enemies[ENEMIES:]]

    def observe(self, bodies: Mapping[str, Body], ball: Ball, attacks: Mapping[str, Array]) -> dict[str, Array]:
        """The table at the top of this file; `attacks` is, for every agent, 1 where it plays towards +x, else -1."""
        return {agent: self._observe(agent, bodies, ball, attacks[agent]) for agent in self.robots}

    def _observe(self, agent: str, bodies: Mapping[str, Body], ball: Ball, attacks: Array) -> Array:
        body = bodies[agent]
        quat = body.pose[3:]
        goal = jnp.stack([attacks * self._goal_at, jnp.zeros(()), jnp.asarray(GOAL_HEIGHT)])
        own = goal * jnp.array([-1.0, 1.0, 1.0])
        points = [ball.position, goal, own, *(bodies[you].pose[:3] if you else None for you in self.seats(agent))]
        there, *rest = (jnp.zeros(3) if point is None else into_body(quat, point - body.pose[:3]) for point in points)
        moves = into_body(quat, ball.velocity - body.velocity[:3])
        return fill(self.robots[agent], body, [there, moves, *rest], self.buffer)
