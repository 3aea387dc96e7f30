"""Warp with meters of buffer use, world by world. For the contract's check and for benchmarks.

The meters are part of the engine's own state, so they cost a comparison in each substep and no call to the host. Warp
counts its demand whether there is room or not. After an overflow of the pool, the counts of contacts and rows are too
low, because the dropped pairs produce none: they are exact only if `pairs` fits.
"""

import copy
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import Solver
from arenas.errors import EngineError
from arenas.physics.engine import Physics
from arenas.physics.mjx import MjxEngine


class Peaks(NamedTuple):
    """The largest demands in any substep since the world was made."""

    pairs: Array  # () int32: pairs of near geoms, of all worlds together
    contacts: Array  # () int32, of all worlds together
    rows: Array  # () int32: constraint rows of this world


class Metered(NamedTuple):
    """An engine's own state with its meters."""

    data: Any
    peaks: Peaks


class MeteredEngine(MjxEngine):
    """Warp whose states carry `Peaks`."""

    def _carry(self, qpos: Array, qvel: Array, ctrl: Array, warmstart: Array, act: Array) -> Any:
        none = jnp.zeros((), jnp.int32)
        return Metered(super()._carry(qpos, qvel, ctrl, warmstart, act), Peaks(none, none, none))

    def _warm(self, carry: Any) -> tuple[Array, Array]:
        return super()._warm(carry.data)

    def _substeps(self, physics: Physics, ctrl: Array, n: int) -> Physics:
        peaks, bare = physics.carry.peaks, physics._replace(carry=physics.carry.data)
        for _ in range(n):
            bare = super()._substeps(bare, ctrl, 1)
            data = bare.carry._impl
            now = Peaks(data.ncollision.max(), data.nacon.max(), data.nefc.max())
            peaks = Peaks(*map(jnp.maximum, peaks, now))
        return bare._replace(carry=Metered(bare.carry, peaks))

    def _place(self, carry: Any, qpos: Array, qvel: Array, where: Array) -> Any:
        return carry._replace(data=super()._place(carry.data, qpos, qvel, where))

    def _derive(self, physics: Physics) -> Physics:
        bare = super()._derive(physics._replace(carry=physics.carry.data))
        return bare._replace(carry=physics.carry._replace(data=bare.carry))


def with_meters(arena: Arena, worlds: int, buffers: Solver | None = None) -> Arena:
    """Return a copy of the arena for so many worlds, whose engine has meters and these buffers; None: the arena's own.

    Raises EngineError for an arena on an engine other than Warp.
    """
    engine = arena.engine
    if not isinstance(engine, MjxEngine) or engine.name != "warp":
        raise EngineError(f"only engine warp has buffers to be measured; {arena.name} runs on {engine.name}")
    twin = copy.copy(arena)
    twin.engine = MeteredEngine(
        engine.model,
        engine.derived,
        engine.pushed,
        impl="warp",
        worlds=worlds,
        buffers=buffers or engine.buffers,
    )
    return twin
