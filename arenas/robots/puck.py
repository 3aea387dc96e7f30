"""Pucks: the smallest robots, for examples, tests and games in the plane. A gliding ball with two thrusters.

The thrust acts along the world's x and y, and pucks never turn.
"""

from collections.abc import Callable

import jax.numpy as jnp
import mujoco
from jax import Array

from arenas.description import Part
from arenas.robots.robot import Colour, Robot, idle_script, random_script

RADIUS, MASS = 0.1, 1.0  # m, kg
THRUST, DRAG = 4.0, 2.0  # N, N·s/m: at most 2 m/s


def puck(
    kind: str = "puck", radius: float = RADIUS, mass: float = MASS, thrust: float = THRUST, drag: float = DRAG,
    *, touches: tuple[int, int] = (1, 1), isotropic: bool = False,
) -> Robot:  # fmt: skip
    """Make a puck of a kind: metres, kilograms, newtons per unit of action, N·s/m.

    `touches` are its geom's contype and conaffinity. Its action is clipped to ±1 along each axis or, if `isotropic`, to
    a length of 1, so that it is equally fast in all directions.
    """

    def build(colour: Colour) -> mujoco.MjSpec:
        spec = mujoco.MjSpec()
        body = spec.worldbody.add_body(name="puck", pos=[0, 0, radius])
        body.add_joint(name="base", type=mujoco.mjtJoint.mjJNT_FREE, damping=drag)
        body.add_geom(
            name="puck", size=[radius, 0, 0], mass=mass, condim=1, priority=1, rgba=colour,
            contype=touches[0], conaffinity=touches[1],
        )  # fmt: skip
        body.add_site(name="hub")
        for name, gear in (("east", [thrust, 0, 0, 0, 0, 0]), ("north", [0, thrust, 0, 0, 0, 0])):
            spec.add_actuator(name=name, target="hub", trntype=mujoco.mjtTrn.mjTRN_SITE, gear=gear)
        return spec

    limit: Callable[[Array], Array] = _to_a_disc if isotropic else _to_a_square
    limits = "its length limited to 1" if isotropic else "clipped to ±1"
    return Robot(
        kind=kind,
        action_size=2,
        build=build,
        base="puck",
        actuators=("east", "north"),
        rest_height=radius,
        command=limit,
        action_parts=(Part("thrust", 2, "", f"along the world's x and y, {thrust:g} N per unit, {limits}"),),
        scripts={"idle": idle_script(2), "random": random_script(2)},
    )


def _to_a_square(action: Array) -> Array:
    return jnp.clip(action, -1.0, 1.0)


def _to_a_disc(action: Array) -> Array:
    return action / jnp.maximum(1.0, jnp.sqrt(jnp.sum(action**2)))


PUCK = puck()
