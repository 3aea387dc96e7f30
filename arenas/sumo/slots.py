"""HARL-A's observations: a few positions in fixed slots, whose meaning changes from stage to stage of the curriculum.

| index of an ANYmal | index of a rover | what                                                                  |
|--------------------|------------------|-----------------------------------------------------------------------|
| 0-44               |                  | what it feels of itself                                               |
| 45-47              | 0-2              | slot A: goal, own block, or an enemy                                  |
| 48-50              | 3-5              | slot B: nothing, the other robot, or the team-mate                    |
| 51-53              | 6-8              | slot C: nothing, the other's block, or the other enemy                |
| 54                 | 9                | its distance from the centre, m; with its height above the ground     |
|                    | 10-12            | velocity in its own frame, m/s                                        |
| 55                 | 13               | radius of the ring, m                                                 |
| 56-                | 14-              | tail: further team-mates, further enemies, then zeros                 |

Slots are positions in metres in the robot's full base frame, roll and pitch too; a slot without anything is zeros. The
tail has `buffer` numbers, or three for each robot that has no slot where those are more. A MiniTank sees as a rover.
"""

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
from jax import Array

from arenas.about import Part
from arenas.robots.robot import Body, Robot
from arenas.rotations import into_body
from arenas.sumo.layouts import first, layout, others, size, slot_parts

__all__ = ["Slots", "fill", "first", "layout", "seen", "size", "slot_parts"]

ENEMIES_REVERSED = ("anymal",)  # kinds whose slot A is the second enemy where there are two


def seen(body: Body, position: Array) -> Array:
    """A world point (3,) in the robot's base frame, m."""
    return into_body(body.pose[3:], position - body.pose[:3])


def fill(
    robot: Robot, body: Body, a: Array, b: Array, c: Array, distance: Array, radius: Array,
    further: Sequence[Array] = (), buffer: int = 0,
) -> Array:  # fmt: skip
    """The observation (size,). `a`, `b`, `c` and those `further` are positions (3,) in the robot's base frame, m."""
    parts = layout(robot.kind)
    filled = {"a": a, "b": b, "c": c, "distance": jnp.reshape(distance, 1), "radius": jnp.reshape(radius, 1)}
    if "feeling" in parts:
        filled["feeling"] = robot.feels(body)
    if "velocity" in parts:
        filled["velocity"] = into_body(body.pose[3:], body.velocity[:3])
    padding = jnp.zeros(max(0, buffer - 3 * len(further)))
    return jnp.concatenate([*(filled[part] for part in parts), *further, padding])


class Slots:
    """A match of two teams, blue and red, in slots.

    The two enemies listed first fill slots A and C, for an ANYmal in reverse: its A is enemy 1 and its C enemy 0, as in
    HARL-A. A lone enemy is in A, where the block was that the stage before had to be pushed out.
    """

    def __init__(self, robots: Mapping[str, Robot], sizes: tuple[int, int], buffer: int):
        self.robots, self.buffer = robots, buffer
        names = list(robots)
        teams = names[: sizes[0]], names[sizes[0] :]
        self._sides = {me: ([n for n in own if n != me], other) for own, other in (teams, teams[::-1]) for me in own}
        for robot in robots.values():
            layout(robot.kind)

    def size(self, agent: str) -> int:
        """Numbers in an agent's observation."""
        return size(self.robots[agent].kind, len(self.seats(agent)[3:]), self.buffer)

    def parts(self, agent: str) -> tuple[Part, ...]:
        """What an agent's observation is, in words."""
        mates, enemies = self._sides[agent]
        called = dict(zip([*mates, *enemies], others(len(mates), len(enemies)), strict=True))
        seats = [called[you] if you else "" for you in self.seats(agent)]
        robot = self.robots[agent]
        return slot_parts(robot.kind, robot.felt, seats, self.buffer)

    def seats(self, agent: str) -> list[str | None]:
        """Who is in slots A, B and C, None where nobody is, and then who has none."""
        mates, enemies = self._sides[agent]
        slotted = enemies[:2]
        if self.robots[agent].kind in ENEMIES_REVERSED:
            slotted = slotted[::-1]
        a, c = [*slotted, None][:2]
        return [a, mates[0] if mates else None, c, *mates[1:], *enemies[2:]]

    def observe(self, bodies: Mapping[str, Body], radius: Array, share: Array) -> dict[str, Array]:
        """The table at the top of this file, for every agent; what has passed of the match nobody sees."""
        return {agent: self._observe(agent, bodies, radius) for agent in self.robots}

    def _observe(self, agent: str, bodies: Mapping[str, Body], radius: Array) -> Array:
        body = bodies[agent]
        a, b, c, *further = (
            jnp.zeros(3) if you is None else seen(body, bodies[you].pose[:3]) for you in self.seats(agent)
        )
        distance = jnp.sqrt(jnp.sum(body.pose[:3] ** 2))
        return fill(self.robots[agent], body, a, b, c, distance, radius, further, self.buffer)
