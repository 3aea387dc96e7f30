"""Start places in a ring: on opposite sides of a diameter, or on a lattice as in HARL-A. Pure JAX, static shapes.

Both draws treat all places alike, so that no team has an advantage.
"""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.games.sumo.settings import FARTHEST, NEAREST, PITCH, WOBBLE, pitch
from arenas.scene.starts import place_apart


def place_on_diameter(keys: Array, radius: Array, sizes: Sequence[int]) -> Array:
    """Draw places (robots, 2) in metres: teams of these sizes on opposite sides of a random diameter, in the teams'
    order.

    Team-mates stand side by side, each at its own distance from the centre. The three `keys` draw the diameter, the
    teams' offsets from it, and the distances.
    """
    robots = sum(sizes)
    start = jax.random.uniform(keys[0], (), maxval=2 * jnp.pi)
    side = np.repeat([0.0, math.pi], sizes)
    spread = np.concatenate([pitch(size) * (np.arange(size) - (size - 1) / 2) for size in sizes])
    off = jax.random.uniform(keys[1], (2,), minval=-WOBBLE, maxval=WOBBLE)
    wobble = jnp.repeat(off, np.array(sizes), total_repeat_length=robots)
    angle = start + jnp.asarray(side, jnp.float32) + jnp.asarray(spread, jnp.float32) + wobble
    distance = radius * jax.random.uniform(keys[2], (robots,), minval=NEAREST, maxval=FARTHEST)
    return jnp.stack([distance * jnp.cos(angle), distance * jnp.sin(angle)], axis=1)


def place_on_lattice(key: Array, radius: Array, clear: Sequence[float], largest: float) -> Array:
    """Draw places (things, 2) in metres on a lattice of 0.5 m from (-radius, -radius) on, inside the ring.

    `arenas.scene.starts.place_apart` draws them and defines `clear`. `largest` is the largest radius (m) that is ever
    drawn. Rings with at least the radius `settings.lattice_ring(clear)` have room for all.
    """
    steps = PITCH * np.arange(math.floor(2 * largest / PITCH + 1e-9) + 1)
    offsets = jnp.asarray(np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2), jnp.float32)
    points = offsets - radius  # (points, 2)
    return place_apart(key, points, jnp.linalg.norm(points, axis=1) < radius, clear)
