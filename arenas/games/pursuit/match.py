"""Pursuit: predators against faster prey among pillars, in a walled field. MADDPG's simple tag.

| term of the reward | when                          | predators         | prey              |
|--------------------|-------------------------------|-------------------|-------------------|
| capture            | a predator touches free prey  | +capture / prey   | -capture / prey   |
| escape             | time is up and some are free  | -escape           | +escape           |
| approach (hint)    | every control step            | +approach × gain  | -approach × gain  |

Events: `capture` of the predators and `escape` of the prey.

The original counts touches during the whole episode. Here prey that is touched is caught and leaves the game: it is
limp, and nobody observes it. Predators win when all prey is caught, prey when time is up: the clock is a rule, so its
end is terminal and the clock is observed. Predators and prey do not collide, because a touch is a capture; both collide
with walls, pillars and their own kind, prey also with prey that is caught.
"""

from collections.abc import Mapping
from dataclasses import asdict
from typing import NamedTuple, Unpack

import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import EngineOptions, Solver
from arenas.description import Entities, Legend, Part
from arenas.games.pursuit import scripts
from arenas.games.pursuit.observation import ObservationBuilder, PlanarState
from arenas.games.pursuit.settings import TEAMS, PursuitSettings
from arenas.games.pursuit.starts import sample_places
from arenas.physics.engine import Physics
from arenas.robots.puck import puck
from arenas.robots.robot import Robot, Script
from arenas.scene import props
from arenas.state import Verdict

SIDES = jnp.array([1.0, -1.0])  # the predators' gain is the prey's loss
HEIGHT = 0.12  # m, of walls, and of pillars below their round tops
# Bits: the ground has 1, walls and pillars have 2, each kind of robot has one of its own.
TOUCHES = {"predator": (4, 4 + 2 + 1), "prey": (8, 8 + 2 + 1)}


class GameState(NamedTuple):
    """The prey that is still in the game."""

    free: Array  # (prey,) bool


class Pursuit(Arena):
    """Predators, the first team, against prey."""

    def __init__(self, settings: PursuitSettings, **options: Unpack[EngineOptions]):
        rules = settings.rules
        self.predators, self.prey = settings.predators, settings.prey
        pillars = [
            props.pillar(f"pillar-{i}", radius=rules.obstacle_radius, height=HEIGHT) for i in range(rules.obstacles)
        ]
        robots = settings.predators + settings.prey
        super().__init__(
            settings.name, dict(zip(TEAMS, _rosters(settings), strict=True)), settings.timing, asdict(rules),
            props=[*props.square_of_walls(rules.side, HEIGHT), *pillars],
            solver=Solver(contacts=4 * robots, rows=4 * robots), **options,
        )  # fmt: skip
        self.rules, self.weights = rules, settings.reward
        self.observation_builder = ObservationBuilder(self.predators, self.prey, rules.obstacles)
        robots_at = list(self.scene.agents.values())
        pillars_at = [self.scene.props[pillar.name] for pillar in pillars]
        self._xy = np.array([at.qpos for at in robots_at])[:, None] + np.arange(2)
        self._velocity = np.array([at.qvel for at in robots_at])[:, None] + np.arange(2)
        self._pillars = np.array([at.qpos for at in pillars_at], int).reshape(-1, 1) + np.arange(2)
        self._rest = jnp.asarray(self.scene.rest, jnp.float32)
        self._clear, self._apart = _spacing(settings)

    def observation_size(self, agent: str) -> int:
        """Return the size of the observation, which depends on the role."""
        return sum(part.size for part in self.observation_parts(agent))

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """Describe the observation, which depends on the role."""
        return self.observation_builder.parts(self.robots[agent].kind == "prey")

    def observation_entities(self, agent: str) -> tuple[Entities, ...]:
        """Name pillars, predators and prey as sets."""
        return self.observation_builder.entities(self.robots[agent].kind == "prey")

    def legend(self) -> Legend:
        """Describe the verdict; the notes of the weights describe the terms."""
        return Legend(
            score="1 for the predators when all prey is caught; 1 for the prey when time is up first",
            rewards={"capture": "", "escape": ""},
            shapings={"approach": ""},
            events={"capture": "the predators caught prey", "escape": "time is up and prey is free"},
        )

    # Rules -----------------------------------------------------------------------------------------------------------

    def place(self, key: Array) -> tuple[Array, Array, GameState]:
        """Draw places for pillars, prey and predators without overlap, prey `apart` from predators; all at rest."""
        xy = sample_places(key, self.rules.side, self._apart, self._clear)
        first = self.rules.obstacles
        robots = jnp.concatenate([xy[first + self.prey :], xy[first : first + self.prey]])
        qpos = self._rest.at[self._pillars].set(xy[:first]).at[self._xy].set(robots)
        return qpos, jnp.zeros(self.scene.model.nv), GameState(jnp.ones(self.prey, bool))

    def alive(self, physics: Physics, game: GameState) -> Array:
        """Return (agents,) bool: all predators, and the prey that is free."""
        return jnp.concatenate([jnp.ones(self.predators, bool), game.free])

    def judge(self, before: Physics, physics: Physics, game: GameState) -> tuple[GameState, Verdict]:
        """Catch prey that is touched. The last capture, or the end of the time, decides."""
        was, now = self._gaps(before), self._gaps(physics)  # (predators, prey)
        caught = game.free & (now.min(axis=0) <= self.rules.predator_radius + self.rules.prey_radius)
        free = game.free & ~caught
        over = ~free.any()
        late = (physics.time > self.rules.episode - self.timing.control_interval / 2) & ~over
        nearer = was.min(axis=0) - now.min(axis=0)
        gain = jnp.where(game.free, nearer, 0.0).sum() / jnp.maximum(game.free.sum(), 1)
        w = self.weights
        return GameState(free), Verdict(
            rewards={"capture": w.capture * caught.mean() * SIDES, "escape": -w.escape * late * SIDES},
            shapings={"approach": w.approach * gain * SIDES},
            score=0.5 + (over - 0.5) * SIDES,
            terminated=over | late,
            truncated=jnp.zeros((), bool),
            events={"capture": caught.any() & (SIDES > 0), "escape": late & (SIDES < 0)},
        )

    def _gaps(self, physics: Physics) -> Array:
        """Return distances in metres from the middle of each predator to that of each prey, (predators, prey)."""
        xy = physics.qpos[self._xy]
        return jnp.sqrt(jnp.sum((xy[: self.predators, None] - xy[self.predators :]) ** 2, axis=-1))

    # Observations and scripts -----------------------------------------------------------------------------------------

    def observe(self, physics: Physics, game: GameState, actions: dict[str, Array]) -> dict[str, Array]:
        """Return the observations of `arenas/games/pursuit/observation.py`."""
        qpos, time = physics.qpos, physics.time / self.rules.episode
        state = PlanarState(qpos[self._xy], physics.qvel[self._velocity], qpos[self._pillars], game.free, time[None])
        return {agent: self.observation_builder.observe(state, i) for i, agent in enumerate(self.robots)}

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """Return the scripts of `arenas/games/pursuit/scripts.py`."""
        return scripts.of_game(self.observation_builder, self.rules)


def _rosters(settings: PursuitSettings) -> tuple[list[Robot], list[Robot]]:
    """Make both teams. Drag is linear, such that full thrust approaches the top speed; the original clips speeds there.

    The original's damping, a quarter of the speed in 0.1 s, is 2.9 per second; here it is 3.0 and 3.1.
    """
    r = settings.rules
    predator = puck(
        "predator", r.predator_radius, 1.0, r.predator_thrust, r.predator_thrust / r.predator_speed,
        touches=TOUCHES["predator"], isotropic=True,
    )  # fmt: skip
    prey = puck(
        "prey", r.prey_radius, 1.0, r.prey_thrust, r.prey_thrust / r.prey_speed, touches=TOUCHES["prey"], isotropic=True
    )
    return [predator] * settings.predators, [prey] * settings.prey


def _spacing(settings: PursuitSettings) -> tuple[list[float], np.ndarray]:
    """Return distances in m at the start: of pillars, prey, predators (in this order) from walls, and of all pairs."""
    sizes = (settings.rules.obstacles, settings.prey, settings.predators)
    clear = np.repeat(settings.clear, sizes)
    kind = np.repeat(range(3), sizes)
    foes = (kind[:, None] > 0) & (kind > 0) & (kind[:, None] != kind)
    return clear.tolist(), clear[:, None] + clear + settings.rules.apart * foes
