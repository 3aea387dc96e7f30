"""Scripts of tag: anchors for the ratings.

- `chaser`: as "it" it moves to where the nearest other puck will be; otherwise it rests.
- `runner`: as long as another is "it", it chooses among 16 directions the one in which it stays farthest from that
  puck over the next second; as "it" it rests.
- `tagger`: does both.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.games.tag.observation import TagView, read
from arenas.games.tag.settings import KIND, TagRules
from arenas.robots.robot import Script

LEAD = 0.5  # s, the longest prediction of a chaser
ANGLES = np.linspace(0.0, 2 * np.pi, 16, endpoint=False)
DIRECTIONS = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)  # (16, 2)
MOMENTS = np.linspace(0.1, 1.0, 10)  # s from now


def of_game(rules: TagRules) -> Mapping[str, Mapping[str, Script]]:
    """Return the scripts by name and robot kind."""

    def chase(view: TagView) -> Array:
        away = jnp.sqrt(jnp.sum(view.gaps[0] ** 2))
        return _unit(view.gaps[0] + view.velocities[0] * jnp.minimum(away / rules.speed, LEAD))

    def flee(view: TagView) -> Array:
        it = jnp.argmax(view.others_it)
        room = rules.side / 2 - rules.radius
        paths = view.position + rules.speed * MOMENTS[:, None, None] * DIRECTIONS  # (moments, 16, 2)
        paths = jnp.clip(paths, -room, room)
        way = view.gaps[it]
        away = jnp.sqrt(jnp.sum(way**2))
        followed = jnp.minimum(rules.speed * MOMENTS, away)[:, None]
        pursuer = view.position + way - followed * _unit(way)  # (moments, 2): it comes straight here
        gaps = jnp.sqrt(jnp.sum((paths - pursuer[:, None]) ** 2, axis=-1))
        return jnp.asarray(DIRECTIONS)[jnp.argmax(gaps.min(axis=0) + 0.1 * gaps[-1])]

    def rest(view: TagView) -> Array:
        return jnp.zeros(2)

    def script(as_it: object, else_: object) -> Script:
        def act(observation: Array, key: Array) -> Array:
            view = read(observation)
            return jax.lax.select(view.is_it > 0.5, as_it(view), else_(view))  # type: ignore[operator]

        return act

    found = {"chaser": script(chase, rest), "runner": script(rest, flee), "tagger": script(chase, flee)}
    return {name: {KIND: act} for name, act in found.items()}


def _unit(way: Array) -> Array:
    """Return the direction of a vector (2,); zero for the zero vector."""
    return way / jnp.maximum(jnp.sqrt(jnp.sum(way**2)), 1e-6)
