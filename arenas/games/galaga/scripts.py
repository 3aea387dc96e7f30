"""Scripted tanks and drones: anchors for the ratings, which show progress that learners hide.

| script   | robot | action                                                                                          |
|----------|-------|-------------------------------------------------------------------------------------------------|
| `gunner` | tank  | turns its barrel to the target as fast as it may and brakes there; light needs no lead          |
| `flyer`  | drone | flies straight to its goal and brakes there                                                     |
| `dodger` | drone | flies to its goal in a slalom; if it observes barrels (`rich`) it also avoids their rays        |

A drone with the slots "1v1" observes no tank, and one with "2v2" no barrel: there it can only dodge in a slalom. `idle`
and `random` exist for all robots, `hover` for drones.
"""

from collections.abc import Mapping
from functools import partial

import jax.numpy as jnp
from jax import Array

from arenas.robots.crazyflie import GRAVITY, RATE_GAIN, THRUST_TO_WEIGHT, TILT_GAIN
from arenas.robots.minitank import ACCELERATION
from arenas.robots.robot import Script

CONTROL = 0.02  # s
BRAKING = 20.0  # rad/s², braking of a gunner before its target
TURN_GAIN = 12.0  # 1/s, its speed per error near the target
HARD = 10.0  # the largest action of a gunner
SPEED, SLOWING = 6.0, 4.0  # m/s top speed of a flyer, m/s² braking before its goal
GOAL_GAIN, SPEED_GAIN, PUSH = 2.0, 3.0, 8.0  # 1/s near the goal, 1/s of an error of speed, m/s² maximum acceleration
WEAVE, WAVE = 3.0, 3.0  # m/s sideways, and m of the way to the goal per wave
WIDE, FLIGHT = 1.5, 4.0  # m beyond the hit radius at which a dodger wants to pass a ray, m/s away from it


def gunner(limit: float, observation: Array, key: Array) -> Array:
    """Turn both joints to the target, at up to `limit` rad/s. The tank stands level, in any heading."""
    speeds, target, barrel = observation[:2], _bearing(observation[2:6]), _bearing(observation[6:10])
    error = target - barrel
    error = error.at[1].set(jnp.mod(error[1] + jnp.pi, 2 * jnp.pi) - jnp.pi)
    fast = jnp.minimum(TURN_GAIN * jnp.abs(error), jnp.sqrt(2 * BRAKING * jnp.abs(error)))
    wanted = jnp.sign(error) * jnp.minimum(fast, limit)
    return jnp.clip((wanted - speeds) / (ACCELERATION * CONTROL), -HARD, HARD)


def flyer(observation: Array, key: Array) -> Array:
    """Fly straight to the goal and slow down near it."""
    return _fly(observation, _homing(observation[9:12]))


def dodger(first: int, tanks: int, ray: float, observation: Array, key: Array) -> Array:
    """Fly to the goal in a slalom, and away from the rays of so many `tanks`, whose numbers begin at index `first`."""
    up, goal = -observation[6:9], observation[9:12]
    far = jnp.sqrt(jnp.sum(goal**2))
    aside = jnp.cross(up, goal / jnp.maximum(far, 1e-6))
    wanted = _homing(goal) + WEAVE * jnp.minimum(far / WAVE, 1.0) * jnp.sin(2 * jnp.pi * far / WAVE) * aside
    for k in range(tanks):
        wanted += _away(observation[first + 6 * k :][:6], ray)
    return _fly(observation, wanted)


def of_match(limit: float, first: int = 0, tanks: int = 0, ray: float = 0.0) -> Mapping[str, Mapping[str, Script]]:
    """Return the game's scripts: for tanks that turn at up to `limit` rad/s, for drones that observe `tanks` barrels.

    The barrels' numbers begin at index `first` of their observation, and their rays hit within `ray` m.
    """
    return {
        "gunner": {"minitank": partial(gunner, limit)},
        "flyer": {"crazyflie": flyer},
        "dodger": {"crazyflie": partial(dodger, first, tanks, ray)},
    }


def _bearing(quat: Array) -> Array:
    """Return elevation and azimuth (2,) in rad of the direction to which a shortest turn (4,) rotates the world's x."""
    w, _, y, z = quat
    return jnp.stack([jnp.arcsin(jnp.clip(-2 * w * y, -1.0, 1.0)), jnp.arctan2(2 * w * z, 1 - 2 * (y * y + z * z))])


def _homing(goal: Array) -> Array:
    """Return the velocity (3,) m/s that leads to a goal (3,) m and ends there."""
    far = jnp.sqrt(jnp.sum(goal**2))
    fast = jnp.minimum(jnp.minimum(GOAL_GAIN * far, jnp.sqrt(2 * SLOWING * far)), SPEED)
    return fast * goal / jnp.maximum(far, 1e-6)


def _away(tank: Array, ray: float) -> Array:
    """Return the velocity (3,) m/s away from the ray of a tank, given as pivot and barrel (6,); zero far from it."""
    pivot, ahead = tank[:3], tank[3:]
    along = jnp.maximum(-jnp.sum(pivot * ahead), 0.0)
    off = -pivot - along * ahead  # from the ray to the drone
    gap = jnp.sqrt(jnp.sum(off**2))
    near = jnp.clip((ray + WIDE - gap) / WIDE, 0.0, 1.0)
    return FLIGHT * near * off / jnp.maximum(gap, 1e-3)


def _fly(observation: Array, wanted: Array) -> Array:
    """Return the action that tilts and lifts a drone to the velocity `wanted` (3,) m/s in its own frame."""
    velocity, rates, up = observation[:3], observation[3:6], -observation[6:9]
    pull = SPEED_GAIN * (wanted - velocity)
    pull *= jnp.minimum(1.0, PUSH / jnp.maximum(jnp.sqrt(jnp.sum(pull**2)), 1e-6))
    thrust = pull + GRAVITY * up  # m/s²; rotors can only push along z
    way = thrust / jnp.maximum(jnp.sqrt(jnp.sum(thrust**2)), 1e-6)
    across = jnp.sqrt(way[0] ** 2 + way[1] ** 2)
    turn = jnp.arctan2(across, way[2]) / jnp.maximum(across, 1e-6)
    moments = 2 * TILT_GAIN * turn * jnp.stack([-way[1], way[0], jnp.zeros(())]) - RATE_GAIN * rates
    throttle = 2 * jnp.maximum(thrust[2], 0.0) / (THRUST_TO_WEIGHT * GRAVITY) - 1
    return jnp.clip(jnp.concatenate([throttle[None], moments]), -1.0, 1.0)
