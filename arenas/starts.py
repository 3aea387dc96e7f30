"""Starts of episodes: drawn for those worlds of a batch that begin one, of things that stand clear of each other."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_batching import custom_vmap

BLOCK = 16  # worlds, at most, whose starts are drawn together


def drawn(draw: Callable[[Array], Any], key: Array, where: Array) -> Any:
    """`draw(key)`, arrays in any tree; of use only where `where` () bool.

    Of a batch on a CPU only those blocks of worlds are drawn in which some world begins; the others hold zeros. In most
    decisions nobody begins, and a start on the lattice took 24 µs a world, 12 % of the step of four robots. A GPU draws
    all at once, which costs it less than to choose.
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
    """Of N worlds, in as many equal blocks as there must be."""
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
    """Zeros, or keys where keys are wanted."""
    if jnp.issubdtype(like.dtype, jax.dtypes.prng_key):
        return jnp.broadcast_to(keys[0], like.shape)
    return jnp.zeros(like.shape, like.dtype)


def apart(key: Array, points: Array, free: Array, clear: Sequence[float]) -> Array:
    """Places (things, 2) in metres: each thing takes the first of the `points` (n, 2) that is far enough from others.

    HARL-A's sampler: points are tried in one random order, those that are not `free` (n,) bool not at all. Two things
    stand at least the sum of their `clear` radii (m) apart, if there are points enough; where there are not, that is
    not noticed. Who comes first may stand nearer to the middle, by a little; so things of one radius then draw lots for
    their places, which HARL-A's do not.
    """
    order_key, lots_key = jax.random.split(key)
    order = jax.random.uniform(order_key, (len(points),))
    taken: list[Array] = []
    for mine in clear:
        fits = free
        for place, theirs in zip(taken, clear, strict=False):
            fits &= jnp.linalg.norm(points - place, axis=1) >= mine + theirs - 1e-4
        # The first that fits in random order.
        taken.append(points[jnp.argmax(jnp.where(fits, order, -1.0))])
    lots = jnp.arange(len(clear))
    for i, size in enumerate(sorted(set(clear))):
        alike = np.flatnonzero(np.array(clear) == size)
        lots = lots.at[alike].set(jax.random.permutation(jax.random.fold_in(lots_key, i), alike))
    return jnp.stack(taken)[lots]


def bases(xy: Array, heading: Array, height: Array) -> Array:
    """Poses (things, 7) of upright bases: places (things, 2), headings (things,) in rad, heights (things,) in m."""
    zero = jnp.zeros_like(heading)
    upright = [jnp.cos(heading / 2), zero, zero, jnp.sin(heading / 2)]
    return jnp.stack([xy[:, 0], xy[:, 1], height, *upright], axis=1)
