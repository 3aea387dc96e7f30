"""Check that Warp's buffers have room for untrained play over whole episodes; otherwise report the sizes needed.

Untrained policies act with zero-mean Gaussian noise. Its standard deviations are the initial ones of the default
learner and of HARL-A. A third of the worlds plays uniformly random actions instead. Worlds continue after their ends,
as in a rating match, so robots that have fallen lie among those that play.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import Solver
from arenas.contract.buffer_meter import with_meters
from arenas.physics.void_causes import Cause, causes_in
from arenas.state import State

STDS = (0.8, 0.366)
"""Standard deviations of an untrained policy's actions: `learner.initial_std` by default, and HARL-A's."""
MOST_VOID = 1e-3
"""Share of episodes that may be void."""
WORLDS = {"cpu": 16, "gpu": 2048}
"""Number of worlds, each of which plays one episode; on a GPU enough to observe one void in a thousand."""


class BufferUsage(NamedTuple):
    """Peak use of Warp's buffers, and the episodes that became void."""

    episodes: int
    void: int
    causes: int  # bits of arenas.physics.void_causes
    pairs: int  # largest demand of all worlds together in a substep
    contacts: int
    rows: int  # largest demand of a single world
    buffers: Solver

    @property
    def share(self) -> float:
        """Share of episodes that were void."""
        return self.void / self.episodes

    @property
    def slots(self) -> int:
        """Slots in the contact pool."""
        return self.buffers.slots(self.episodes)


def measure_untrained_play(arena: Arena, worlds: int | None = None, seed: int = 0) -> BufferUsage:
    """Play one episode in each of so many worlds (default: `WORLDS` on this device) and return the peak buffer use.

    The arena must run on Warp and may be built for any number of worlds. Raises EngineError for another engine.
    """
    worlds = worlds or WORLDS["gpu" if jax.default_backend() == "gpu" else "cpu"]
    twin = with_meters(arena, worlds)

    @jax.jit
    def episodes(key: Array) -> State:
        start, play = jax.random.split(key)
        state = jax.vmap(twin.reset)(jax.random.split(start, worlds))

        def decision(state: State, key: Array) -> tuple[State, None]:
            return jax.vmap(twin.step)(state, _actions(twin, key, worlds)), None

        return jax.lax.scan(decision, state, jax.random.split(play, twin.timing.decisions))[0]

    key = jax.random.key(seed)
    lowered = episodes.lower(key)
    kernels_loaded = twin.engine.prepare()  # while XLA compiles; a kernel that Warp loads later may lose its stream
    program = lowered.compile()
    kernels_loaded()
    state = program(key)
    void, causes, peaks = jax.device_get((state.void, state.causes, state.physics.carry.peaks))
    return BufferUsage(
        worlds, int(void.sum()), int(np.bitwise_or.reduce(causes)), *(int(each.max()) for each in peaks),
        arena.engine.buffers,  # type: ignore[attr-defined]  (with_meters() accepts only Warp)
    )  # fmt: skip


def problem(usage: BufferUsage) -> str:
    """Describe overflows: the buffer, its demand, the settings to raise. Empty if the share of void episodes is
    acceptable.
    """
    if usage.share <= MOST_VOID:
        return ""
    found = [_describe(cause, usage) for cause in causes_in(usage.causes)]
    return f"{usage.void} of {usage.episodes} episodes of untrained play were void: {'; '.join(found)}"


def _describe(cause: Cause, usage: BufferUsage) -> str:
    """Describe one cause in terms of the arena's buffer sizes."""
    b, worlds = usage.buffers, usage.episodes
    spare = b.contacts if b.spare is None else b.spare
    pool = f"the contact pool of {worlds} worlds has {usage.slots} slots ({b.contacts} a world and {spare} × √{worlds})"
    raised = "raise contacts in the arena's Solver, or the setting buffers.contacts"
    match cause:
        case Cause.PAIRS:
            return f"{pool}, and {usage.pairs} pairs of near geoms needed one: {raised}"
        case Cause.CONTACTS:
            return f"{pool}, and {usage.contacts} contacts needed one: {raised}"
        case Cause.ROWS:
            least = " at least" if usage.causes & (Cause.PAIRS | Cause.CONTACTS) else ""
            return (
                f"a world has {b.rows} constraint rows, and {usage.rows}{least} were needed: raise rows in the arena's"
                " Solver, or the setting buffers.rows"
            )
    return cause.description


def _actions(arena: Arena, key: Array, worlds: int) -> dict[str, Array]:
    """Draw actions (worlds, act) by agent: Gaussian with each of `STDS` in a third of the worlds, uniform in the
    others.
    """
    found, kind = {}, jnp.arange(worlds)[:, None] % 3
    std = jnp.where(kind == 0, *STDS)
    for i, agent in enumerate(arena.agents):
        one, other = jax.random.split(jax.random.fold_in(key, i))
        shape = (worlds, agent.action_size)
        even = jax.random.uniform(other, shape, minval=-1.0)
        found[agent.name] = jnp.where(kind == 2, even, std * jax.random.normal(one, shape))
    return found
