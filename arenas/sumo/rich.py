"""The rich observation: what a robot feels of itself, where it is in the ring, and all about every other robot.

`F + 9 + 9 × other robots` numbers, F of them its proprioception; positions in its own heading frame, ahead and left:

| index  | what                                    | index      | per other robot: team-mates first, then enemies     |
|--------|-----------------------------------------|------------|-----------------------------------------------------|
| 0-     | proprioception; a rover's: last action  |            |                                                     |
| F+0-1  | own velocity, m/s                       | +0-1       | relative position, m                                |
| F+2    | yaw rate, rad/s                         | +2-3       | unit bearing                                        |
| F+3-4  | vector to the ring's centre / radius    | +4-5       | relative heading, cosine and sine                   |
| F+5, 6 | own margin to the edge, ring radius, m  | +6-7       | relative velocity, m/s                              |
| F+7    | share of the match that has passed      | +8         | its margin to the edge, m                           |
| F+8    | up axis, world z                        |            |                                                     |
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.about import Part
from arenas.robots.robot import Body, Robot
from arenas.rotations import up_z, yaw
from arenas.sumo.layouts import OWN, PER_OTHER, others, rich_parts


class Pose(NamedTuple):
    """Planar facts of all robots."""

    xy: Array  # (robots, 2) m
    heading: Array  # (robots,) rad
    velocity: Array  # (robots, 2) m/s, world frame
    yaw_rate: Array  # (robots,) rad/s
    up: Array  # (robots,)


class Rich:
    """The rich observation of two teams of robots, blue and red."""

    def __init__(self, robots: Mapping[str, Robot], sizes: tuple[int, int]):
        self.robots = robots
        self._order, self._sizes = listing(sizes), sizes

    def size(self, agent: str) -> int:
        """Numbers in an agent's observation."""
        return self.robots[agent].feeling + OWN + PER_OTHER * (len(self.robots) - 1)

    def parts(self, agent: str) -> tuple[Part, ...]:
        """What an agent's observation is, in words."""
        own = list(self.robots).index(agent) >= self._sizes[0]
        mates, enemies = self._sizes[own] - 1, self._sizes[not own]
        return rich_parts(self.robots[agent].felt, others(mates, enemies))

    def observe(self, bodies: Mapping[str, Body], radius: Array, share: Array) -> dict[str, Array]:
        """The table at the top of this file, for every agent. `share` of the match has passed."""
        pose = planar(bodies)
        margin = radius - jnp.linalg.norm(pose.xy, axis=1)
        scene = jnp.broadcast_to(jnp.stack([radius, share]), (len(self.robots), 2))
        own = [
            _ahead(pose.heading, pose.velocity),
            pose.yaw_rate[:, None],
            _ahead(pose.heading, -pose.xy) / radius,
            margin[:, None],
            scene,
            pose.up[:, None],
        ]
        table = jnp.concatenate(own, axis=1)  # (robots, 9)
        others = self._others(pose, margin).reshape(len(self.robots), -1)
        return {
            name: jnp.concatenate([robot.feels(bodies[name]), table[i], others[i]])
            for i, (name, robot) in enumerate(self.robots.items())
        }

    def _others(self, pose: Pose, margin: Array) -> Array:
        """Nine numbers (robots, others, 9) about each other robot, in each one's heading frame."""
        you = self._order
        position = _ahead(pose.heading, pose.xy[you] - pose.xy[:, None])
        bearing = position / jnp.maximum(jnp.linalg.norm(position, axis=2, keepdims=True), 1e-6)
        angle = pose.heading[you] - pose.heading[:, None]
        velocity = _ahead(pose.heading, pose.velocity[you] - pose.velocity[:, None])
        facing = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=2)
        return jnp.concatenate([position, bearing, facing, velocity, margin[you][..., None]], axis=2)


def planar(bodies: Mapping[str, Body]) -> Pose:
    """The robots as seen from above."""
    base = jnp.stack([body.pose for body in bodies.values()])  # (robots, 7)
    speed = jnp.stack([body.velocity for body in bodies.values()])  # (robots, 6)
    quat = base[:, 3:]
    return Pose(base[:, :2], jax.vmap(yaw)(quat), speed[:, :2], speed[:, 5], jax.vmap(up_z)(quat))


def listing(sizes: tuple[int, int]) -> np.ndarray:
    """The other robots (robots, others) as each one lists them: team-mates, then enemies."""
    team = np.repeat([0, 1], sizes)
    robots = np.arange(len(team))
    return np.array([sorted(np.delete(robots, me), key=lambda you, me=me: team[you] != team[me]) for me in robots])


def _ahead(heading: Array, vectors: Array) -> Array:
    """World vectors (robots, ..., 2) in each robot's heading frame: ahead, left.

    No matrix product: by default GPUs round its factors to 10 bits.
    """
    angle = heading.reshape(-1, *[1] * (vectors.ndim - 2))
    c, s, x, y = jnp.cos(angle), jnp.sin(angle), vectors[..., 0], vectors[..., 1]
    return jnp.stack([c * x + s * y, c * y - s * x], axis=-1)
