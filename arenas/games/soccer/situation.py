"""Situation of a soccer script: places on the pitch, in the frame in which it plays towards +x.

A robot locates itself by the two goals: the vector from its own goal to the other is the frame's x axis.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from arenas.games.soccer.observation_layout import VECTORS
from arenas.robots.robot import Robot

LEAD = 0.2  # s of rolling that the script predicts for the ball
PASS_WITHIN = 1.2  # m within which a script avoids other robots


class BodySizes(NamedTuple):
    """Dimensions of a player's own body, in metres."""

    edge: float  # minimum distance of its middle from walls
    circle: float  # radius on which it goes round the ball; it cannot turn on a much smaller one
    berth: float  # distance from the middle of others at which it passes them


BUILDS = {"leatherback": BodySizes(0.2, 1.0, 0.6), "anymal": BodySizes(0.65, 1.0, 0.9)}


class Situation(NamedTuple):
    """Observation of a player, as places (2,) in metres on the pitch, in the frame in which it plays towards +x."""

    x: Array  # (2,) the frame's x axis in the robot's own
    y: Array
    me: Array
    now: Array  # present place of the ball
    ball: Array  # predicted place of the ball
    goal: Array  # the goal that it attacks; its own is opposite
    others: Array  # (3, 2) the team-mate and two enemies
    present: Array  # (3,) bool: these robots exist
    inside: Array  # (2,) distances of the walls from the middle
    build: BodySizes


def body_sizes(robot: Robot) -> BodySizes | None:
    """Return the dimensions of a robot that scripts can move: those in code, and those with a drive of their own."""
    if robot.drive is not None:
        return BodySizes(robot.radius, max(0.6, 2 * robot.radius), robot.radius + 0.5)
    return BUILDS.get(robot.kind)


def read_situation(first: int, build: BodySizes, observation: Array, inside: Array) -> Situation:
    """Convert an observation whose vectors begin at the index `first`, of a robot of such a body; `inside` (2,) are the
    walls' distances in m from the middle.
    """
    ball, rolls, goal, own, *others = observation[first : first + 3 * VECTORS].reshape(VECTORS, 3)[:, :2]
    along = goal - own
    half = jnp.linalg.norm(along) / 2
    x = along / jnp.maximum(2 * half, 1e-6)
    y = left(x)

    def placed(vector: Array) -> Array:
        return jnp.stack([jnp.sum(vector * x), jnp.sum(vector * y)])

    me = -placed(goal + own) / 2
    soon = me + placed(ball + LEAD * (rolls + observation[:2]))
    present = (jnp.stack(others) != 0).any(axis=1)
    places = me + jnp.stack([placed(other) for other in others])
    return Situation(
        x, y, me, me + placed(ball), soon, jnp.stack([half, jnp.zeros(())]), places, present, inside, build
    )


def clear(situation: Situation, heading: Array, far: Array) -> Array:
    """Turn the heading (2,) aside for the nearest other robot, if that is nearer than `far` in m."""
    gaps = situation.others - situation.me
    gap = jnp.where(situation.present, jnp.linalg.norm(gaps, axis=1), jnp.inf)
    nearest = jnp.argmin(gap)
    berth = jnp.arcsin(jnp.clip(situation.build.berth / jnp.maximum(gap[nearest], 1e-6), 0.0, 1.0))
    off = angle(gaps[nearest], heading)
    minded = (gap[nearest] < jnp.minimum(far, PASS_WITHIN)) & (jnp.abs(off) < berth)
    return jnp.where(minded, rotated(unit(gaps[nearest]), jnp.where(off < 0, -berth, berth)), heading)


def unit(vector: Array) -> Array:
    """Scale the vector (2,) to length 1; the zero vector stays zero."""
    return vector / jnp.maximum(jnp.linalg.norm(vector), 1e-6)


def left(vector: Array) -> Array:
    """Turn the vector (2,) by 90 degrees to the left."""
    return jnp.stack([-vector[1], vector[0]])


def rotated(vector: Array, by: Array) -> Array:
    """Turn the vector (2,) to the left by an angle in rad."""
    return jnp.cos(by) * vector + jnp.sin(by) * left(vector)


def angle(one: Array, other: Array) -> Array:
    """Return the angle in rad from `one` (2,) to the `other`, positive to the left."""
    return jnp.arctan2(jnp.sum(left(one) * other), jnp.sum(one * other))
