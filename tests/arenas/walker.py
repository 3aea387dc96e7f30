"""A robot that is no rover, to see that games need not know: two springy legs, and all that a robot can own."""

import jax.numpy as jnp
import mujoco

from arenas.robots.robot import Robot, idle_script, random_script

REST = (0.3, -0.3)


def _build(colour):
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="trunk", pos=[0, 0, 0.2])
    body.add_freejoint(name="base")
    body.add_geom(name="trunk", size=[0.12, 0, 0], mass=2.0, rgba=colour, contype=2, conaffinity=3)
    for name, side in (("left", 0.1), ("right", -0.1)):
        leg = body.add_body(name=name, pos=[0, side, 0])
        leg.add_joint(name=f"{name}_hip", axis=[0, 1, 0], damping=0.05)
        leg.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.02, 0, 0], fromto=[0, 0, 0, 0, 0, -0.18], mass=0.2,
            contype=2, conaffinity=1,
        )  # fmt: skip
    for name in ("right", "left"):  # in another order than the joints: a robot's own order is what counts
        spec.add_actuator(name=f"{name}_motor", target=f"{name}_hip", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    return spec


def spring(angles, speeds, command):
    """A joint servo whose torque is limited: the command is an angle."""
    return jnp.clip(8.0 * (command - angles) - 0.2 * speeds, -1.5, 1.5)


WALKER = Robot(
    kind="walker",
    action_size=2,
    build=_build,
    base="trunk",
    joints=("left_hip", "right_hip"),
    actuators=("left_motor", "right_motor"),
    rest_height=0.2,
    rest=REST,
    command=lambda action: jnp.array(REST) + 0.5 * action,
    law=spring,
    proprioception=lambda body: jnp.concatenate([body.angles - jnp.array(REST), body.speeds, body.action]),
    fallen=lambda pose: pose[2] < 0.1,
    scripts={"idle": idle_script(2), "random": random_script(2)},
)
