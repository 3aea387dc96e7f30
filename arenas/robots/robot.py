"""What every robot tells the arenas about itself."""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
from jax import Array


@dataclass(frozen=True)
class Robot:
    """A body, its drives and what an action means. Names are the MJCF's, without the agent's prefix."""

    kind: str
    base: str  # the body with the free joint
    joints: tuple[str, ...]  # driven joints, in the order of observations
    actuators: tuple[str, ...]
    action_size: int
    rest_height: float  # m, base origin above the ground when standing
    build: Callable[[tuple[float, float, float, float]], mujoco.MjSpec]  # colour -> one body under the world
    command: Callable[[Array], Array]  # action (action_size,) -> command (len(actuators),)
