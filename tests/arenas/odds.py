"""A game whose scripts have known ratings: each side draws a number, and the larger one wins.

A number is the script's strength plus noise of Gumbel's law. The difference of two such noises is logistic, so a wins
with probability 1 / (1 + exp(b's strength - a's)): Bradley and Terry's model, to the letter.
"""

import math
from dataclasses import dataclass
from typing import Unpack

import jax
import jax.numpy as jnp
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import EngineOptions, Timing
from arenas.physics.engine import Physics
from arenas.robots.robot import Robot, Script
from arenas.state import Verdict

STRENGTHS = {"novice": -300.0, "amateur": -100.0, "peer": 0.0, "twin": 0.0, "master": 250.0}  # Elo
SECOND = Timing(timestep=1.0, substeps=1, hold=1, episode=1.0)
LOG_ODDS = math.log(10) / 400  # of a point of Elo


@dataclass(frozen=True)
class OddsSettings:
    """One draw."""

    name: str = "odds"
    """The arena's name."""

    def build(self, **where: Unpack[EngineOptions]) -> "Odds":
        """The arena itself."""
        return Odds(self, **where)


class Odds(Arena):
    """Two gamblers."""

    exchangeable = True

    def __init__(self, settings: OddsSettings, **where: Unpack[EngineOptions]):
        robot = Robot("gambler", 1, scripts={name: _gambler(elo) for name, elo in STRENGTHS.items()})
        super().__init__(settings.name, {"blue": (robot,), "red": (robot,)}, SECOND, {}, **where)

    def observation_size(self, agent: str) -> int:
        """A constant."""
        return 1

    def place(self, key: Array) -> tuple[Array, Array, Array]:
        """Nothing stands anywhere, and nothing is drawn yet."""
        return jnp.zeros(0), jnp.zeros(0), jnp.zeros(2)

    def decide(self, game: Array, actions: dict[str, Array]) -> Array:
        """The numbers of the two."""
        return jnp.concatenate([actions[agent] for agent in self.robots])

    def observe(self, physics: Physics, game: Array, actions: dict[str, Array]) -> dict[str, Array]:
        """Nothing to see."""
        return {agent: jnp.ones(1) for agent in self.robots}

    def judge(self, before: Physics, physics: Physics, game: Array) -> tuple[Array, Verdict]:
        """The larger one wins."""
        won = jnp.sign(game[0] - game[1]) * jnp.array([1.0, -1.0])
        return game, Verdict({"win": won}, {}, 0.5 + 0.5 * won, jnp.ones((), bool), jnp.zeros((), bool))


def _gambler(elo: float) -> Script:
    return lambda observation, key: LOG_ODDS * elo + jax.random.gumbel(key, (1,))
