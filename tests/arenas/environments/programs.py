"""Questions of tests about the programs that are compiled for environments."""

import inspect
from collections.abc import Callable
from typing import Any


def compilations(program: Callable[..., Any]) -> int:
    """Return how often JAX has compiled a program of an environment, below what makes it interruptible."""
    return inspect.unwrap(program, stop=lambda each: hasattr(each, "_cache_size"))._cache_size()
