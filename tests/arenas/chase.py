"""Chaser and runner: equal robots on sides that are unlike. `league check tests/arenas/chase.py:chase` says so."""

from dataclasses import asdict, dataclass, field
from typing import Unpack

import jax.numpy as jnp
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import EngineOptions, Timing
from arenas.physics.engine import Physics
from arenas.robots.puck import PUCK
from arenas.robots.robot import Robot
from arenas.state import Verdict
from tests.arenas.race import Race, RaceRules


@dataclass(frozen=True)
class ChaseSettings:
    """Two pucks; the second has won when it has not been caught."""

    name: str = "chase"
    """The arena's name."""
    rules: RaceRules = field(default_factory=lambda: RaceRules(episode=1.0))
    """How near is caught, and how long it lasts."""

    def build(self, **where: Unpack[EngineOptions]) -> "Chase":
        """The arena itself."""
        return Chase(self, **where)


class Chase(Race):
    """A chaser and a runner of one kind, who start and see as in a race. It does not declare them exchangeable."""

    exchangeable = False

    def __init__(self, settings: ChaseSettings, **where: Unpack[EngineOptions]):
        timing = Timing(timestep=0.01, substeps=2, hold=5, episode=settings.rules.episode)
        sides = {"chaser": (PUCK,), "runner": (PUCK,)}
        Arena.__init__(
            self, settings.name, sides, timing, asdict(settings.rules), marker_kinds={"flag": "circle"}, **where
        )
        self.rules = settings.rules

    def judge(self, before: Physics, physics: Physics, game: Array) -> tuple[Array, Verdict]:
        """The chaser wins by touching the runner, the runner when time is up."""
        gap = jnp.linalg.norm(jnp.diff(physics.qpos.reshape(2, 7)[:, :2], axis=0))
        caught, late = gap < self.rules.reach, physics.time > self.rules.episode - self.timing.control_interval / 2
        won = jnp.where(caught, 1.0, -1.0) * jnp.array([1.0, -1.0])
        return game, Verdict(
            {"result": won * (caught | late)}, {}, 0.5 + 0.5 * won, caught | late, jnp.zeros((), bool),
        )  # fmt: skip


class Mistaken(Chase):
    """The same game, which declares wrongly that chaser and runner can change places."""

    exchangeable = True


@dataclass(frozen=True)
class TagSettings:
    """The same without bodies, in one decision."""

    name: str = "tag"
    """The arena's name."""

    def build(self, **where: Unpack[EngineOptions]) -> "Tag":
        """The arena itself."""
        return Tag(self, **where)


class Tag(Arena):
    """Both choose a place on a line; the chaser wins where the runner is, the runner anywhere else."""

    def __init__(self, settings: TagSettings, **where: Unpack[EngineOptions]):
        scripts = {"left": lambda seen, key: -jnp.ones(1), "right": lambda seen, key: jnp.ones(1)}
        player = Robot("player", 1, scripts=scripts)
        timing = Timing(timestep=1.0, substeps=1, hold=1, episode=1.0)
        super().__init__(settings.name, {"chaser": (player,), "runner": (player,)}, timing, {}, **where)

    def observation_size(self, agent: str) -> int:
        """A constant."""
        return 1

    def place(self, key: Array) -> tuple[Array, Array, Array]:
        """Nothing is chosen yet."""
        return jnp.zeros(0), jnp.zeros(0), jnp.zeros(2)

    def decide(self, game: Array, actions: dict[str, Array]) -> Array:
        """Return where the two are."""
        return jnp.concatenate([actions[agent] for agent in self.robots])

    def observe(self, physics: Physics, game: Array, actions: dict[str, Array]) -> dict[str, Array]:
        """Nothing to see."""
        return {agent: jnp.ones(1) for agent in self.robots}

    def judge(self, before: Physics, physics: Physics, game: Array) -> tuple[Array, Verdict]:
        """Half a unit apart is not caught."""
        won = jnp.where(jnp.abs(game[0] - game[1]) < 0.5, 1.0, -1.0) * jnp.array([1.0, -1.0])
        return game, Verdict({"win": won}, {}, 0.5 + 0.5 * won, jnp.ones((), bool), jnp.zeros((), bool))


ARENAS = (ChaseSettings(), TagSettings())
