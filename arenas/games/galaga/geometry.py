"""Start places of Galaga's robots, and hits of barrels. Pure JAX."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from arenas.games.galaga.settings import Area, Span
from arenas.robots.minitank import ELEVATION, aim, pivot


class Barrel(NamedTuple):
    """Pivot and direction of a barrel in the world."""

    pivot: Array  # (3,) m
    ahead: Array  # (3,) unit vector


def barrel(pose: Array, angles: Array) -> Barrel:
    """Return the barrel of a tank with base pose (7,) and joint angles (arm, rotor)."""
    return Barrel(pivot(pose), aim(pose, angles))


def bearing(of: Barrel, point: Array) -> Array:
    """Return the direction (3,), a unit vector, from a barrel's pivot to a point (3,) in the world."""
    way = point - of.pivot
    return way / jnp.maximum(jnp.sqrt(jnp.sum(way**2)), 1e-6)


def quaternion_gap(one: Array, other: Array) -> Array:
    """Return () HARL-A's distance of two quaternions (4,): the smaller L1 distance of both signs."""
    return jnp.minimum(jnp.sum(jnp.abs(one - other)), jnp.sum(jnp.abs(one + other)))


def angle(one: Array, other: Array) -> Array:
    """Return () rad between two unit vectors (3,), exact also for nearly equal vectors."""
    across = jnp.cross(one, other)
    return jnp.arctan2(jnp.sqrt(jnp.sum(across**2)), jnp.sum(one * other))


def ray_gap(of: Barrel, point: Array) -> Array:
    """Return () m from a point (3,) to the infinite ray that leaves the pivot along the barrel."""
    way = point - of.pivot
    along = jnp.maximum(jnp.sum(way * of.ahead), 0.0)
    return jnp.sqrt(jnp.sum((way - along * of.ahead) ** 2))


def sample_point(key: Array, area: Area) -> Array:
    """Draw a point (3,) in an area."""
    low, high = (jnp.array([span[i] for span in (area.x, area.y, area.z)]) for i in (0, 1))
    return jax.random.uniform(key, (3,), minval=low, maxval=high)


def sample_lanes(key: Array, area: Area, count: int, hull: float, scatter: bool) -> Array:
    """Draw places (count, 3), at least `hull` m apart: the area is cut into lanes along y, with one place in each.

    With `scatter` the lanes are assigned at random and places are anywhere in them. Otherwise place k is in the middle
    of lane k.
    """
    low, width = area.y[0], (area.y[1] - area.y[0]) / count
    middle = low + (jnp.arange(count) + 0.5) * width
    ends = ((area.x[0] + area.x[1]) / 2, (area.z[0] + area.z[1]) / 2)
    if not scatter:
        return jnp.stack([jnp.full(count, ends[0]), middle, jnp.full(count, ends[1])], axis=1)
    lots, across, along, up = jax.random.split(key, 4)
    slack = max(0.0, width - (hull if count > 1 else 0.0)) / 2
    y = jax.random.permutation(lots, middle) + jax.random.uniform(across, (count,), minval=-slack, maxval=slack)
    return jnp.stack([_drawn(along, area.x, count), y, _drawn(up, area.z, count)], axis=1)


def sample_headings(key: Array, count: int, random: bool) -> Array:
    """Draw headings (count,), rad: uniform, or all +x."""
    return jax.random.uniform(key, (count,), maxval=2 * jnp.pi) if random else jnp.zeros(count)


def sample_barrel_angles(key: Array, count: int, random: bool) -> Array:
    """Draw joint angles (count, 2) at the start, arm and rotor in rad: the joints' whole range, or ahead."""
    if not random:
        return jnp.zeros((count, 2))
    low, high = jnp.array([ELEVATION[0], -jnp.pi]), jnp.array([ELEVATION[1], jnp.pi])
    return jax.random.uniform(key, (count, 2), minval=low, maxval=high)


def _drawn(key: Array, span: Span, count: int) -> Array:
    return jax.random.uniform(key, (count,), minval=span[0], maxval=span[1])
