"""Random start places in the field, clear of each other and of the walls. Pure JAX, static shapes."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

TRIES = 32  # places drawn for each; with CROWDED of the field ruled out, all of them fail once in ten thousand times


def sample_places(key: Array, side: float, apart: np.ndarray, clear: Sequence[float]) -> Array:
    """Draw places (things, 2) in metres, in the order of `clear`, in a square of that side round the origin.

    Each thing takes the first of its uniformly drawn places that is at least `apart` (things, things) metres from
    earlier things, or else the place with the most room. `clear` (things,) are distances from the walls.
    """
    free = side / 2 - jnp.asarray(clear)[:, None, None]
    tried = free * jax.random.uniform(key, (len(clear), TRIES, 2), minval=-1.0)
    taken = [tried[0, 0]]
    for i in range(1, len(clear)):
        gaps = jnp.sqrt(jnp.sum((tried[i, :, None] - jnp.stack(taken)) ** 2, axis=-1))  # (tries, standing)
        room = (gaps - apart[i, :i]).min(axis=1)
        fits = room >= 0.0
        taken.append(tried[i, jnp.where(fits.any(), jnp.argmax(fits), jnp.argmax(room))])
    return jnp.stack(taken)
