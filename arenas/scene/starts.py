"""Starts of episodes: random draws for the worlds of a batch that start one, and placement without overlap."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_batching import custom_vmap

BLOCK = 16  # maximum number of worlds whose starts are drawn together


def draw_where(draw: Callable[[Array], Any], key: Array, where: Array) -> Any:
    """Return `draw(key)`, arrays in any tree. The result is only meaningful where `where` () bool.

    For a batch on a CPU only those blocks of worlds are drawn that contain a starting world; the others hold zeros. In
    most decisions no world starts, and a start on the lattice took 24 µs per world, 12 % of the step of four robots. A
    GPU draws all worlds at once, which is cheaper there than selecting.
    """

    @custom_vmap
    def one(key: Array, where: Array) -> Any:
        return draw(key)

    @one.def_vmap
    def many(size: int, batched: list[bool], keys: Array, where: Array) -> tuple[Any, Any]:
        keys, where = (
            x if is_batched else jnp.broadcast_to(x, (size, *x.shape))
            for x, is_batched in zip((keys, where), batched, strict=True)
        )
        found = _in_blocks(draw, keys, where) if jax.default_backend() == "cpu" else jax.vmap(draw)(keys)
        return found, jax.tree.map(lambda _: True, found)

    return one(key, where)


def _in_blocks(draw: Callable[[Array], Any], keys: Array, where: Array) -> Any:
    """Draw for N worlds, in as few blocks of equal size as possible."""
    size = next(n for n in range(min(BLOCK, len(where)), 0, -1) if len(where) % n == 0)
    shapes = jax.eval_shape(jax.vmap(draw), keys[:size])

    def block(of: tuple[Array, Array]) -> Any:
        keys, where = of
        return jax.lax.cond(
            where.any(), jax.vmap(draw), lambda keys: jax.tree.map(partial(_nothing, keys=keys), shapes), keys
        )

    found = jax.lax.map(block, (keys.reshape(-1, size), where.reshape(-1, size)))
    return jax.tree.map(lambda x: x.reshape(len(where), *x.shape[2:]), found)


def _nothing(like: jax.ShapeDtypeStruct, keys: Array) -> Array:
    """Return zeros, or keys for leaves that are random keys."""
    if jnp.issubdtype(like.dtype, jax.dtypes.prng_key):
        return jnp.broadcast_to(keys[0], like.shape)
    return jnp.zeros(like.shape, like.dtype)


def place_apart(key: Array, points: Array, free: Array, clear: Sequence[float]) -> Array:
    """Return places (things, 2) in metres: each thing takes the first of the `points` (n, 2) far enough from earlier
    ones.

    This is HARL-A's sampler: points are tried in one random order, without those that are not `free` (n,) bool. Two
    things are at least the sum of their `clear` radii (m) apart if there are enough points; a lack of points is not
    detected. Earlier things tend to be slightly nearer to the middle. Therefore things of equal radius are permuted at
    random afterwards, which HARL-A does not do.
    """
    order_key, lots_key = jax.random.split(key)
    order = jax.random.uniform(order_key, (len(points),))
    taken: list[Array] = []
    for mine in clear:
        fits = free
        for place, theirs in zip(taken, clear, strict=False):
            fits &= jnp.linalg.norm(points - place, axis=1) >= mine + theirs - 1e-4
        # The first fitting point in random order.
        taken.append(points[jnp.argmax(jnp.where(fits, order, -1.0))])
    lots = jnp.arange(len(clear))
    for i, size in enumerate(sorted(set(clear))):
        alike = np.flatnonzero(np.array(clear) == size)
        lots = lots.at[alike].set(jax.random.permutation(jax.random.fold_in(lots_key, i), alike))
    return jnp.stack(taken)[lots]


def upright_poses(xy: Array, heading: Array, height: Array) -> Array:
    """Return poses (things, 7) of upright bases from places (things, 2), headings (things,) in rad and heights in m."""
    zero = jnp.zeros_like(heading)
    upright = [jnp.cos(heading / 2), zero, zero, jnp.sin(heading / 2)]
    return jnp.stack([xy[:, 0], xy[:, 1], height, *upright], axis=1)
