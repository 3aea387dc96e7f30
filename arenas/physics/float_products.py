"""Precision of the products of matrices in arenas."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import jax

P = ParamSpec("P")
R = TypeVar("R")


def full_float32(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function so that the matrix products traced in it are computed in float32, on a GPU too.

    By default JAX computes float32 products on a GPU in TF32, with 10 bits of mantissa: on an H100, robots in contact
    were 1.4 to 4.8 mm away from those of the C engine after 0.2 s with MJX, where a CPU has 2e-6 m.
    """

    @wraps(function)
    def computed(*args: P.args, **kwargs: P.kwargs) -> R:
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return computed
