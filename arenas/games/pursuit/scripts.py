"""Scripted predators and prey: anchors for the ratings.

- `chaser`, for predators: moves straight at the nearest free prey.
- `interceptor`, for predators: moves to the predicted place of that prey, after the time that a predator needs to reach
  its present place, at the prey's present velocity.
- `runner`, for prey: chooses among 16 directions the safest for the next second, assuming that predators come straight
  at it.
"""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.games.pursuit.observation import ObservationBuilder, PursuitView
from arenas.games.pursuit.settings import PursuitRules
from arenas.robots.robot import Script

LEAD = 1.0  # s, the longest prediction of an interceptor
WAYS = np.linspace(0.0, 2 * np.pi, 16, endpoint=False)
MOMENTS = np.linspace(0.1, 1.0, 10)  # s from now at which a runner estimates the predators' distances
FEAR = 0.15  # m: a predator that could be so much nearer weighs e times as much


def of_game(observation_builder: ObservationBuilder, rules: PursuitRules) -> Mapping[str, Mapping[str, Script]]:
    """Return the game's scripts, name -> kind -> script."""
    return {
        "chaser": {"predator": _of(observation_builder, False, lambda seen: _towards(_nearest(seen)[0]))},
        "interceptor": {"predator": _of(observation_builder, False, lambda seen: _intercept(seen, rules))},
        "runner": {"prey": _of(observation_builder, True, lambda seen: _run(seen, rules))},
    }


def _of(observation_builder: ObservationBuilder, preys: bool, act) -> Script:
    return lambda observation, key: act(observation_builder.read(observation, preys))


def _nearest(seen: PursuitView) -> tuple[Array, Array]:
    """Return the vector (2,) to the nearest free prey and its velocity (2,); zeros if there is none."""
    gap = jnp.sum(seen.prey**2, axis=1)
    i = jnp.argmin(jnp.where(gap > 0.0, gap, jnp.inf))
    return seen.prey[i], seen.prey_velocity[i]


def _intercept(seen: PursuitView, rules: PursuitRules) -> Array:
    way, velocity = _nearest(seen)
    late = jnp.minimum(_length(way) / rules.predator_speed, LEAD)
    most = rules.side / 2 - rules.prey_radius
    there = jnp.clip(seen.position + way + late * velocity, -most, most)
    return _towards(there - seen.position) * way.any()


def _run(seen: PursuitView, rules: PursuitRules) -> Array:
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
    """Move points (..., 2) inside a pillar to its nearest edge: a robot that runs at a pillar slips round it."""
    for pillar in pillars:
        off = points - pillar
        far = jnp.maximum(_length(off), 1e-6)[..., None]
        points = pillar + off * jnp.maximum(1.0, clear / far)
    return points


def _towards(way: Array) -> Array:
    """Return full thrust along a vector (2,); none for the zero vector."""
    return way / jnp.maximum(_length(way), 1e-6)


def _length(vectors: Array) -> Array:
    return jnp.sqrt(jnp.sum(vectors**2, axis=-1))
