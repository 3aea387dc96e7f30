"""Galaga's first stage for tanks: one alone points at a target. One team of one robot, measured by its success.

It succeeds when its barrel is on the target, by the measure of the game of one. No time left cuts the attempt off
(`truncated`): the clock is not observed, so the learner bootstraps there; for the score it is a failure.
"""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Unpack

import jax
import jax.numpy as jnp
from jax import Array

from arenas.about import Legend, Part
from arenas.arena import Arena
from arenas.galaga import geometry, scripts
from arenas.galaga.layouts import parts, size
from arenas.galaga.match import CONTACTS, ROWS, laser, zone
from arenas.galaga.sight import Sight
from arenas.galaga.stages import AimSettings
from arenas.options import Solver, Where
from arenas.physics import Physics
from arenas.robots.minitank import from_x, minitank
from arenas.robots.robot import Script
from arenas.starts import bases
from arenas.state import Verdict

TANK = "blue/0"


class Aim(Arena):
    """A tank, called `blue/0`. The game's pytree is the target (3,), m in the world."""

    def __init__(self, settings: AimSettings, **where: Unpack[Where]):
        rules, contacts = settings.rules, CONTACTS["minitank"]
        self.robot = minitank(rules.tank_speed)
        super().__init__(
            settings.name, {"blue": (self.robot,)}, settings.timing,
            asdict(rules) | {"randomisation": asdict(settings.randomisation)},
            solver=Solver(contacts=contacts, rows=ROWS * contacts),
            marker_kinds={"laser": "segment", "target": "sphere"}, **where,
        )  # fmt: skip
        self.rules, self.randomisation = rules, settings.randomisation
        self.weights = asdict(settings.reward)
        self.randomisation.check(self.scene)
        self.sight, self._at = Sight(settings.slots, settings.buffer), self.scene.agents[TANK]
        self._rest = jnp.asarray(self.scene.rest, jnp.float32)

    def observation_size(self, agent: str) -> int:
        """As in the match to come."""
        return size(self.robot.kind, self.sight.slots, 0, self.sight.buffer)

    def observation_parts(self, agent: str) -> tuple[Part, ...]:
        """The same in words."""
        return parts(self.robot.kind, self.sight.slots, 0, 0, self.sight.buffer)

    def legend(self) -> Legend:
        """Each weight says what its term is."""
        return Legend(
            score="1 when its barrel points at the target; 0 when time is up",
            rewards=dict.fromkeys(self.weights, ""),
            events={"capture": "its barrel points at the target"},
        )

    def place(self, key: Array) -> tuple[Array, Array, Array]:
        """At the origin, the target anywhere but near."""
        rules = self.rules
        turn, joints, where = jax.random.split(key, 3)
        heading = geometry.turned(turn, 1, rules.heading == "random")
        base = bases(jnp.zeros((1, 2)), heading, jnp.array([self.robot.rest_height]))[0]
        qpos = self._rest.at[self._at.qpos + jnp.arange(7)].set(base)
        qpos = qpos.at[self._at.joint_qpos].set(geometry.barrels(joints, 1, rules.barrel == "random")[0])
        target = geometry.anywhere(where, rules.target)
        side = jnp.where(target[:2] < 0.0, -1.0, 1.0)
        target = target.at[:2].set(side * jnp.maximum(jnp.abs(target[:2]), rules.nearest))
        return qpos, jnp.zeros(self.scene.model.nv), target

    def randomise(self, key: Array) -> dict[str, Array]:
        """As the settings say."""
        return self.randomisation.draw(key, self.scene)

    def observe(self, physics: Physics, game: Array, actions: dict[str, Array]) -> dict[str, Array]:
        """As in a match, with no team-mate."""
        body = self.body(TANK, physics, actions)
        return {TANK: self.sight.tank(body, self.robot.feels(body), game)}

    def judge(self, before: Physics, physics: Physics, game: Array) -> tuple[Array, Verdict]:
        """Success is to point at the target."""
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
        """L1 distance of the quaternions, and the angle in rad, between the barrel and the way to the target."""
        of = self._barrel(physics)
        way = geometry.bearing(of, target)
        return geometry.quaternion_gap(from_x(way), from_x(of.ahead)), geometry.angle(way, of.ahead)

    def markers(self, physics: Physics, game: Array) -> dict[str, Array]:
        """The laser, and what it must pass through."""
        of = self._barrel(physics)
        return {"laser": laser(of), "target": zone([of], game)}

    def game_scripts(self) -> Mapping[str, Mapping[str, Script]]:
        """The tank of the match."""
        return {"gunner": scripts.of_match(self.rules.tank_speed)["gunner"]}
