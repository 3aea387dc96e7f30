"""Galaga's first stage for tanks: a single tank points at a target. One team of one robot, measured by its success.

It succeeds when its barrel is on the target, by the measure of the 1v1 game. The end of the time cuts the attempt off
(`truncated`): the clock is not observed, so the learner bootstraps there; the score counts it as a failure.
"""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Unpack

import jax
import jax.numpy as jnp
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import EngineOptions, Solver
from arenas.description import Legend, Part
from arenas.games.galaga import geometry, scripts
from arenas.games.galaga.match import CONTACTS, ROWS, laser, zone
from arenas.games.galaga.observation import ObservationBuilder
from arenas.games.galaga.observation_layout import parts, size
from arenas.games.galaga.stages import AimSettings
from arenas.games.terms import weights_of
from arenas.physics.engine import Physics
from arenas.robots.minitank import from_x, minitank
from arenas.robots.robot import Script
from arenas.scene.starts import upright_poses
from arenas.state import Verdict

TANK = "blue/0"


class Aim(Arena):
    """A tank, called `blue/0`. The game's pytree is the target (3,), m in the world."""

    def __init__(self, settings: AimSettings, **options: Unpack[EngineOptions]):
        rules, contacts = settings.rules, CONTACTS["minitank"]
        self.robot = minitank(rules.tank_speed)
        super().__init__(
            settings.name, {"blue": (self.robot,)}, settings.timing,
            asdict(rules) | {"randomisation": asdict(settings.randomisation)},
            solver=Solver(contacts=contacts, rows=ROWS * contacts),
            marker_kinds={"laser": "segment", "target": "sphere"}, **options,
        )  # fmt: skip
        self.rules, self.randomisation = rules, settings.randomisation
        self.weights = weights_of(settings.reward)
        self.randomisation.check(self.scene)
        self.observation_builder, self._at = (
            ObservationBuilder(settings.slots, settings.buffer),
            self.scene.agents[TANK],
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
        return Legend(
            score="1 when its barrel points at the target; 0 when time is up",
            rewards=dict.fromkeys(self.weights, ""),
            events={"capture": "its barrel points at the target"},
        )

    def place(self, key: Array) -> tuple[Array, Array, Array]:
        """Place the tank at the origin, and the target at a minimum distance from it."""
        rules = self.rules
        turn, joints, where = jax.random.split(key, 3)
        heading = geometry.sample_headings(turn, 1, rules.heading == "random")
        base = upright_poses(jnp.zeros((1, 2)), heading, jnp.array([self.robot.rest_height]))[0]
        qpos = self._rest.at[self._at.qpos + jnp.arange(7)].set(base)
        qpos = qpos.at[self._at.joint_qpos].set(geometry.sample_barrel_angles(joints, 1, rules.barrel == "random")[0])
        target = geometry.sample_point(where, rules.target)
        side = jnp.where(target[:2] < 0.0, -1.0, 1.0)
        target = target.at[:2].set(side * jnp.maximum(jnp.abs(target[:2]), rules.nearest))
        return qpos, jnp.zeros(self.scene.model.nv), target

    def randomise(self, key: Array) -> dict[str, Array]:
        """Draw model fields by the settings."""
        return self.randomisation.draw(key, self.scene)

    def observe(self, physics: Physics, game: Array, actions: dict[str, Array]) -> dict[str, Array]:
        """Return the observation of a match without a team-mate."""
        body = self.body(TANK, physics, actions)
        return {TANK: self.observation_builder.tank(body, self.robot.observe_self(body), game)}

    def judge(self, before: Physics, physics: Physics, game: Array) -> tuple[Array, Verdict]:
        """Judge the control step: the barrel on the target is success."""
        (_, was), (gap, now) = self._errors(before, game), self._errors(physics, game)
        hit = gap < self.rules.aim_error
        late = physics.time > self.rules.episode - self.timing.control_interval / 2
        terms = {"hit": 1.0 * hit, "progress": was - now, "aim": self.timing.control_interval * jnp.exp(-gap)}
        return game, Verdict(
            rewards={name: weight * terms[name][None] for name, weight in self.weights.items()},
            shapings={},
            score=1.0 * hit[None],
            terminated=hit,
            truncated=late & ~hit,
            events={"capture": hit[None]},
        )

    def _barrel(self, physics: Physics) -> geometry.Barrel:
        body = self.body(TANK, physics, {TANK: jnp.zeros(2)})
        return geometry.barrel(body.pose, body.angles)

    def _errors(self, physics: Physics, target: Array) -> tuple[Array, Array]:
        """Return the L1 distance of the quaternions, and the angle in rad, between the barrel and the target's
        direction.
        """
        of = self._barrel(physics)
        way = geometry.bearing(of, target)
        return geometry.quaternion_gap(from_x(way), from_x(of.ahead)), geometry.angle(way, of.ahead)

    def markers(self, physics: Physics, game: Array) -> dict[str, Array]:
        """Return the laser, and the sphere that it must pass through."""
        of = self._barrel(physics)
        return {"laser": laser(of), "target": zone([of], game)}

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """Return the tank's script of the match."""
        return {"gunner": scripts.of_match(self.rules.tank_speed)["gunner"]}
