"""Robots and props of a game in the plane, put down by hand."""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from arenas.arena import Arena
from arenas.physics.engine import Physics

Places = Mapping[str, tuple[float, float]]


def put(arena: Arena, places: Places, time: float = 1.0, moving: Places | None = None) -> Physics:
    """Those named at places in metres, the others far off and apart; `moving` are velocities in m/s."""
    qpos, qvel = arena.scene.rest.copy(), np.zeros(arena.scene.model.nv)
    things = {**arena.scene.agents, **{n: p for n, p in arena.scene.props.items() if p.qpos is not None}}
    for i, (name, at) in enumerate(things.items()):
        qpos[at.qpos : at.qpos + 2] = places.get(name, (10.0 + 3 * i, 10.0))
        qvel[at.qvel : at.qvel + 2] = (moving or {}).get(name, (0.0, 0.0))
    total_size = (jnp.asarray(x, jnp.float32) for x in (qpos, qvel, np.zeros(arena.scene.model.nu), time))
    return Physics(*total_size, causes=jnp.zeros((), jnp.uint8), carry=())
