"""Scripts of Bansal et al.'s games: `stand`, which holds the standing pose by torques.

Bodies whose joints have position targets do the same with `idle`.
"""

from collections.abc import Mapping

import jax.numpy as jnp
from jax import Array

from arenas.games.bansal.observation import ObservationBuilder
from arenas.robots.robot import Robot, Script

STIFF, DAMPED = 1.0, 0.2  # share of the largest torque per rad and per rad/s


def of_body(robot: Robot, torque: bool, seen: ObservationBuilder) -> Mapping[str, Mapping[str, Script]]:
    """Return the scripts of a body, name -> kind -> script; none unless its actions are shares of torques."""
    if not torque:
        return {}
    angles, speeds = seen.at("joint angles"), seen.at("joint speeds")

    def stand(observation: Array, key: Array) -> Array:
        return jnp.clip(-STIFF * observation[angles] - DAMPED * observation[speeds], -1.0, 1.0)

    return {"stand": {robot.kind: stand}}
