"""One team without a body, and a cue that is shown once: what only somebody who remembers can do."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import NamedTuple, Unpack

import jax
import jax.numpy as jnp
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import EngineOptions, Timing
from arenas.physics.engine import Physics
from arenas.robots.robot import Robot, Script
from arenas.state import Verdict


@dataclass(frozen=True)
class EchoRules:
    """How long the cue is to be kept in mind."""

    delay: int = field(default=4, metadata={"low": 1, "high": 100})
    """Decisions from the cue to the answer."""


@dataclass(frozen=True)
class EchoSettings:
    """A listener who shall say what it heard."""

    name: str = "echo"
    """The arena's name."""
    rules: EchoRules = field(default_factory=EchoRules)
    """How long the cue is to be kept in mind."""

    def build(self, **where: Unpack[EngineOptions]) -> "Echo":
        """The arena itself."""
        return Echo(self, **where)


class Heard(NamedTuple):
    """What was said, and what was answered."""

    cue: Array  # () float: 1 or -1
    answer: Array  # () float: an action's sign


class Echo(Arena):
    """The first observation shows the cue, 1 or -1; those after it nothing, and the last that it is time to answer."""

    def __init__(self, settings: EchoSettings, **where: Unpack[EngineOptions]):
        timing = Timing(timestep=1.0, substeps=1, hold=1, episode=settings.rules.delay + 1.0)
        listener = Robot("listener", 1, scripts={"deaf": lambda observation, key: jnp.ones(1)})
        super().__init__(settings.name, {"pupil": (listener,)}, timing, asdict(settings.rules), **where)
        self.delay = settings.rules.delay

    def observation_size(self, agent: str) -> int:
        """The cue, and whether it is time to answer."""
        return 2

    def place(self, key: Array) -> tuple[Array, Array, Heard]:
        """One cue as likely as the other."""
        cue = jnp.where(jax.random.bernoulli(key), 1.0, -1.0)
        return jnp.zeros(0), jnp.zeros(0), Heard(cue, jnp.zeros(()))

    def decide(self, game: Heard, actions: dict[str, Array]) -> Heard:
        """The sign is the answer."""
        return game._replace(answer=jnp.sign(actions["pupil/0"][0]))

    def observe(self, physics: Physics, game: Heard, actions: dict[str, Array]) -> dict[str, Array]:
        """See `observation_size`."""
        shown = jnp.where(physics.time < 0.5, game.cue, 0.0)
        return {"pupil/0": jnp.stack([shown, 1.0 * (physics.time > self.delay - 0.5)])}

    def judge(self, before: Physics, physics: Physics, game: Heard) -> tuple[Heard, Verdict]:
        """Right is right, at the end."""
        over = physics.time > self.delay + 0.5
        right = (over & (game.answer == game.cue))[None]
        return game, Verdict(
            rewards={"right": 1.0 * right},
            shapings={},
            score=1.0 * right,
            terminated=over,
            truncated=jnp.zeros((), bool),
        )

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """None but the robot's own."""
        return {}


ARENAS = (EchoSettings(),)
