"""What a script of soccer goes by: who is where on the pitch, in the frame in which it plays at +x.

A robot sees by the two goals where it is: the way from its own to the other is the frame's x axis.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from arenas.soccer.layouts import BEGINNING, VECTORS

LEAD = 0.2  # s for which the ball is thought to roll on
MIND = 1.2  # m in which others are passed by


class Build(NamedTuple):
    """What a player must know of its own body, in metres."""

    edge: float  # from the walls that it keeps its middle
    circle: float  # on which it goes round the ball; it cannot turn on a much smaller one
    berth: float  # from the middle of others, to pass them


BUILDS = {"leatherback": Build(0.2, 1.0, 0.6), "anymal": Build(0.65, 1.0, 0.9)}


class Scene(NamedTuple):
    """What a player sees, as places (2,) in metres on the pitch, in the frame in which it plays at +x."""

    x: Array  # (2,) the frame's x axis in the robot's own
    y: Array
    me: Array
    now: Array  # where the ball is
    ball: Array  # where it soon will be
    goal: Array  # the one it plays at; its own is opposite
    others: Array  # (3, 2) the team-mate and two enemies
    there: Array  # (3,) bool: whether they are
    inside: Array  # (2,) the walls, on either side of the middle
    build: Build


def read(kind: str, observation: Array, inside: Array) -> Scene:
    """What a robot of that kind sees; `inside` (2,) are the walls in m, on either side of the middle."""
    first = BEGINNING[kind]
    ball, rolls, goal, own, *others = observation[first : first + 3 * VECTORS].reshape(VECTORS, 3)[:, :2]
    along = goal - own
    half = jnp.linalg.norm(along) / 2
    x = along / jnp.maximum(2 * half, 1e-6)
    y = left(x)

    def placed(vector: Array) -> Array:
        return jnp.stack([jnp.sum(vector * x), jnp.sum(vector * y)])

    me = -placed(goal + own) / 2
    soon = me + placed(ball + LEAD * (rolls + observation[:2]))
    there = (jnp.stack(others) != 0).any(axis=1)
    places = me + jnp.stack([placed(other) for other in others])
    return Scene(
        x, y, me, me + placed(ball), soon, jnp.stack([half, jnp.zeros(())]), places, there, inside, BUILDS[kind]
    )


def clear(scene: Scene, heading: Array, far: Array) -> Array:
    """The heading (2,), turned aside as far as the nearest of the others asks for that is nearer than `far` in m."""
    gaps = scene.others - scene.me
    gap = jnp.where(scene.there, jnp.linalg.norm(gaps, axis=1), jnp.inf)
    nearest = jnp.argmin(gap)
    berth = jnp.arcsin(jnp.clip(scene.build.berth / jnp.maximum(gap[nearest], 1e-6), 0.0, 1.0))
    off = angle(gaps[nearest], heading)
    minded = (gap[nearest] < jnp.minimum(far, MIND)) & (jnp.abs(off) < berth)
    return jnp.where(minded, turned(unit(gaps[nearest]), jnp.where(off < 0, -berth, berth)), heading)


def unit(vector: Array) -> Array:
    """The vector (2,) at length 1; of none, zeros."""
    return vector / jnp.maximum(jnp.linalg.norm(vector), 1e-6)


def left(vector: Array) -> Array:
    """The vector (2,) a quarter round to the left."""
    return jnp.stack([-vector[1], vector[0]])


def turned(vector: Array, by: Array) -> Array:
    """The vector (2,) turned to the left by so many rad."""
    return jnp.cos(by) * vector + jnp.sin(by) * left(vector)


def angle(one: Array, other: Array) -> Array:
    """How far to the left of `one` (2,) the `other` points, rad."""
    return jnp.arctan2(jnp.sum(left(one) * other), jnp.sum(one * other))
