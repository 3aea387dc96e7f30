"""An arena under examination: compiled `reset` and `step`, an episode of random play, and comparison of states."""

from collections.abc import Mapping
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.arena import Arena
from arenas.physics.engine import Physics
from arenas.state import Frames, State

WORLDS = 8  # simulated together; an arena on Warp sizes its buffers for this number
CLOSE = 1e-3  # tolerance for one decision, as a GPU may add in another order; on the C engine nothing differs
RECORDED = 3  # decisions in the recording under examination


class Episode(NamedTuple):
    """Random play until two decisions after the latest end."""

    states: State  # the part that learners see (T, WORLDS, ...)
    raw: dict[str, np.ndarray]  # observations (T, WORLDS, obs) from the game, before masking of non-finite numbers
    unstable: np.ndarray  # (T, WORLDS) bool: physics failed, if only after the end
    last: State  # the complete last state


class CheckRun:
    """WORLDS worlds of an arena; each result is computed on first use."""

    def __init__(self, arena: Arena, key: Array):
        self.arena, self.key = arena, key
        self.keys = jax.random.split(key, WORLDS)
        self.reset, self.restart = jax.jit(jax.vmap(arena.reset)), jax.jit(jax.vmap(arena.restart))
        self.place, self._step = jax.jit(jax.vmap(arena.engine.place)), jax.jit(jax.vmap(arena.step_with_frames))

    @cached_property
    def first(self) -> State:
        """The worlds after reset."""
        return self.reset(self.keys)

    @cached_property
    def _stepped(self) -> tuple[State, Frames]:
        return self._step(self.first, self.actions(0))

    @property
    def second(self) -> State:
        """The worlds after one decision."""
        return self._stepped[0]

    @property
    def frames(self) -> Frames:
        """Frames of the first decision, as a recording keeps them."""
        return self._stepped[1]

    def actions(self, decision: int) -> dict[str, Array]:
        """Draw actions (WORLDS, act) for one decision, uniform within ±1."""
        keys = jax.random.split(jax.random.fold_in(self.key, decision), len(self.arena.agents))
        return {
            agent.name: jax.random.uniform(key, (WORLDS, agent.action_size), minval=-1.0)
            for agent, key in zip(self.arena.agents, keys, strict=True)
        }

    def step(self, state: State, decision: int = 0, order: Any = slice(None)) -> State:
        """Take one decision with its random actions; world i takes those of world `order[i]`."""
        return self.act(state, jax.tree.map(lambda x: x[order], self.actions(decision)))

    def act(self, state: State, actions: dict[str, Array]) -> State:
        """Take one decision with these actions."""
        return self._step(state, actions)[0]

    @cached_property
    def episode(self) -> Episode:
        """One episode of random play in every world."""
        arena = self.arena
        observe = jax.jit(jax.vmap(lambda state: arena.observe(state.physics, state.game, state.actions)))
        state, states = self.second, [_learner_view(self.first), _learner_view(self.second)]
        raw = [jax.device_get(observe(state)) for state in (self.first, self.second)]
        unstable = [np.asarray(state.physics.unstable) for state in (self.first, self.second)]
        for decision in range(1, arena.timing.decisions + 2):
            state = self.step(state, decision)
            states.append(_learner_view(state))
            raw.append(jax.device_get(observe(state)))
            unstable.append(np.asarray(state.physics.unstable))
        return Episode(_stack(states), _stack(raw), np.stack(unstable), state)

    def recorded_frames(self) -> Frames:
        """Return frames (RECORDED, WORLDS, hold, ...) of random play as matches record them, stacked by one scan."""

        @jax.jit
        def play(state: State, actions: dict[str, Array]) -> Frames:
            return jax.lax.scan(jax.vmap(self.arena.step_with_frames), state, actions)[1]

        return play(self.first, jax.tree.map(lambda *x: jnp.stack(x), *map(self.actions, range(RECORDED))))

    def stepped_physics(self) -> Physics:
        """Return Physics (RECORDED, WORLDS, hold, ...) of the same play, with one call for each control step."""
        arena = self.arena
        command, push = jax.jit(jax.vmap(arena.command)), jax.jit(jax.vmap(arena.push))
        step = jax.jit(
            jax.vmap(lambda physics, ctrl: arena.engine.step(physics, ctrl, arena.timing.substeps, arena.law))
        )
        physics, found = self.first.physics, []
        for decision in range(RECORDED):
            for _ in range(arena.timing.hold):
                actions = self.actions(decision)
                physics = step(physics._replace(push=push(actions)), command(actions))
                found.append(jax.device_get(physics._replace(carry=())))
        shape = (RECORDED, arena.timing.hold, WORLDS)
        return jax.tree.map(lambda x: np.moveaxis(x.reshape(*shape, *x.shape[2:]), 1, 2), _stack(found))


def arrays_of(state: State, worlds: Any = slice(None)) -> dict[str, np.ndarray]:
    """Return all arrays of the chosen worlds by name, without the engines' own buffers."""
    own = state._replace(physics=state.physics._replace(carry=()))
    leaves = jax.tree_util.tree_leaves_with_path(jax.tree.map(_plain, own))
    return {jax.tree_util.keystr(path)[1:]: values[worlds] for path, values in leaves}


def difference(one: Mapping[str, Any], other: Mapping[str, Any], tolerance: float = CLOSE) -> str:
    """Describe the first difference between two sets of named arrays; empty if there is none. A NaN equals a NaN."""
    for name in one:
        ours, theirs = np.asarray(one[name]), np.asarray(other[name])
        if not np.allclose(ours, theirs, rtol=tolerance, atol=tolerance, equal_nan=True):
            gaps = np.abs(ours.astype(float) - theirs.astype(float))
            numbers = gaps[~np.isnan(gaps)]
            return f"{name} differs, by up to {numbers.max():.2g}" if numbers.any() else f"{name} differs, by NaN"
    return ""


def _plain(values: Array) -> np.ndarray:
    is_key = jnp.issubdtype(values.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(values) if is_key else values)


def _learner_view(state: State) -> State:
    """Return the part of a batch of worlds that learners see, on the host."""
    return jax.device_get(state._replace(physics=(), game=(), actions=()))


def _stack(trees: list[Any]) -> Any:
    return jax.tree.map(lambda *x: np.stack(x), *trees)
