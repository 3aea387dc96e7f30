"""An arena under examination: its verbs compiled, one episode of random play, and where two of its states differ."""

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.arena import Arena, State

WORLDS = 8  # simulated together; an arena on Warp sizes its buffers by this
CLOSE = 1e-3  # what one decision may differ by where a GPU adds in another order; on the C engine nothing differs


class Trial:
    """WORLDS worlds of an arena. `first` is their state after reset, `second` and `frames` what one decision gave."""

    def __init__(self, arena: Arena, key: Array):
        self.arena, self.key = arena, key
        self.keys = jax.random.split(key, WORLDS)
        self.reset, self.restart = jax.jit(jax.vmap(arena.reset)), jax.jit(jax.vmap(arena.restart))
        self.place, self._step = jax.jit(jax.vmap(arena.engine.place)), jax.jit(jax.vmap(arena.step_with_frames))
        self.first = self.reset(self.keys)
        self.second, self.frames = self._step(self.first, self.actions(0))

    def actions(self, decision: int) -> dict[str, Array]:
        """Actions (WORLDS, act) for one decision, uniform within ±1."""
        keys = jax.random.split(jax.random.fold_in(self.key, decision), len(self.arena.agents))
        return {
            agent.name: jax.random.uniform(key, (WORLDS, agent.action_size), minval=-1.0)
            for agent, key in zip(self.arena.agents, keys, strict=True)
        }

    def step(self, state: State, decision: int = 0, order: Any = slice(None)) -> State:
        """One decision with its random actions, those of world `order[i]` in world i."""
        return self._step(state, jax.tree.map(lambda x: x[order], self.actions(decision)))[0]

    @cached_property
    def episode(self) -> tuple[State, State]:
        """What learners see (T, WORLDS, ...) until two decisions after the latest end, and the last state whole."""
        state, seen = self.second, [_seen(self.first), _seen(self.second)]
        for decision in range(1, self.arena.timing.decisions + 2):
            state = self.step(state, decision)
            seen.append(_seen(state))
        return jax.tree.map(lambda *x: np.stack(x), *seen), state


def view(state: State, worlds: Any = slice(None)) -> dict[str, np.ndarray]:
    """All numbers of the chosen worlds by name, engines' own buffers apart."""
    own = state._replace(physics=state.physics._replace(carry=()))
    leaves = jax.tree_util.tree_leaves_with_path(jax.tree.map(_plain, own))
    return {jax.tree_util.keystr(path)[1:]: values[worlds] for path, values in leaves}


def apart(one: Mapping[str, np.ndarray], other: Mapping[str, np.ndarray], tolerance: float = CLOSE) -> str:
    """Where two views differ, or nothing; a NaN equals a NaN."""
    for name in one:
        if not np.allclose(one[name], other[name], rtol=tolerance, atol=tolerance, equal_nan=True):
            gap = np.nanmax(np.abs(one[name].astype(float) - other[name].astype(float)))
            return f"{name} differs, by up to {gap:.2g}"
    return ""


def _plain(values: Array) -> np.ndarray:
    is_key = jnp.issubdtype(values.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(values) if is_key else values)


def _seen(state: State) -> State:
    """What learners see of a batch of worlds, on the host."""
    return jax.device_get(state._replace(physics=(), game=(), actions=()))
