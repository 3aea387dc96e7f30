"""Swarm: many pucks want to reach a zone that few rovers guard. Who is caught, or has reached it, is out of the game.

| a game ends when                                   | who wins   |
|----------------------------------------------------|------------|
| half of the pucks, rounded up, have reached it     | the swarm  |
| too few are left for that, or time is up           | the guards |

| term of the reward | when                       | swarm, of which guards get the opposite |
|--------------------|----------------------------|-----------------------------------------|
| win                | the game is over           | ±win                                    |
| through            | a puck reaches the zone    | +through / pucks                        |
| caught             | a rover catches a puck     | -caught / pucks                         |
| approach (hint)    | every control step         | +approach × metres nearer, mean         |

A rover catches a puck within `reach` of its middle, also in the zone: then the puck counts as caught. Pucks and rovers
pass through each other; pucks collide with each other, rovers too, and all with the walls. The clock is a rule: its end
is terminal, and it is observed.
"""

from collections.abc import Mapping
from dataclasses import asdict
from typing import NamedTuple, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import EngineOptions, Solver
from arenas.description import Entities, Legend, Part
from arenas.games.pursuit.swarm import observation, scripts
from arenas.games.pursuit.swarm.settings import EDGE, KINDS, TEAMS, SwarmSettings
from arenas.physics.engine import Physics
from arenas.robots.leatherback import leatherback
from arenas.robots.puck import puck
from arenas.robots.robot import Script
from arenas.robots.rotations import yaw
from arenas.scene import props
from arenas.scene.starts import upright_poses
from arenas.state import Verdict

SIDES = jnp.array([1.0, -1.0])  # the swarm's gain is the guards' loss
HEIGHT = 0.2  # m, of walls
TOUCHES = (8, 8 + 1)  # bits: ground and walls have 1; rovers have 2, which pucks do not touch
CONTACTS, ROWS = {"puck": 3, "leatherback": 8}, 4  # Warp's slots for each robot, and rows for each slot


class GameState(NamedTuple):
    """State of each puck."""

    free: Array  # (pucks,) bool: in the game
    through: Array  # (pucks,) bool: it reached the zone


class Swarm(Arena):
    """Pucks, the first team, against rovers."""

    def __init__(self, settings: SwarmSettings, **options: Unpack[EngineOptions]):
        rules, numbers = settings.rules, (settings.pucks, settings.rovers)
        small = puck(
            KINDS[0], rules.radius, 1.0, rules.thrust, rules.thrust / rules.speed, touches=TOUCHES, isotropic=True
        )
        rosters = {
            team: (robot,) * n for team, robot, n in zip(TEAMS, (small, leatherback(rules.drive)), numbers, strict=True)
        }
        contacts = sum(CONTACTS[kind] * number for kind, number in zip(KINDS, numbers, strict=True))
        super().__init__(
            settings.name, rosters, settings.timing, asdict(rules),
            props=props.square_of_walls(rules.side, HEIGHT), solver=Solver(contacts=contacts, rows=ROWS * contacts),
            marker_kinds={"zone": "circle"} | {f"reach-{i}": "circle" for i in range(settings.rovers)}
            | {f"free-{i}": "sphere" for i in range(settings.pucks)},
            **options,
        )  # fmt: skip
        self.settings, self.rules, self.weights, self.pucks = settings, rules, settings.reward, settings.pucks
        at = list(self.scene.agents.values())
        self._pose = np.array([each.qpos for each in at])[:, None] + np.arange(7)
        self._motion = np.array([each.qvel for each in at])[:, None] + np.arange(6)
        self._rest = jnp.asarray(self.scene.rest, jnp.float32)

    def observation_size(self, agent: str) -> int:
        """Return the size of the observation, which depends on the kind."""
        return sum(part.size for part in self.observation_parts(agent))

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """Describe the observation, which depends on the kind."""
        return observation.parts(self.robots[agent].kind, self.settings)

    def observation_entities(self, agent: str) -> tuple[Entities, ...]:
        """Name the other pucks and the other rovers as sets."""
        return observation.entities(self.robots[agent].kind, self.settings)

    def legend(self) -> Legend:
        """Describe the verdict; the notes of the weights describe the terms."""
        return Legend(
            score=f"1 for the swarm when {self.settings.needed} pucks have reached the zone; 1 for the guards when too"
            " few are left for that, or time is up",
            rewards={"win": "", "through": "", "caught": ""},
            shapings={"approach": ""},
            events={"through": "a puck reached the zone", "capture": "a rover caught a puck"},
        )

    # Rules -----------------------------------------------------------------------------------------------------------

    def place(self, key: Array) -> tuple[Array, Array, GameState]:
        """Put pucks round the edge and rovers round the zone, each at equal angles from a random one, all at rest."""
        keys, rovers = jax.random.split(key, 3), self.settings.rovers
        outer = jnp.broadcast_to(self.rules.side / 2 - EDGE, (self.pucks,))
        inner = jnp.broadcast_to(self.settings.inner, (rovers,))
        xy = jnp.concatenate([_ring(keys[0], outer), _ring(keys[1], inner)])
        heading = jax.random.uniform(keys[2], (self.pucks + rovers,), maxval=2 * jnp.pi)
        heading = jnp.where(jnp.arange(self.pucks + rovers) < self.pucks, 0.0, heading)
        poses = upright_poses(xy, heading, self._rest[self._pose[:, 2]])
        qpos = self._rest.at[self._pose].set(poses)
        free = jnp.ones(self.pucks, bool)
        return qpos, jnp.zeros(self.scene.model.nv), GameState(free, ~free)

    def alive(self, physics: Physics, game: GameState) -> Array:
        """Return (agents,) bool: the pucks that are free, and all rovers."""
        return jnp.concatenate([game.free, jnp.ones(self.settings.rovers, bool)])

    def judge(self, before: Physics, physics: Physics, game: GameState) -> tuple[GameState, Verdict]:
        """Catch pucks near rovers, and let others into the zone. See the table."""
        w, xy = self.weights, self._xy(physics)
        gaps = _length(xy[: self.pucks, None] - xy[self.pucks :])
        far_before, far = (_length(self._xy(at)[: self.pucks]) for at in (before, physics))
        caught = game.free & (gaps.min(axis=1) <= self.rules.reach)
        arrives = game.free & ~caught & (far <= self.rules.zone)
        free, through = game.free & ~caught & ~arrives, game.through | arrives
        won = through.sum() >= self.settings.needed
        late = physics.time > self.rules.episode - self.timing.control_interval / 2
        lost = ((free | through).sum() < self.settings.needed) | (late & ~won)
        nearer = jnp.where(game.free, far_before - far, 0.0).sum() / jnp.maximum(game.free.sum(), 1)
        outcome = (1.0 * won - 1.0 * lost) * SIDES
        return GameState(free, through), Verdict(
            rewards={
                "win": w.win * outcome, "through": w.through * arrives.mean() * SIDES,
                "caught": -w.caught * caught.mean() * SIDES,
            },
            shapings={"approach": w.approach * nearer * SIDES},
            score=0.5 + 0.5 * outcome,
            terminated=won | lost,
            truncated=jnp.zeros((), bool),
            events={"through": arrives.any() & (SIDES > 0), "capture": caught.any() & (SIDES < 0)},
        )  # fmt: skip

    def _xy(self, physics: Physics) -> Array:
        """Return the places of all robots, (robots, 2) m."""
        return physics.qpos[self._pose[:, :2]]

    # Observations, scripts and markers -------------------------------------------------------------------------------

    def observe(self, physics: Physics, game: GameState, actions: dict[str, Array]) -> dict[str, Array]:
        """Return the observations of `arenas/games/pursuit/swarm/observation.py`."""
        motion = physics.qvel[self._motion]
        state = observation.PlanarState(
            self._xy(physics), motion[:, :2], jax.vmap(yaw)(physics.qpos[self._pose[:, 3:]]), motion[:, 5],
            self.alive(physics, game), jnp.stack([actions[agent] for agent in self.robots]),
            game.through.sum() / self.settings.needed, (~game.free & ~game.through).mean(),
            physics.time / self.rules.episode,
        )  # fmt: skip
        return dict(zip(self.robots, observation.observe(state, self.settings), strict=True))

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """Return the scripts of `arenas/games/pursuit/swarm/scripts.py`."""
        return scripts.of_game(self.settings)

    def markers(self, physics: Physics, game: GameState) -> dict[str, Array]:
        """Return the zone, the reach of each rover, and a sphere round each puck that is in the game."""
        xy = self._xy(physics)
        found = {"zone": jnp.array([0.0, 0.0, self.rules.zone])}
        found |= {f"reach-{i}": jnp.append(at, self.rules.reach) for i, at in enumerate(xy[self.pucks :])}
        height, free = jnp.full((self.pucks, 1), self.rules.radius), 1.4 * self.rules.radius * game.free[:, None]
        spheres = jnp.concatenate([xy[: self.pucks], height, free], axis=1)
        return found | {f"free-{i}": sphere for i, sphere in enumerate(spheres)}


def _ring(key: Array, radius: Array) -> Array:
    """Return places (robots, 2) at these radii (robots,) in metres and at equal angles from a random one."""
    angle = 2 * jnp.pi * (jnp.arange(len(radius)) / len(radius) + jax.random.uniform(key))
    return radius[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def _length(vectors: Array) -> Array:
    return jnp.sqrt(jnp.sum(vectors**2, axis=-1))
