"""Nature as a player: agents without a body that push bodies of others, or set the world before an episode begins."""

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.description import Part
from arenas.robots.robot import Bounds, Push, Robot, Script, idle_script, is_choice, random_script

AXES = "xyz"


def disturbance(bodies: Sequence[str], newtons: float, axes: str = AXES, scripts: Mapping[str, Script] = {}) -> Robot:
    """Make an agent that pushes bodies at their centres of mass, along axes of the world.

    `bodies` are names in the scene, such as blue/0/torso. Its action has a number per body and axis, clipped to ±1,
    which stands for ±`newtons`; the force is held for a decision.
    """
    picked = np.array([AXES.index(axis) for axis in axes], int)
    size = len(bodies) * len(axes)

    def wrench(action: Array) -> Array:
        forces = newtons * jnp.clip(action, -1.0, 1.0).reshape(len(bodies), len(axes))
        return jnp.zeros((len(bodies), 6)).at[:, picked].set(forces)

    along = " and ".join([", ".join(axes[:-1]), axes[-1]] if len(axes) > 1 else axes)
    return Robot(
        kind="disturbance",
        action_size=size,
        push=Push(tuple(bodies), wrench),
        scripts={"idle": idle_script(size), "random": random_script(size), **scripts},
        action_parts=tuple(
            Part(f"force on {body}", len(axes), "", f"along the world's {along}, {newtons:g} N per unit, clipped to ±1")
            for body in bodies
        ),
        identity=f"pushes {', '.join(bodies)} along {axes} with {newtons!r} N",
    )


def designer(bounds: Mapping[str, Bounds], scripts: Mapping[str, Script] = {}) -> Robot:
    """Make an agent whose first action sets the world: numbers within bounds, and choices (`Robot.designed`)."""
    size = len(bounds)
    return Robot(
        kind="designer",
        action_size=size,
        sets=dict(bounds),
        scripts={"idle": idle_script(size), "random": random_script(size), **scripts},
        action_parts=tuple(
            Part(name, 1, "", f"in the first decision: {_describe(each)}, clipped to ±1")
            for name, each in bounds.items()
        ),
        identity=f"sets {dict(bounds)!r}",
    )


def _describe(bounds: Bounds) -> str:
    """Say what an action from -1 to 1 sets."""
    if is_choice(bounds):
        return f"{', '.join(map(str, bounds))} in equal parts from -1 to 1"
    return f"-1 sets {bounds[0]:g}, 1 sets {bounds[1]:g}"
