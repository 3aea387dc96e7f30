"""HARL-A's observations: a few positions in fixed slots, whose meaning changes from stage to stage of the curriculum.

| index of an ANYmal | index of a rover | what                                                                  |
|--------------------|------------------|-----------------------------------------------------------------------|
| 0-44               |                  | proprioception                                                        |
| 45-47              | 0-2              | slot A: goal, own block, or an enemy                                  |
| 48-50              | 3-5              | slot B: nothing, the other robot, or the team-mate                    |
| 51-53              | 6-8              | slot C: nothing, the other's block, or the other enemy                |
| 54                 | 9                | its distance from the centre, m; with its height above the ground     |
|                    | 10-12            | velocity in its own frame, m/s                                        |
| 55                 | 13               | radius of the ring, m                                                 |
| 56-                | 14-              | tail: further team-mates, further enemies, then zeros                 |

Slots are positions in metres in the robot's full base frame, including roll and pitch; an empty slot is zeros. The tail
has `buffer` numbers, or three for each robot without a slot if those are more. A MiniTank observes as a rover.
"""

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
from jax import Array

from arenas.description import Part
from arenas.games.sumo.observation_layout import first_index, layout, other_names, size, slot_parts
from arenas.robots.robot import Body, Robot
from arenas.robots.rotations import into_body

__all__ = ["PaperObservation", "fill", "first_index", "in_base_frame", "layout", "size", "slot_parts"]

ENEMIES_REVERSED = ("anymal",)  # kinds whose slot A is the second of two enemies


def in_base_frame(body: Body, position: Array) -> Array:
    """Transform a world point (3,) into the robot's base frame, m."""
    return into_body(body.pose[3:], position - body.pose[:3])


def fill(
    robot: Robot, body: Body, a: Array, b: Array, c: Array, distance: Array, radius: Array,
    further: Sequence[Array] = (), buffer: int = 0,
) -> Array:  # fmt: skip
    """Return the observation (size,). `a`, `b`, `c` and those `further` are positions (3,) in the robot's base frame,
    m.
    """
    parts = layout(robot.kind)
    filled = {"a": a, "b": b, "c": c, "distance": jnp.reshape(distance, 1), "radius": jnp.reshape(radius, 1)}
    if "feeling" in parts:
        filled["feeling"] = robot.observe_self(body)
    if "velocity" in parts:
        filled["velocity"] = into_body(body.pose[3:], body.velocity[:3])
    padding = jnp.zeros(max(0, buffer - 3 * len(further)))
    return jnp.concatenate([*(filled[part] for part in parts), *further, padding])


class PaperObservation:
    """The slot observation of a match of two teams, blue and red.

    The two enemies listed first fill slots A and C, for an ANYmal in reverse: its A is enemy 1 and its C enemy 0, as in
    HARL-A. A single enemy is in A, which held the block to push in the stage before.
    """

    def __init__(self, robots: Mapping[str, Robot], sizes: tuple[int, int], buffer: int):
        self.robots, self.buffer = robots, buffer
        names = list(robots)
        teams = names[: sizes[0]], names[sizes[0] :]
        self._sides = {me: ([n for n in own if n != me], other) for own, other in (teams, teams[::-1]) for me in own}
        for robot in robots.values():
            layout(robot.kind)

    def size(self, agent: str) -> int:
        """Return the size of an agent's observation."""
        return size(self.robots[agent].kind, len(self.slot_agents(agent)[3:]), self.buffer)

    def parts(self, agent: str) -> tuple[Part, ...]:
        """Describe an agent's observation."""
        mates, enemies = self._sides[agent]
        called = dict(zip([*mates, *enemies], other_names(len(mates), len(enemies)), strict=True))
        slot_agents = [called[you] if you else "" for you in self.slot_agents(agent)]
        robot = self.robots[agent]
        return slot_parts(robot.kind, robot.sensed_parts, slot_agents, self.buffer)

    def slot_agents(self, agent: str) -> list[str | None]:
        """Return the agents in slots A, B and C, None for an empty slot, and then those without a slot."""
        mates, enemies = self._sides[agent]
        slotted = enemies[:2]
        if self.robots[agent].kind in ENEMIES_REVERSED:
            slotted = slotted[::-1]
        a, c = [*slotted, None][:2]
        return [a, mates[0] if mates else None, c, *mates[1:], *enemies[2:]]

    def observe(self, bodies: Mapping[str, Body], radius: Array, share: Array) -> dict[str, Array]:
        """Return every agent's observation, as in the table above; it does not contain the `share` of time."""
        return {agent: self._observe(agent, bodies, radius) for agent in self.robots}

    def _observe(self, agent: str, bodies: Mapping[str, Body], radius: Array) -> Array:
        body = bodies[agent]
        a, b, c, *further = (
            jnp.zeros(3) if you is None else in_base_frame(body, bodies[you].pose[:3])
            for you in self.slot_agents(agent)
        )
        distance = jnp.sqrt(jnp.sum(body.pose[:3] ** 2))
        return fill(self.robots[agent], body, a, b, c, distance, radius, further, self.buffer)
