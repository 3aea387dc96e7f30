"""Scripts of Bansal et al.'s games, for bodies whose actions are shares of torques.

- `stand` holds the standing pose; bodies whose joints have position targets do the same with `idle`.
- `walk`, an ant's: its legs sweep back in diagonal pairs, about 0.5 m/s where nobody is in its way, without steering.

A humanoid cannot be scripted so simply.
"""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.games.bansal.observation import ObservationBuilder
from arenas.robots.robot import Robot, Script

STIFF, DAMPED = 1.0, 0.2  # share of the largest torque per rad and per rad/s
# The ant's gait, found by random search over walks of 8 s with noise at the start.
SWEEP, LIFT, BEND = 0.47, 0.19, -0.104  # rad: hips, ankles, and the ankles' middle from the standing pose
RATE = 5.0  # rad/s
WALK_STIFF, WALK_DAMPED = 0.615, 0.057
LEFT = np.array([1.0, 1.0, -1.0, -1.0])  # sides of the legs: 1 on the left, in the order of the joints
PHASE = np.array([0.0, np.pi, 0.0, np.pi])  # rad
ANKLES = np.array([1.0, -1.0, -1.0, 1.0])  # signs with which ankles bend


def of_body(robot: Robot, torque: bool, seen: ObservationBuilder, episode: float) -> dict[str, Mapping[str, Script]]:
    """Return the scripts of a body, name -> kind -> script; none unless its actions are shares of torques.

    `episode` is the longest duration in seconds.
    """
    if not torque:
        return {}
    angles, speeds = seen.at("joint angles"), seen.at("joint speeds")

    def hold(observation: Array, target: Array | float, stiff: float, damped: float) -> Array:
        return jnp.clip(stiff * (target - observation[angles]) - damped * observation[speeds], -1.0, 1.0)

    def stand(observation: Array, key: Array) -> Array:
        return hold(observation, 0.0, STIFF, DAMPED)

    def walk(observation: Array, key: Array) -> Array:
        phase = RATE * episode * (1.0 - observation[-1]) + PHASE
        hips, ankles = LEFT * SWEEP * jnp.sin(phase), ANKLES * (BEND + LIFT * jnp.cos(phase))
        return hold(observation, jnp.stack([hips, ankles], axis=1).reshape(-1), WALK_STIFF, WALK_DAMPED)

    found: dict[str, Mapping[str, Script]] = {"stand": {robot.kind: stand}}
    return found | ({"walk": {robot.kind: walk}} if robot.kind == "ant" else {})
