"""An arena in one file: two pucks on ice race to a flag. Try it with `league check tests/arenas/race.py:race`."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Unpack

import jax
import jax.numpy as jnp
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import EngineOptions, Timing
from arenas.physics.engine import Physics
from arenas.robots.puck import PUCK, RADIUS
from arenas.robots.robot import Script
from arenas.state import Verdict


@dataclass(frozen=True)
class RaceRules:
    """What decides a race."""

    reach: float = field(default=0.3, metadata={"above": 0.0})
    """A puck this near to the flag, in metres, has won."""
    episode: float = 4.0
    """Seconds until time is up: a draw."""


@dataclass(frozen=True)
class RaceSettings:
    """A race of two pucks."""

    name: str = "race"
    """The arena's name."""
    rules: RaceRules = field(default_factory=RaceRules)
    """What decides a race."""

    def build(self, **where: Unpack[EngineOptions]) -> "Race":
        """The arena itself."""
        return Race(self, **where)


class Race(Arena):
    """One puck each. The game's own state is where the flag stands, (2,) in metres."""

    exchangeable = True

    def __init__(self, settings: RaceSettings, **where: Unpack[EngineOptions]):
        timing = Timing(timestep=0.01, substeps=2, hold=5, episode=settings.rules.episode)
        super().__init__(
            settings.name, {"blue": (PUCK,), "red": (PUCK,)}, timing, asdict(settings.rules),
            marker_kinds={"flag": "circle"}, **where,
        )  # fmt: skip
        self.rules = settings.rules

    def observation_size(self, agent: str) -> int:
        """Own velocity, the way to the flag, the way to the other puck: two numbers each."""
        return 6

    def place(self, key: Array) -> tuple[Array, Array, Array]:
        """The pucks 2 m from the flag, which stands anywhere, on opposite sides of it."""
        spot, angle = jax.random.split(key)
        flag = jax.random.uniform(spot, (2,), minval=-1.0)
        turn = jax.random.uniform(angle, maxval=2 * jnp.pi)
        away = 2.0 * jnp.array([jnp.cos(turn), jnp.sin(turn)])
        height_and_turn = jnp.array([RADIUS, 1.0, 0.0, 0.0, 0.0])
        qpos = jnp.concatenate([flag + away, height_and_turn, flag - away, height_and_turn])
        return qpos, jnp.zeros(12), flag

    def observe(self, physics: Physics, game: Array, actions: dict[str, Array]) -> dict[str, Array]:
        """For each puck, see `observation_size`; all in the world frame."""
        xy, velocity = physics.qpos.reshape(2, 7)[:, :2], physics.qvel.reshape(2, 6)[:, :2]
        seen = jnp.concatenate([velocity, game - xy, xy[::-1] - xy], axis=1)  # (pucks, 6)
        return {name: seen[i] for i, name in enumerate(self.robots)}

    def judge(self, before: Physics, physics: Physics, game: Array) -> tuple[Array, Verdict]:
        """First come, first served; both at once, or none in time, is a draw."""
        was, now = _distances(before, game), _distances(physics, game)
        arrived = now < self.rules.reach
        late = physics.time > self.rules.episode - self.timing.control_interval / 2
        lead = arrived * 1.0 - arrived[::-1] * 1.0  # (teams,)
        return game, Verdict(
            rewards={"lead": lead},
            shapings={"approach": was - now},
            score=(1.0 + lead) / 2,
            terminated=arrived.any() | late,
            truncated=jnp.zeros((), bool),
            events={"arrival": arrived},
        )

    def markers(self, physics: Physics, game: Array) -> dict[str, Array]:
        """The flag, as wide as its reach."""
        return {"flag": jnp.append(game, self.rules.reach)}

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """Full thrust along the way to the flag."""
        return {"sprinter": {"puck": lambda observation, key: 10.0 * observation[2:4]}}


def _distances(physics: Physics, flag: Array) -> Array:
    """Of both pucks from the flag, (2,) in metres."""
    return jnp.linalg.norm(physics.qpos.reshape(2, 7)[:, :2] - flag, axis=1)


ARENAS = (RaceSettings(),)
