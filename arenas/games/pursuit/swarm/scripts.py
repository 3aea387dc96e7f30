"""Scripts of the swarm: anchors for the ratings. They take the blocks of others as sets.

- `sprinter` (puck): straight to the zone.
- `dodger` (puck): to the zone, and away from rovers the nearer they are.
- `hunter` (rover): after the nearest puck, to where it will be.
- `keeper` (rover): after the puck that is nearest to the zone; it stays near the zone itself.
"""

from collections.abc import Callable, Mapping
from functools import partial

import jax.numpy as jnp
from jax import Array

from arenas.games.pursuit.swarm.observation import SwarmView, read
from arenas.games.pursuit.swarm.settings import KINDS, SwarmSettings
from arenas.robots.leatherback import drive_towards
from arenas.robots.robot import Script

FEAR, SHY = 0.8, 1.2  # m beyond the reach of a rover where fear falls to 1/e, and its greatest weight
Act = Callable[[SwarmView, SwarmSettings], Array]
LEAD = 0.4  # s, the prediction of a rover
OUT = 0.6  # m beyond the zone: how far a keeper follows a puck


def of_game(settings: SwarmSettings) -> Mapping[str, Mapping[str, Script]]:
    """Return the scripts by name and robot kind."""
    pucks, rovers = (partial(_script, kind, settings) for kind in KINDS)
    return {
        "sprinter": {KINDS[0]: pucks(_sprint)}, "dodger": {KINDS[0]: pucks(_dodge)},
        "hunter": {KINDS[1]: rovers(_hunt)}, "keeper": {KINDS[1]: rovers(_keep)},
    }  # fmt: skip


def _script(kind: str, settings: SwarmSettings, act: Act) -> Script:
    return lambda seen, key: act(read(seen, kind, settings), settings)


def _sprint(view: SwarmView, settings: SwarmSettings) -> Array:
    return _unit(view.zone)


def _dodge(view: SwarmView, settings: SwarmSettings) -> Array:
    gaps, here = view.rovers[:, :2], view.rovers[:, -1:]
    far = _length(gaps)[:, None]
    weight = SHY * jnp.exp(-jnp.maximum(far - settings.rules.reach, 0.0) / FEAR) * here
    away = -gaps / jnp.maximum(far, 1e-6)
    ahead = _unit(view.zone)
    # Pushed back straight on, it would stand still: it gives way to the side instead
    aside = jnp.stack([-ahead[1], ahead[0]])
    side = jnp.where(jnp.sum(gaps * aside, axis=-1, keepdims=True) > 0, -1.0, 1.0)
    return _unit(ahead + jnp.sum(weight * (away + side * aside), axis=0))


def _hunt(view: SwarmView, settings: SwarmSettings) -> Array:
    return _drive(view, _length(view.pucks[:, :2]), jnp.inf)


def _keep(view: SwarmView, settings: SwarmSettings) -> Array:
    return _drive(view, _length(view.pucks[:, :2] - view.zone), settings.rules.zone + OUT)


def _drive(view: SwarmView, order: Array, most: Array | float) -> Array:
    """Drive to where the first puck of an order (pucks,) will be, but no farther than `most` from the zone's middle."""
    here = view.pucks[:, -1] > 0
    best = jnp.argmin(jnp.where(here, order, jnp.inf))
    to = jnp.where(here.any(), view.pucks[best, :2] + LEAD * view.pucks[best, 2:4], view.zone)
    off = to - view.zone
    to = view.zone + off * jnp.minimum(1.0, most / jnp.maximum(_length(off), 1e-6))
    near = jnp.clip(_length(to) / 0.3, 0.0, 1.0)
    return drive_towards(to, near, view.last_throttle)


def _unit(way: Array) -> Array:
    return way / jnp.maximum(_length(way), 1e-6)


def _length(vectors: Array) -> Array:
    return jnp.sqrt(jnp.sum(vectors**2, axis=-1))
