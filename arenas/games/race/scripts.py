"""Scripts of the gate race: anchors for the ratings. They know no walls and no other drones.

`pilot` flies to the axis of its next gate and along it through the opening, at 3.5 m/s; `cadet` does so at 2 m/s.
"""

from collections.abc import Mapping
from functools import partial

import jax.numpy as jnp
from jax import Array

from arenas.games.race.observation import read
from arenas.games.race.settings import KIND
from arenas.robots.crazyflie import GRAVITY, RATES, throttle
from arenas.robots.robot import Script

SPEEDS = {"cadet": 2.0, "pilot": 3.5}  # m/s
NARROW = 0.3  # m beside the axis within which it flies straight ahead
MARGIN, SLOPE = 0.5, 1.5  # m before the opening, and m ahead per m aside, where it goes on at full speed
ASIDE_GAIN, FORESIGHT = 1.0, 0.25  # of the speed for each metre beside the axis, s that it looks ahead
SPEED_GAIN, PUSH = 3.0, 10.0  # 1/s of an error of speed, m/s² at most
TURN_GAIN = 8.0  # 1/s of an error of the thrust's direction


def fly(speed: float, observation: Array, key: Array) -> Array:
    """Fly through the next gate."""
    view = read(observation)
    corners, up = view.gates[0], -view.down
    centre, ahead = corners.mean(axis=0), _unit(jnp.cross(corners[0] - corners[1], up))  # left × up
    before = jnp.sum(centre * ahead)  # m that are left along the axis; negative behind the gate
    drift = view.velocity - jnp.sum(view.velocity * ahead) * ahead
    aside = centre - before * ahead - FORESIGHT * drift  # from where it will be to the axis
    off = jnp.sqrt(jnp.sum(aside**2))
    room = jnp.where(before > 0, (before - MARGIN) / jnp.maximum(SLOPE * off, 1e-6), -1.0)
    along = jnp.where((off < NARROW) & (before > 0), 1.0, jnp.clip(room, -1.0, 1.0))
    wanted = along * ahead + jnp.minimum(ASIDE_GAIN * off, 1.0) * _unit(aside)
    return _steer(view.velocity, up, speed * wanted / jnp.maximum(1.0, jnp.sqrt(jnp.sum(wanted**2))))


def of_game() -> Mapping[str, Mapping[str, Script]]:
    """Return the scripts by name and robot kind."""
    return {name: {KIND: partial(fly, speed)} for name, speed in SPEEDS.items()}


def _steer(velocity: Array, up: Array, wanted: Array) -> Array:
    """Return the action that tilts and lifts a drone to the velocity `wanted` (3,) m/s in its own frame."""
    pull = SPEED_GAIN * (wanted - velocity)
    pull *= jnp.minimum(1.0, PUSH / jnp.maximum(jnp.sqrt(jnp.sum(pull**2)), 1e-6))
    thrust = pull + GRAVITY * up
    way = _unit(thrust)
    across = jnp.sqrt(way[0] ** 2 + way[1] ** 2)
    turn = TURN_GAIN * jnp.arctan2(across, way[2]) / jnp.maximum(across, 1e-6)
    rates = turn * jnp.stack([-way[1], way[0], jnp.zeros(())]) / jnp.array(RATES)
    return jnp.concatenate([throttle(jnp.maximum(thrust[2:], 0.0) / GRAVITY), jnp.clip(rates, -1.0, 1.0)])


def _unit(vector: Array) -> Array:
    """Return the direction of a vector (3,); zero for the zero vector."""
    return vector / jnp.maximum(jnp.sqrt(jnp.sum(vector**2)), 1e-6)
