"""The full ("rich") observation: proprioception, the own place in the ring, and all about every other robot.

It has `F + 9 + 9 × other robots` numbers, F of them proprioception; positions are in the robot's heading frame, ahead
and left:

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

from arenas.description import Part
from arenas.games.sumo.observation_layout import OWN, PER_OTHER, full_parts, other_names
from arenas.robots.robot import Body, Robot
from arenas.robots.rotations import up_z, yaw


class Pose(NamedTuple):
    """Planar state of all robots."""

    xy: Array  # (robots, 2) m
    heading: Array  # (robots,) rad
    velocity: Array  # (robots, 2) m/s, world frame
    yaw_rate: Array  # (robots,) rad/s
    up: Array  # (robots,)


class FullObservation:
    """The full observation of two teams of robots, blue and red."""

    def __init__(self, robots: Mapping[str, Robot], sizes: tuple[int, int]):
        self.robots = robots
        self._order, self._sizes = observation_order(sizes), sizes

    def size(self, agent: str) -> int:
        """Return the size of an agent's observation."""
        return self.robots[agent].proprioception_size + OWN + PER_OTHER * (len(self.robots) - 1)

    def parts(self, agent: str) -> tuple[Part, ...]:
        """Describe an agent's observation."""
        own = list(self.robots).index(agent) >= self._sizes[0]
        mates, enemies = self._sizes[own] - 1, self._sizes[not own]
        return full_parts(self.robots[agent].sensed_parts, other_names(mates, enemies))

    def observe(self, bodies: Mapping[str, Body], radius: Array, share: Array) -> dict[str, Array]:
        """Return every agent's observation, as in the table above. `share` of the match has passed."""
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
            name: jnp.concatenate([robot.observe_self(bodies[name]), table[i], others[i]])
            for i, (name, robot) in enumerate(self.robots.items())
        }

    def _others(self, pose: Pose, margin: Array) -> Array:
        """Return nine numbers (robots, others, 9) about each other robot, in each observer's heading frame."""
        you = self._order
        position = _ahead(pose.heading, pose.xy[you] - pose.xy[:, None])
        bearing = position / jnp.maximum(jnp.linalg.norm(position, axis=2, keepdims=True), 1e-6)
        angle = pose.heading[you] - pose.heading[:, None]
        velocity = _ahead(pose.heading, pose.velocity[you] - pose.velocity[:, None])
        facing = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=2)
        return jnp.concatenate([position, bearing, facing, velocity, margin[you][..., None]], axis=2)


def planar(bodies: Mapping[str, Body]) -> Pose:
    """Project the robots' states onto the ground."""
    base = jnp.stack([body.pose for body in bodies.values()])  # (robots, 7)
    speed = jnp.stack([body.velocity for body in bodies.values()])  # (robots, 6)
    quat = base[:, 3:]
    return Pose(base[:, :2], jax.vmap(yaw)(quat), speed[:, :2], speed[:, 5], jax.vmap(up_z)(quat))


def observation_order(sizes: tuple[int, int]) -> np.ndarray:
    """Return the other robots (robots, others) in each robot's order: team-mates, then enemies."""
    team = np.repeat([0, 1], sizes)
    robots = np.arange(len(team))
    return np.array([sorted(np.delete(robots, me), key=lambda you, me=me: team[you] != team[me]) for me in robots])


def _ahead(heading: Array, vectors: Array) -> Array:
    """Rotate world vectors (robots, ..., 2) into each robot's heading frame: ahead, left.

    It uses no matrix product: by default GPUs round its factors to 10 bits.
    """
    angle = heading.reshape(-1, *[1] * (vectors.ndim - 2))
    c, s, x, y = jnp.cos(angle), jnp.sin(angle), vectors[..., 0], vectors[..., 1]
    return jnp.stack([c * x + s * y, c * y - s * x], axis=-1)
