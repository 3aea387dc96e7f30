"""Crossings of the planes of gates by drones, and what they touch. Pure JAX."""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.games.race.tracks import SIDE, Gate, Wall

UP = np.array([0.0, 0.0, 1.0])
HALVES = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * SIDE / 2  # m left and up: corners, from the upper left


class Gates(NamedTuple):
    """Gates in the world, each a row; all in float32."""

    centre: Array  # (gates, 3) m
    ahead: Array  # (gates, 3) unit vectors in which they are passed
    left: Array  # (gates, 3) unit vectors
    corners: Array  # (gates, 4, 3) m, as in HALVES


class Crossings(NamedTuple):
    """Events at a gate between two moments, for each drone."""

    inside: Array  # (drones,) bool: passed in its direction
    outside: Array  # (drones,) bool: its plane was crossed in its direction, beside the opening
    when: Array  # (drones,) share of the time between the moments, 0 to 1, where either holds


def place_gates(gates: tuple[Gate, ...]) -> Gates:
    """Return the gates of a track as arrays."""
    angle = np.array([math.radians(gate.heading) for gate in gates])
    centre = np.array([gate[:3] for gate in gates])
    ahead = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    left = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    corners = centre[:, None] + HALVES[:, :1] * left[:, None] + HALVES[:, 1:] * UP
    return Gates(*(jnp.asarray(each, jnp.float32) for each in (centre, ahead, left, corners)))


def cross(gates: Gates, was: Array, now: Array) -> Crossings:
    """Judge the straight way of each drone's centre from `was` to `now` (drones, 3) m at its own gate, a row each."""
    before, after = (jnp.sum((at - gates.centre) * gates.ahead, axis=-1) for at in (was, now))
    crosses = (before < 0) & (after >= 0)
    when = jnp.where(crosses, before / jnp.where(crosses, before - after, 1.0), 0.0)
    off = was + when[:, None] * (now - was) - gates.centre
    aside, above = jnp.sum(off * gates.left, axis=-1), off[:, 2]
    within = (jnp.abs(aside) <= SIDE / 2) & (jnp.abs(above) <= SIDE / 2)
    return Crossings(crosses & within, crosses & ~within, when)


def wall_gaps(walls: tuple[Wall, ...], places: Array) -> Array:
    """Return the horizontal distance in metres of each place (drones, 3) to the nearest wall, (drones,)."""
    if not walls:
        return jnp.full(len(places), jnp.inf)
    centre, half = (np.array([wall[i : i + 2] for wall in walls], np.float32) for i in (0, 2))
    off = jnp.maximum(jnp.abs(places[:, None, :2] - centre) - half, 0.0)  # (drones, walls, 2)
    return jnp.sqrt(jnp.sum(off**2, axis=-1)).min(axis=1)
