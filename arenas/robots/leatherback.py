"""Leatherback: NVIDIA's four-wheel rover on the scale of an F1TENTH car.

| quantity              | value                    | source                                                       |
|-----------------------|--------------------------|--------------------------------------------------------------|
| wheel radius          | 0.052 m                  | NVIDIA Isaac Sim tutorial "ROS 2 Ackermann" for Leatherback  |
| wheelbase, track      | 0.32 m, 0.24 m           | same                                                         |
| steering range        | ±0.75 rad                | HARL-A's environments (the tutorial: ±0.785)                 |
| mass                  | 3.8 kg                   | assumed, as F1TENTH: 3.74 kg (f1tenth_gym)                   |
| chassis               | 0.50 × 0.31 × 0.09 m     | assumed: covers the wheels, so that rovers meet box to box   |
| centre of mass        | about 0.07 m high        | assumed, as F1TENTH: 0.074 m                                 |
| wheel drive, velocity | 0.05 N·m·s/rad, ±0.9 N·m | chosen: a driven wheel must out-torque a passive one         |
| steering, position    | 5 N·m/rad, 0.3 N·m·s/rad | chosen: settles within a control step or two                 |
| tyre, chassis friction| 1.0, 0.3                 | f1tenth_gym 1.05; chosen low: rovers slide off each other    |

HARL-A drives the wheels kinematically (damping 1e5): there noses rise in a head-on push, and mass alone decides it. The
finite torque above lets the driving decide. Wheels are spheres because every engine collides spheres with planes; a
cylinder is drawn instead. One body holds a wheel's steering and spin joints, so a rover has 12 DoF.
"""

from dataclasses import replace

import jax.numpy as jnp
import mujoco
from jax import Array

from arenas.description import Part
from arenas.robots.robot import Robot, idle_script, random_script
from arenas.robots.rotations import up_z

WHEEL_RADIUS = 0.052  # m
WHEEL_WIDTH = 0.045  # m, drawn only
WHEELBASE, TRACK = 0.32, 0.24  # m
MAX_STEERING = 0.75  # rad
CHASSIS_HALF = (0.25, 0.155, 0.045)  # m
CHASSIS_HEIGHT = 0.023  # m, box centre above the axles: 30 mm of ground clearance
CHASSIS_MASS, WHEEL_MASS = 3.4, 0.1  # kg
KV_WHEEL, TORQUE_LIMIT = 0.05, 0.9  # N·m·s/rad, N·m
KP_STEERING, KV_STEERING = 5.0, 0.3  # N·m/rad, N·m·s/rad
ARMATURE = 0.001  # kg·m², the motor's inertia seen at the wheel
UPRIGHT = 0.3  # an up axis whose world z is below this is a fall

# Bits: the ground touches tyres and chassis (contype 1), chassis touch each other (contype 2), tyres only the ground.
_TYRE = {"contype": 0, "conaffinity": 1}
_CHASSIS = {"contype": 2, "conaffinity": 3}
_DRAWN = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 1}

WHEELS = {
    "front_left": (WHEELBASE / 2, TRACK / 2),
    "front_right": (WHEELBASE / 2, -TRACK / 2),
    "rear_right": (-WHEELBASE / 2, -TRACK / 2),
    "rear_left": (-WHEELBASE / 2, TRACK / 2),
}
_SPIN = tuple(f"{wheel}_spin" for wheel in WHEELS)
_STEER = ("front_left_steer", "front_right_steer")


def leatherback(
    drive_scale: float = 60.0, steer_scale: float = 0.6, limit: float | None = 1.0, wheel_limit: float | None = None,
    steer_limit: float = MAX_STEERING,
) -> Robot:  # fmt: skip
    """Make a rover whose action (throttle, steering) means `drive_scale`·a0 rad/s at all wheels, `steer_scale`·a1 rad.

    Actions are first clipped to ±`limit` (None: not at all, as HARL-A's rovers, with scales 10 and 0.1). Wheel speeds
    are then clamped to ±`wheel_limit` in rad/s (None: not at all; HARL-A's 50 has no effect in its sumo). Steering
    commands are clamped to `steer_limit` in rad; the joints stop the wheels at 0.75 rad for any command.
    """

    def command(action: Array) -> Array:
        a = action if limit is None else jnp.clip(action, -limit, limit)
        speed = drive_scale * a[0]
        if wheel_limit is not None:
            speed = jnp.clip(speed, -wheel_limit, wheel_limit)
        steering = jnp.clip(steer_scale * a[1], -steer_limit, steer_limit)
        return jnp.concatenate([jnp.full(4, speed), jnp.full(2, steering)])

    clipped = "" if limit is None else f", the action clipped to ±{limit:g}"
    clamped = "" if wheel_limit is None else f", clamped to ±{wheel_limit:g} rad/s"
    acts = (
        Part("throttle", 1, "", f"speed of all wheels, {drive_scale:g} rad/s per unit{clipped}{clamped}"),
        Part("steering", 1, "", f"angle of the front wheels to the left, {steer_scale:g} rad per unit{clipped}"),
    )
    return replace(_BODY, command=command, action_parts=acts)


def drive_towards(position: Array, speed: Array, last_throttle: Array, backwards: Array | bool = True) -> Array:
    """Return throttle and steering (2,) towards a position (2,) in the rover's heading frame, in reverse if it is
    behind.

    If `backwards` is false, the rover turns round towards a position behind it and arrives nose first.

    In reverse, the angle that brings the rear onto a position has the sign of the angle that brings the nose onto its
    mirror image in front. A rover can only circle round a position inside its turning circle. It therefore first drives
    away with the wheels turned the other way, as in a three-point turn, until the position is well outside the circle.
    """
    x, y = position
    towards = jnp.where((x > -0.3 * jnp.linalg.norm(position)) | jnp.logical_not(backwards), 1.0, -1.0)
    circle = jnp.where(last_throttle * towards < 0, 0.8, 0.5)  # m, the circle's radius; larger while driving away
    away = jnp.where(jnp.hypot(x, jnp.abs(y) - circle) < circle, -1.0, 1.0)
    steering = jnp.clip(2.0 * jnp.arctan2(y, jnp.where(backwards, jnp.abs(x), x)), -1.0, 1.0)
    return jnp.stack([away * towards * speed, away * steering])


def _build(colour: tuple[float, float, float, float]) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    base = spec.worldbody.add_body(name="chassis", pos=[0, 0, WHEEL_RADIUS])
    base.add_freejoint(name="base")
    base.add_geom(
        name="chassis", type=mujoco.mjtGeom.mjGEOM_BOX, size=CHASSIS_HALF, pos=[0, 0, CHASSIS_HEIGHT], group=3,
        mass=CHASSIS_MASS, friction=[0.3, 0.005, 0.0001], rgba=colour, **_CHASSIS,
    )  # fmt: skip
    _draw_body(base, colour)
    # The joints limit the torque, not the actuators: for a saturated actuator MJX in JAX keeps the implicit damping
    # that C and Warp drop, and its rovers were 4 mm off after 0.1 s. All three engines treat limits of joints alike.
    for wheel, (x, y) in WHEELS.items():
        body = base.add_body(name=wheel, pos=[x, y, 0])
        if wheel.startswith("front"):
            body.add_joint(
                name=f"{wheel}_steer", axis=[0, 0, 1], range=[-MAX_STEERING, MAX_STEERING], armature=ARMATURE
            )
        body.add_joint(
            name=f"{wheel}_spin", axis=[0, 1, 0], armature=ARMATURE,
            actfrclimited=True, actfrcrange=[-TORQUE_LIMIT, TORQUE_LIMIT],
        )  # fmt: skip
        body.add_geom(
            name=wheel, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[WHEEL_RADIUS, 0, 0], mass=WHEEL_MASS, group=3,
            friction=[1.0, 0.005, 0.0001], priority=1, **_TYRE,
        )  # fmt: skip
        _draw_wheel(body)
    for name in _SPIN:
        servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_velocity(kv=KV_WHEEL)
    for name in _STEER:
        servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp=KP_STEERING, kv=KV_STEERING)
    return spec


def _draw_body(base: mujoco.MjsBody, colour: tuple[float, float, float, float]) -> None:
    """Draw a hull, a cabin and a white nose that shows the heading; none of them collides."""
    dark = [0.10, 0.11, 0.13, 1]
    hull = [CHASSIS_HALF[0], 0.095, 0.03]
    for name, size, pos, rgba in (
        ("hull", hull, [0, 0, 0.02], colour),
        ("deck", [0.20, CHASSIS_HALF[1], 0.008], [0, 0, 0.058], colour),
        ("cabin", [0.075, 0.085, 0.024], [-0.05, 0, 0.088], dark),
        ("nose", [0.012, 0.09, 0.012], [CHASSIS_HALF[0], 0, 0.03], [0.95, 0.95, 0.92, 1]),
    ):
        base.add_geom(name=f"{name}_drawn", type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=pos, rgba=rgba, **_DRAWN)


def _draw_wheel(body: mujoco.MjsBody) -> None:
    on_side = [0.70710678, 0.70710678, 0, 0]  # the cylinder's axis from z to y
    for name, size, rgba in (
        ("tyre", [WHEEL_RADIUS, WHEEL_WIDTH / 2, 0], [0.07, 0.07, 0.08, 1]),
        ("hub", [0.028, WHEEL_WIDTH / 2 + 0.002, 0], [0.75, 0.76, 0.78, 1]),
    ):
        body.add_geom(
            name=f"{body.name}_{name}",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=size,
            quat=on_side,
            rgba=rgba,
            **_DRAWN,
        )


_BODY = Robot(
    kind="leatherback",
    base="chassis",
    joints=_STEER,
    actuators=_SPIN + _STEER,
    action_size=2,
    rest_height=WHEEL_RADIUS,
    build=_build,
    proprioception=lambda body: body.action,
    proprioception_parts=(Part("last throttle", 1), Part("last steering", 1)),
    fallen=lambda pose: up_z(pose[3:]) < UPRIGHT,
    scripts={"idle": idle_script(2), "random": random_script(2)},
)
