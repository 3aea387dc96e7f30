"""Scripts of tag: anchors for the ratings.

- `chaser`: moves to where the puck that is "it" will be; as "it" it rests.
- `runner`: as "it" it chooses among 16 directions the one in which it stays farthest from the others over the next
  second, if these come straight at it; otherwise it rests.
- `tagger`: does both.
"""

from collections.abc import Callable, Mapping

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

Choice = Callable[[TagView], Array]


def of_game(rules: TagRules) -> Mapping[str, Mapping[str, Script]]:
    """Return the scripts by name and robot kind."""

    def chase(view: TagView) -> Array:
        away = jnp.sqrt(jnp.sum(view.it**2))
        return _unit(view.it + view.it_velocity * jnp.minimum(away / rules.speed, LEAD))

    def flee(view: TagView) -> Array:
        room = rules.side / 2 - rules.radius
        paths = view.position + rules.speed * MOMENTS[:, None, None] * DIRECTIONS  # (moments, 16, 2)
        paths = jnp.clip(paths, -room, room)
        away = jnp.sqrt(jnp.sum(view.gaps**2, axis=-1, keepdims=True))  # (others, 1)
        left = jnp.maximum(0.0, away - rules.speed * MOMENTS) / jnp.maximum(away, 1e-6)  # (others, moments)
        pursuers = view.position + view.gaps[:, None] * left[..., None]  # (others, moments, 2)
        gaps = jnp.sqrt(jnp.sum((paths - pursuers[:, :, None]) ** 2, axis=-1)).min(axis=0)  # (moments, 16)
        return jnp.asarray(DIRECTIONS)[jnp.argmax(gaps.min(axis=0) + 0.1 * gaps[-1])]

    def rest(view: TagView) -> Array:
        return jnp.zeros(2)

    def script(as_it: Choice, else_: Choice) -> Script:
        def act(observation: Array, key: Array) -> Array:
            view = read(observation)
            return jax.lax.select(view.is_it > 0.5, as_it(view), else_(view))

        return act

    found = {"chaser": script(rest, chase), "runner": script(flee, rest), "tagger": script(flee, chase)}
    return {name: {KIND: act} for name, act in found.items()}


def _unit(way: Array) -> Array:
    """Return the direction of a vector (2,); zero for the zero vector."""
    return way / jnp.maximum(jnp.sqrt(jnp.sum(way**2)), 1e-6)
