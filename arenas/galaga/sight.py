"""What Galaga's robots see: `layouts.py` says in words which number stands where."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from arenas.galaga.geometry import Barrel, barrel, bearing
from arenas.galaga.layouts import CONSTANT, Slots
from arenas.robots.minitank import from_x
from arenas.robots.robot import Body
from arenas.rotations import into_body


class Drone(NamedTuple):
    """All that a tank with rich observation sees of a drone."""

    position: Array  # (3,) m, in the world
    velocity: Array  # (3,) m/s, in the world
    alive: Array  # () bool


class Sight(NamedTuple):
    """How the robots of an arena see; team-mates are positions (3,) in the world, those next in number first."""

    slots: Slots
    buffer: int = 0

    def tank(
        self, body: Body, felt: Array, target: Array, mates: Sequence[Array] = (), drones: Sequence[Drone] = ()
    ) -> Array:
        """A tank's observation. It feels `felt` (6,) and aims at `target` (3,) m in the world."""
        quat = body.pose[3:]
        way = from_x(bearing(barrel(body.pose, body.angles), target))
        seen = [felt[:2], way, felt[2:]]
        if self.slots == "2v2":
            mate, other = _mates(body, mates)
            seen += [_seen(body, target), mate, other[:2]]
        tail = [
            jnp.concatenate([_seen(body, d.position), into_body(quat, d.velocity), 1.0 * d.alive[None]]) for d in drones
        ]
        return self._whole(seen, tail)

    def drone(
        self, body: Body, felt: Array, goal: Array, mates: Sequence[Array] = (), tanks: Sequence[Barrel] = ()
    ) -> Array:
        """A drone's observation. It feels `felt` (9,) and wants to be at `goal` (3,) m in the world."""
        seen = [felt, _seen(body, goal)]
        if self.slots == "2v2":
            far = jnp.sqrt(jnp.sum(body.pose[:3] ** 2))
            seen += [*_mates(body, mates), jnp.stack([far, jnp.asarray(CONSTANT)])]
        tail = [jnp.concatenate([_seen(body, t.pivot), into_body(body.pose[3:], t.ahead)]) for t in tanks]
        return self._whole(seen, tail)

    def _whole(self, seen: Sequence[Array], tail: Sequence[Array]) -> Array:
        padding = jnp.zeros(max(0, self.buffer - sum(len(each) for each in tail)))
        return jnp.concatenate([*seen, *tail, padding])


def _seen(body: Body, point: Array) -> Array:
    """A world point (3,) in the robot's frame, m."""
    return into_body(body.pose[3:], point - body.pose[:3])


def _mates(body: Body, mates: Sequence[Array]) -> list[Array]:
    """The slots of two team-mates: the first, and the second or the first again; zeros where there is none."""
    if not mates:
        return [jnp.zeros(3), jnp.zeros(3)]
    first, *others = (_seen(body, mate) for mate in mates[:2])
    return [first, *(others or [first])]
