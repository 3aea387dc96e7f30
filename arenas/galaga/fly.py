"""Galaga's first stage for drones: one alone flies to its goal. One team of one robot, measured by its success.

It succeeds when it is at its goal, and fails when it has come too low. No time left cuts the attempt off (`truncated`):
the clock is not observed, so the learner bootstraps there; for the score it is a failure.
"""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.about import Legend, Part
from arenas.arena import Arena
from arenas.galaga import geometry, scripts
from arenas.galaga.layouts import parts, size
from arenas.galaga.match import CONTACTS, ROWS, floored, walls
from arenas.galaga.sight import Sight
from arenas.galaga.stages import FlySettings
from arenas.options import Solver, Where
from arenas.physics import Physics
from arenas.robots.robot import Script
from arenas.starts import bases
from arenas.state import Verdict

DRONE = "red/0"
HALO = 0.4  # m


class Fly(Arena):
    """A drone, called `red/0`. The game's pytree is its goal (3,), m in the world."""

    def __init__(self, settings: FlySettings, **where: Unpack[Where]):
        rules, contacts = settings.rules, CONTACTS["crazyflie"]
        self.robot = floored(rules.floor)
        super().__init__(
            settings.name, {"red": (self.robot,)}, settings.timing,
            asdict(rules) | {"randomisation": asdict(settings.randomisation)},
            props=walls() if rules.walls else (), solver=Solver(contacts=contacts, rows=ROWS * contacts),
            marker_kinds={"goal": "ball", "drone": "sphere"}, **where,
        )  # fmt: skip
        self.rules, self.randomisation = rules, settings.randomisation
        self.weights = asdict(settings.reward)
        self.randomisation.check(self.scene)
        self.sight, self._at = Sight(settings.slots, settings.buffer), self.scene.agents[DRONE].qpos
        self._rest = jnp.asarray(self.scene.rest, jnp.float32)

    def observation_size(self, agent: str) -> int:
        """As in the match to come."""
        return size(self.robot.kind, self.sight.slots, 0, self.sight.buffer)

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """The same in words."""
        return parts(self.robot.kind, self.sight.slots, 0, 0, self.sight.buffer)

    def legend(self) -> Legend:
        """Each weight says what its term is."""
        near = f"{self.rules.goal_radius:g} m"
        return Legend(
            score=f"1 when it is within {near} of its goal; 0 when it crashes first, or time is up",
            rewards=dict.fromkeys(self.weights, ""),
            events={"goal": "it is at its goal", "crash": "it came too low"},
        )

    def place(self, key: Array) -> tuple[Array, Array, Array]:
        """Level and at rest in the air, its goal wherever it is drawn."""
        start, turn, where = jax.random.split(key, 3)
        at = geometry.anywhere(start, self.rules.drone)[None]
        heading = geometry.turned(turn, 1, self.rules.heading == "random")
        qpos = self._rest.at[self._at + np.arange(7)].set(bases(at[:, :2], heading, at[:, 2])[0])
        return qpos, jnp.zeros(self.scene.model.nv), geometry.anywhere(where, self.rules.goal)

    def randomise(self, key: Array) -> dict[str, Array]:
        """As the settings say."""
        return self.randomisation.draw(key, self.scene)

    def observe(self, physics: Physics, game: Array, actions: dict[str, Array]) -> dict[str, Array]:
        """As in a match, with no team-mate."""
        body = self.body(DRONE, physics, actions)
        return {DRONE: self.sight.drone(body, self.robot.feels(body), game)}

    def judge(self, before: Physics, physics: Physics, game: Array) -> tuple[Array, Verdict]:
        """Success is to arrive, failure to crash or to be late."""
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
        """Metres to the goal."""
        return jnp.sqrt(jnp.sum((physics.qpos[self._at : self._at + 3] - goal) ** 2))

    def markers(self, physics: Physics, game: Array) -> dict[str, Array]:
        """The goal, and a sphere round the drone, which is small for so wide a field."""
        place = physics.qpos[self._at : self._at + 3]
        return {"goal": jnp.append(game, self.rules.goal_radius), "drone": jnp.append(place, HALO)}

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """The drones of the match."""
        known = scripts.of_match(0.0)
        return {name: known[name] for name in ("flyer", "dodger")}
