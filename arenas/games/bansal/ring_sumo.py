"""Sumo of two bodies in a ring that is drawn anew for each episode: out of the ring or down loses.

| term of the reward | when                                       | winner                               | loser   |
|--------------------|--------------------------------------------|--------------------------------------|---------|
| result             | one is out or down                         | +result if the two have touched or 0 | -result |
| draw               | both in one control step, or time is up    | draw                                 | draw    |
| shaping            | every control step                         | see `RingSumoReward`                 |         |

The ring is flat: who is outside its radius is out. Events: `out`, `fall`, `touch`.
"""

from typing import NamedTuple, Unpack

import jax
import jax.numpy as jnp
from jax import Array

from arenas.arena_settings import EngineOptions
from arenas.description import Legend, Part
from arenas.games.bansal.body_distance import BodyShape, gap
from arenas.games.bansal.match import Contest, GameState
from arenas.games.bansal.settings import RingSumoSettings
from arenas.physics.engine import KINEMATICS, Physics
from arenas.state import Verdict


class Ring(NamedTuple):
    """The ring of this episode."""

    radius: Array  # () m
    touched: Array  # () bool: the bodies have touched


class RingSumo(Contest):
    """Sumo."""

    def __init__(self, settings: RingSumoSettings, **options: Unpack[EngineOptions]):
        derived = () if settings.rules.auto_contact else KINEMATICS
        super().__init__(settings, derived=derived, marker_kinds={"ring": "circle"}, **options)
        self.rules = settings.rules
        self._shapes = [BodyShape(self.scene.model, f"{name}/") for name in self.names]

    def legend(self) -> Legend:
        """Describe the verdict; the notes of the weights describe the terms."""
        before = "" if self.rules.auto_contact else ", if the two have touched, else ½ each"
        return Legend(
            score=f"0 for a base outside the ring, or at {self.rules.fall_height:g} m or lower, and 1 for the"
            f" other{before}; ½ each if both are in one control step, and when time is up",
            rewards=dict.fromkeys(("result", "draw"), ""),
            shapings=dict.fromkeys(("centre", "control", "alive"), ""),
            events={"out": "it is out of the ring", "fall": "its base is low", "touch": "the two touch"},
        )

    def draw(self, key: Array) -> tuple[Array, Ring]:
        """Draw the ring, and the bodies' places in its left and right half."""
        radius_key, x_key, y_key = jax.random.split(key, 3)
        low, high = self.rules.ring
        radius = jax.random.uniform(radius_key, (), minval=low, maxval=high)
        most = radius - self.rules.edge
        x = self.rules.apart + jax.random.uniform(x_key, (2,)) * (most - self.rules.apart)
        y = jax.random.uniform(y_key, (2,), minval=-1.0) * jnp.sqrt(jnp.maximum(most**2 - x**2, 0.0))
        touched = jnp.asarray(self.rules.auto_contact)
        return jnp.stack([x * jnp.array([-1.0, 1.0]), y], axis=1), Ring(radius, touched)

    def extra_parts(self) -> tuple[Part, ...]:
        """Describe the ring."""
        return (
            Part("radius", 1, "m", "of the ring"),
            Part("edge", 1, "m", "from its base to the edge; negative outside"),
            Part("opponent edge", 1, "m", "the same of the opponent", opponent=True),
            Part("touched", 1, "", "1: the two have touched"),
        )

    def extra(self, physics: Physics, game: GameState) -> Array:
        """Return the ring's numbers."""
        edge = game.own.radius - self._from_centre(physics, game)
        ring = jnp.stack([game.own.radius, game.own.touched * 1.0])
        return jnp.stack([jnp.stack([ring[0], edge[i], edge[1 - i], ring[1]]) for i in (0, 1)])

    def judge(self, before: Physics, physics: Physics, game: GameState) -> tuple[GameState, Verdict]:
        """Judge who is out or down, and the end of the time."""
        far, height = self._from_centre(physics, game), self.places(physics, game).xyz[:, 2]
        touch = self._touch(physics)
        ring: Ring = game.own._replace(touched=game.own.touched | touch)
        out, fall = far > ring.radius, height <= self.rules.fall_height
        lost = out | fall
        beaten = lost & ~lost[::-1]
        over = lost.any() | self.late(physics)
        won = beaten[::-1] & ring.touched
        rewards = {
            "result": self.weights["result"] * (won * 1.0 - beaten * 1.0),
            "draw": jnp.full(2, self.weights["draw"]) * (over & ~beaten.any()),
        }
        shapings = {"centre": self.timing.control_interval * far, **self.common_terms(game, height)}
        score = jnp.where(won.any(), won * 1.0, 0.5)
        events = {"out": out, "fall": fall, "touch": jnp.stack([touch, touch])}
        return game._replace(own=ring), self.verdict(game, rewards, shapings, score, over, events)

    def markers(self, physics: Physics, game: GameState) -> dict[str, Array]:
        """Return the ring."""
        return {"ring": jnp.stack([jnp.zeros(()), jnp.zeros(()), game.own.radius])}

    def _from_centre(self, physics: Physics, game: GameState) -> Array:
        """Return the distances (2,) m of the bases from the centre, by place."""
        xy = self.places(physics, game).xyz[:, :2]
        return jnp.sqrt(jnp.sum(xy**2, axis=1))

    def _touch(self, physics: Physics) -> Array:
        """Return () bool: the bodies are as near as a touch."""
        if self.rules.auto_contact:
            return jnp.zeros((), bool)
        assert physics.xpos is not None
        assert physics.xquat is not None
        one, other = (shape.segments(physics.xpos, physics.xquat) for shape in self._shapes)
        return gap(one, other) <= self.rules.touch
