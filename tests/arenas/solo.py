"""One team alone: a puck that shall reach a flag in time. What a stage of a curriculum looks like."""

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
class SoloRules:
    """What success is."""

    reach: float = 0.3
    """As near to the flag as this, in metres."""
    episode: float = 3.0
    """Seconds that it may take."""


@dataclass(frozen=True)
class SoloSettings:
    """A puck and a flag."""

    name: str = "solo"
    """The arena's name."""
    rules: SoloRules = field(default_factory=SoloRules)
    """What success is."""

    def build(self, **where: Unpack[EngineOptions]) -> "Solo":
        """The arena itself."""
        return Solo(self, **where)


class Solo(Arena):
    """The flag stands at the origin, the puck starts 1 to 2 m away. Each episode has its own ice: how much it drags."""

    def __init__(self, settings: SoloSettings, **where: Unpack[EngineOptions]):
        timing = Timing(timestep=0.01, substeps=2, hold=5, episode=settings.rules.episode)
        super().__init__(settings.name, {"runner": (PUCK,)}, timing, asdict(settings.rules), **where)
        self.rules = settings.rules

    def observation_size(self, agent: str) -> int:
        """Velocity and the way to the flag."""
        return 4

    def place(self, key: Array) -> tuple[Array, Array, None]:
        """Anywhere on a ring round the flag."""
        far, angle = jax.random.split(key)
        distance = jax.random.uniform(far, minval=1.0, maxval=2.0)
        turn = jax.random.uniform(angle, maxval=2 * jnp.pi)
        base = jnp.stack([distance * jnp.cos(turn), distance * jnp.sin(turn), jnp.float32(RADIUS)])
        return jnp.concatenate([base, jnp.array([1.0, 0.0, 0.0, 0.0])]), jnp.zeros(6), None

    def randomise(self, key: Array) -> dict[str, Array]:
        """Half to one and a half times the drag."""
        drag = jnp.asarray(self.scene.model.dof_damping, jnp.float32)
        return {"dof_damping": drag * jax.random.uniform(key, minval=0.5, maxval=1.5)}

    def observe(self, physics: Physics, game: None, actions: dict[str, Array]) -> dict[str, Array]:
        """See `observation_size`."""
        return {"runner/0": jnp.concatenate([physics.qvel[:2], -physics.qpos[:2]])}

    def judge(self, before: Physics, physics: Physics, game: None) -> tuple[None, Verdict]:
        """Success is to arrive; no time left cuts the attempt off."""
        was, now = (jnp.linalg.norm(p.qpos[:2])[None] for p in (before, physics))
        arrived = now < self.rules.reach  # (teams,)
        late = physics.time > self.rules.episode - self.timing.control_interval / 2
        return None, Verdict(
            rewards={"arrival": 1.0 * arrived},
            shapings={"approach": was - now},
            score=1.0 * arrived,
            terminated=arrived[0],
            truncated=late & ~arrived[0],
        )

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """Full thrust along the way to the flag."""
        return {"sprinter": {"puck": lambda observation, key: 10.0 * observation[2:4]}}


ARENAS = (SoloSettings(),)
