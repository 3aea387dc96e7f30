"""Galaga's first stage for drones: a single drone flies to its goal. One team of one robot, measured by its success.

It succeeds when it is at its goal, and fails when it is too low. The end of the time cuts the attempt off
(`truncated`): the clock is not observed, so the learner bootstraps there; the score counts it as a failure.
"""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import EngineOptions, Solver
from arenas.description import Legend, Part
from arenas.games.galaga import geometry, scripts
from arenas.games.galaga.match import CONTACTS, ROWS, drone_robot, walls
from arenas.games.galaga.observation import ObservationBuilder
from arenas.games.galaga.observation_layout import parts, size
from arenas.games.galaga.stages import FlySettings
from arenas.games.terms import weights_of
from arenas.physics.engine import Physics
from arenas.robots.robot import Script
from arenas.scene.starts import upright_poses
from arenas.state import Verdict

DRONE = "red/0"
HALO = 0.4  # m


class Fly(Arena):
    """A drone, called `red/0`. The game's pytree is its goal (3,), m in the world."""

    def __init__(self, settings: FlySettings, **options: Unpack[EngineOptions]):
        rules, contacts = settings.rules, CONTACTS["crazyflie"]
        self.robot = drone_robot(rules.floor)
        super().__init__(
            settings.name, {"red": (self.robot,)}, settings.timing,
            asdict(rules) | {"randomisation": asdict(settings.randomisation)},
            props=walls() if rules.walls else (), solver=Solver(contacts=contacts, rows=ROWS * contacts),
            marker_kinds={"goal": "ball", "drone": "sphere"}, **options,
        )  # fmt: skip
        self.rules, self.randomisation = rules, settings.randomisation
        self.weights = weights_of(settings.reward)
        self.randomisation.check(self.scene)
        self.observation_builder, self._at = (
            ObservationBuilder(settings.slots, settings.buffer),
            self.scene.agents[DRONE].qpos,
        )
        self._rest = jnp.asarray(self.scene.rest, jnp.float32)

    def observation_size(self, agent: str) -> int:
        """Return the size of the observation, as in the match."""
        return size(self.robot.kind, self.observation_builder.slots, 0, self.observation_builder.buffer)

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """Describe the observation, as in the match."""
        return parts(self.robot.kind, self.observation_builder.slots, 0, 0, self.observation_builder.buffer)

    def legend(self) -> Legend:
        """Describe the verdict; the notes of the weights describe the terms."""
        near = f"{self.rules.goal_radius:g} m"
        return Legend(
            score=f"1 when it is within {near} of its goal; 0 when it crashes first, or time is up",
            rewards=dict.fromkeys(self.weights, ""),
            events={"goal": "it is at its goal", "crash": "it came too low"},
        )

    def place(self, key: Array) -> tuple[Array, Array, Array]:
        """Place the drone level and at rest in the air, and draw its goal."""
        start, turn, where = jax.random.split(key, 3)
        at = geometry.sample_point(start, self.rules.drone)[None]
        heading = geometry.sample_headings(turn, 1, self.rules.heading == "random")
        qpos = self._rest.at[self._at + np.arange(7)].set(upright_poses(at[:, :2], heading, at[:, 2])[0])
        return qpos, jnp.zeros(self.scene.model.nv), geometry.sample_point(where, self.rules.goal)

    def randomise(self, key: Array) -> dict[str, Array]:
        """Draw model fields by the settings."""
        return self.randomisation.draw(key, self.scene)

    def observe(self, physics: Physics, game: Array, actions: dict[str, Array]) -> dict[str, Array]:
        """Return the observation of a match without a team-mate."""
        body = self.body(DRONE, physics, actions)
        return {DRONE: self.observation_builder.drone(body, self.robot.observe_self(body), game)}

    def judge(self, before: Physics, physics: Physics, game: Array) -> tuple[Array, Verdict]:
        """Judge the control step: arrival is success, a crash or the end of time a failure."""
        was, now = self._distance(before, game), self._distance(physics, game)
        reached = now <= self.rules.goal_radius
        crash = self.fallen(physics)[0] & ~reached
        late = physics.time > self.rules.episode - self.timing.control_interval / 2
        velocity = self.body(DRONE, physics, {DRONE: jnp.zeros(4)}).velocity
        per_second = {
            "near": jnp.exp(-now), "speed": jnp.sum(velocity[:3] ** 2), "rates": jnp.sum(velocity[3:] ** 2)
        }  # fmt: skip
        terms = {"reached": 1.0 * reached, "crash": 1.0 * crash, "progress": was - now}
        terms |= {name: self.timing.control_interval * value for name, value in per_second.items()}
        return game, Verdict(
            rewards={name: weight * terms[name][None] for name, weight in self.weights.items()},
            shapings={},
            score=1.0 * reached[None],
            terminated=reached | crash,
            truncated=late & ~reached & ~crash,
            events={"goal": reached[None], "crash": crash[None]},
        )

    def _distance(self, physics: Physics, goal: Array) -> Array:
        """Return the distance to the goal in metres."""
        return jnp.sqrt(jnp.sum((physics.qpos[self._at : self._at + 3] - goal) ** 2))

    def markers(self, physics: Physics, game: Array) -> dict[str, Array]:
        """Return the goal, and a sphere round the drone, which is small in so wide a field."""
        place = physics.qpos[self._at : self._at + 3]
        return {"goal": jnp.append(game, self.rules.goal_radius), "drone": jnp.append(place, HALO)}

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """Return the drones' scripts of the match."""
        known = scripts.of_match(0.0)
        return {name: known[name] for name in ("flyer", "dodger")}
