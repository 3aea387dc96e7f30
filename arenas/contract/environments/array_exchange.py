"""Arrays between JAX and the library of a learner: by DLPack without a copy and on the same device, or as NumPy's.

A library is named, never imported here by itself: arenas know JAX alone. On a GPU a learner's stream waits for JAX by
DLPack's protocol, and JAX for the learner's when it takes the actions. A tensor made of a JAX array may be dropped
while the learner's kernels still read it: its memory is written again by the next step at the earliest, after those
kernels.
"""

import importlib
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.errors import ArenaError

Library = Literal["numpy", "jax", "torch"]


def exporter(library: Library) -> Callable[[Any], Any]:
    """Return a function that converts a tree of JAX arrays to a library's arrays.

    Raises ArenaError for an unknown library, or one that is not installed.
    """
    if library == "numpy":
        return lambda tree: jax.tree.map(np.array, jax.device_get(tree))  # copies: a learner may write into them
    if library == "jax":
        return lambda tree: tree
    if library != "torch":
        raise ArenaError(f"arrays={library!r:.40}: choose numpy, jax or torch")
    try:
        from_dlpack = importlib.import_module(library).from_dlpack
    except ModuleNotFoundError as error:
        raise ArenaError("arrays='torch' needs torch: pip install torch") from error
    return lambda tree: jax.tree.map(from_dlpack, tree)


def actions_in_jax(actions: Any, shape: tuple[int, int]) -> Array:
    """Return actions, of any library's arrays or as lists, as a JAX array (rows, act) on JAX's device.

    Raises ArenaError for another shape, and for arrays that cannot be taken, such as tensors that require gradients.
    """
    try:
        if isinstance(actions, jax.Array):
            found = actions.astype(jnp.float32)
        elif hasattr(actions, "__dlpack__") and not isinstance(actions, np.ndarray):
            found = jax.dlpack.from_dlpack(actions).astype(jnp.float32)
        else:
            found = np.asarray(actions, np.float32)
    except (ValueError, TypeError, BufferError, RuntimeError) as error:
        raise ArenaError(f"these actions cannot be taken: {str(error).partition(chr(10))[0]}") from error
    if found.shape != shape:
        raise ArenaError(f"actions have the shape {tuple(found.shape)}, and the action space has {shape}")
    return jax.device_put(found, jax.devices()[0])
