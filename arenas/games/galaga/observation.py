"""Observations of Galaga's robots; `observation_layout.py` describes their parts."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from arenas.games.galaga.geometry import Barrel, barrel, bearing
from arenas.games.galaga.observation_layout import CONSTANT, Slots
from arenas.robots.minitank import from_x
from arenas.robots.robot import Body
from arenas.robots.rotations import into_body


class Drone(NamedTuple):
    """State of a drone for tanks with rich observation."""

    position: Array  # (3,) m, in the world
    velocity: Array  # (3,) m/s, in the world
    alive: Array  # () bool


class ObservationBuilder(NamedTuple):
    """Observations of an arena's robots; team-mates are positions (3,) in the world, in cyclic order of index."""

    slots: Slots
    buffer: int = 0

    def tank(
        self,
        body: Body,
        proprioception: Array,
        target: Array,
        mates: Sequence[Array] = (),
        drones: Sequence[Drone] = (),
    ) -> Array:
        """Return a tank's observation; `proprioception` (6,), `target` (3,) m in the world."""
        quat = body.pose[3:]
        way = from_x(bearing(barrel(body.pose, body.angles), target))
        parts = [proprioception[:2], way, proprioception[2:]]
        if self.slots == "2v2":
            mate, other = _mates(body, mates)
            parts += [_in_base_frame(body, target), mate, other[:2]]
        tail = [
            jnp.concatenate([_in_base_frame(body, d.position), into_body(quat, d.velocity), 1.0 * d.alive[None]])
            for d in drones
        ]
        return self._whole(parts, tail)

    def drone(
        self, body: Body, proprioception: Array, goal: Array, mates: Sequence[Array] = (), tanks: Sequence[Barrel] = ()
    ) -> Array:
        """Return a drone's observation; `proprioception` (9,), `goal` (3,) m in the world."""
        parts = [proprioception, _in_base_frame(body, goal)]
        if self.slots == "2v2":
            far = jnp.sqrt(jnp.sum(body.pose[:3] ** 2))
            parts += [*_mates(body, mates), jnp.stack([far, jnp.asarray(CONSTANT)])]
        tail = [jnp.concatenate([_in_base_frame(body, t.pivot), into_body(body.pose[3:], t.ahead)]) for t in tanks]
        return self._whole(parts, tail)

    def _whole(self, parts: Sequence[Array], tail: Sequence[Array]) -> Array:
        padding = jnp.zeros(max(0, self.buffer - sum(len(each) for each in tail)))
        return jnp.concatenate([*parts, *tail, padding])


def _in_base_frame(body: Body, point: Array) -> Array:
    """Transform a world point (3,) into the robot's frame, m."""
    return into_body(body.pose[3:], point - body.pose[:3])


def _mates(body: Body, mates: Sequence[Array]) -> list[Array]:
    """Return the slots of two team-mates. A single team-mate fills both; without one they are zeros."""
    if not mates:
        return [jnp.zeros(3), jnp.zeros(3)]
    first, *others = (_in_base_frame(body, mate) for mate in mates[:2])
    return [first, *(others or [first])]
