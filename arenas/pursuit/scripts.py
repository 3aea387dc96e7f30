"""Scripted predators and prey: anchors for the ratings.

- `chaser`, for predators: straight at the nearest free prey.
- `interceptor`, for predators: at where that prey will be, if it goes on as now, after as long as the way to it takes.
- `runner`, for prey: of 16 ways the one on which predators that come straight at it would be least near for a second.
"""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.pursuit.settings import PursuitRules
from arenas.pursuit.sight import Seen, Sight
from arenas.robots.robot import Script

LEAD = 1.0  # s, the farthest that an interceptor looks ahead
WAYS = np.linspace(0.0, 2 * np.pi, 16, endpoint=False)
MOMENTS = np.linspace(0.1, 1.0, 10)  # s from now, at which a runner asks how near predators could be
FEAR = 0.15  # m: a predator that could be so much nearer is e times as bad


def of_game(sight: Sight, rules: PursuitRules) -> Mapping[str, Mapping[str, Script]]:
    """The game's scripts, name -> kind -> script."""
    return {
        "chaser": {"predator": _of(sight, False, lambda seen: _towards(_nearest(seen)[0]))},
        "interceptor": {"predator": _of(sight, False, lambda seen: _intercept(seen, rules))},
        "runner": {"prey": _of(sight, True, lambda seen: _run(seen, rules))},
    }


def _of(sight: Sight, preys: bool, act) -> Script:
    return lambda observation, key: act(sight.read(observation, preys))


def _nearest(seen: Seen) -> tuple[Array, Array]:
    """The way (2,) to the nearest free prey and its velocity (2,); zeros without any."""
    gap = jnp.sum(seen.prey**2, axis=1)
    i = jnp.argmin(jnp.where(gap > 0.0, gap, jnp.inf))
    return seen.prey[i], seen.prey_velocity[i]


def _intercept(seen: Seen, rules: PursuitRules) -> Array:
    way, velocity = _nearest(seen)
    late = jnp.minimum(_length(way) / rules.predator_speed, LEAD)
    most = rules.side / 2 - rules.prey_radius
    there = jnp.clip(seen.position + way + late * velocity, -most, most)
    return _towards(there - seen.position) * way.any()


def _run(seen: Seen, rules: PursuitRules) -> Array:
    ways = jnp.asarray(np.stack([np.cos(WAYS), np.sin(WAYS)], axis=1), jnp.float32)
    moments = jnp.asarray(MOMENTS, jnp.float32)
    ahead = seen.position + rules.prey_speed * moments[:, None] * ways[:, None]  # (ways, moments, 2)
    most = rules.side / 2 - rules.prey_radius
    path = jnp.clip(_round(ahead, seen.position + seen.pillars, rules.obstacle_radius + rules.prey_radius), -most, most)
    gaps = _length(path[:, :, None] - (seen.position + seen.predators))  # (ways, moments, predators)
    touch = rules.predator_radius + rules.prey_radius
    left = gaps - touch - rules.predator_speed * moments[:, None]
    return ways[jnp.argmin(jnp.exp(-left / FEAR).sum(axis=(1, 2)))]


def _round(points: Array, pillars: Array, clear: float) -> Array:
    """Points (..., 2), those within a pillar moved out of it to its nearest side: whoever runs at it slips round it."""
    for pillar in pillars:
        off = points - pillar
        far = jnp.maximum(_length(off), 1e-6)[..., None]
        points = pillar + off * jnp.maximum(1.0, clear / far)
    return points


def _towards(way: Array) -> Array:
    """Full thrust along a way (2,); none without a way."""
    return way / jnp.maximum(_length(way), 1e-6)


def _length(vectors: Array) -> Array:
    return jnp.sqrt(jnp.sum(vectors**2, axis=-1))
