"""Hooks of arenas, each compiled as one program: run by itself, every operation of theirs would be one."""

from collections.abc import Callable
from functools import cache
from typing import Any

import jax

from arenas.arena import Arena


@cache
def judging(arena: Arena) -> Callable[..., Any]:
    """Return `arena.judge`, compiled."""
    return jax.jit(arena.judge)


@cache
def observing(arena: Arena) -> Callable[..., Any]:
    """Return `arena.observe`, compiled."""
    return jax.jit(arena.observe)
