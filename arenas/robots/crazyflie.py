"""Crazyflie 2: a quadrotor of 27 g. Thrust and moments act on the body; rotors are drawn and do not turn.

| quantity             | value                                     | source                                       |
|----------------------|-------------------------------------------|----------------------------------------------|
| mass                 | 0.027 kg                                  | Menagerie's cf2.xml (others: 0.028 to 0.032) |
| inertia              | 2.3951e-5, 2.3951e-5, 3.2347e-5 kg·m²     | same (others: 1.4e-5, 1.4e-5, 2.17e-5)       |
| motor arm            | 0.046 m                                   | Bitcraze: 92 mm from motor to motor          |
| thrust               | 0 to 1.9 weights along the body's z       | HARL-A                                       |
| moments              | ±0.01 N·m about the body's axes           | HARL-A; 417 rad/s² in roll and pitch         |
| rotors' disc, height | radius 0.0225 m, body 0.029 m high        | assumed: covers rotors and board             |
| damping of rates     | 1e-4 N·m·s/rad: turns die within 0.24 s   | chosen: random play spun up for ever         |
| damping of motion    | 1e-4 N·s/m: 0.4 % of the speed per second | comes with it: one number per free joint     |

There are two ways to fly it. `crazyflie` commands moments. `crazyflie_rates` commands body rates, as racing drones are
flown, and has more thrust:

| quantity     | value                                       | source                                              |
|--------------|---------------------------------------------|-----------------------------------------------------|
| thrust       | 0 to 3.15 weights                           | 2512.11781 (two racing Crazyflies)                  |
| rates        | ±100 °/s in roll and pitch, ±200 °/s in yaw | same                                                |
| lag of rates | 0.020 s in roll and pitch, 0.027 s in yaw   | chosen; 2512.11781 has motors with a lag of 0.005 s |
| drag         | 4.4 % of the speed per second               | comes with it                                       |

The controller of its rates is the joint's damping d, which all engines solve implicitly: the moment d·wanted − d·rate
is that of a proportional controller, and d moves the body too, as drag.

With the damping of the first table one unit of moment turns the drone at 100 rad/s at most. The game decides if
touching the ground ends a flight; HARL-A's tank game counts a drone at 0.25 m as lost, and so does `fallen` here.

Its collision shapes are two crossed capsules along the arms: four points on the ground, in closed form on every engine.
"""

import math
from dataclasses import replace
from functools import partial

import jax.numpy as jnp
import mujoco
from jax import Array

from arenas.description import Part
from arenas.robots.robot import MOTION, Body, Colour, Robot, idle_script, random_script
from arenas.robots.rotations import into_body

MASS = 0.027  # kg
INERTIA = (2.3951e-5, 2.3951e-5, 3.2347e-5)  # kg·m²
GRAVITY = 9.81  # m/s², defines the weight as the unit of thrust
ARM, ROTOR_RADIUS, HEIGHT = 0.046, 0.0225, 0.029  # m
THRUST_TO_WEIGHT = 1.9
MOMENT = 0.01  # N·m
DAMPING = 1e-4  # N·m·s/rad and N·s/m
LOST_BELOW = 0.25  # m
RACING_THRUST = 3.15  # weights
RATES = (math.radians(100), math.radians(100), math.radians(200))  # rad/s
RATE_DAMPING = INERTIA[0] / 0.02  # N·m·s/rad and N·s/m, by the lag of roll and pitch
RATES_LIMITS = (  # N and N·m, of thrust and the moments that hold the largest rates
    RACING_THRUST * MASS * GRAVITY, RATE_DAMPING * RATES[0], RATE_DAMPING * RATES[1], RATE_DAMPING * RATES[2],
)  # fmt: skip

MAX_THRUST = THRUST_TO_WEIGHT * MASS * GRAVITY  # N
HOVER = 2 / THRUST_TO_WEIGHT - 1  # the throttle that balances the weight
RATE_GAIN, TILT_GAIN, DRIFT_GAIN, CLIMB_GAIN = 0.04, 0.17, 0.15, 0.5  # of `hover`: s/rad, 1, s/m, s/m

WHITE = (0.95, 0.95, 0.92, 1.0)

_ACTUATORS = ("thrust", "roll", "pitch", "yaw")
_TOUCHES = {"contype": 2, "conaffinity": 3, "mass": 0, "group": 3}  # bits as in arenas.scene.props
_DRAWN = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 1}


def crazyflie(floor: float = LOST_BELOW) -> Robot:
    """Make a drone whose action (4,), clipped to ±1, is throttle (−1: none, 1: all) and moments about x, y and z.

    `floor`: height in metres at and below which it counts as fallen; negative: never.
    """
    return Robot(
        kind="crazyflie",
        action_size=4,
        build=partial(_build, DAMPING, (MAX_THRUST, MOMENT, MOMENT, MOMENT)),
        base="drone",
        actuators=_ACTUATORS,
        rest_height=HEIGHT / 2,
        limp=(-1.0, 0.0, 0.0, 0.0),  # motors off
        command=_command,
        proprioception=_proprioception,
        fallen=partial(_low, floor),
        scripts={"idle": idle_script(4), "random": random_script(4), "hover": _hover},
        proprioception_parts=MOTION,
        action_parts=(
            Part("throttle", 1, "", f"thrust: -1 none, 1 all, which is {THRUST_TO_WEIGHT:g} weights; clipped to ±1"),
            Part("moments", 3, "", f"about x, y and z, {MOMENT:g} N·m per unit, each clipped to ±1"),
        ),
    )


def crazyflie_rates(floor: float = LOST_BELOW) -> Robot:
    """Make a drone whose action (4,), clipped to ±1, is throttle (−1: none, 0: its weight, 1: all) and rates about x, y
    and z.

    `floor` is as in `crazyflie`.
    """
    return replace(
        crazyflie(floor),
        kind="crazyflie-rates",
        build=partial(_build, RATE_DAMPING, RATES_LIMITS),
        command=_rates_command,
        scripts={"idle": idle_script(4), "random": random_script(4)},
        action_parts=(
            Part("throttle", 1, "", f"-1 no thrust, 0 its weight, 1 {RACING_THRUST:g} weights; clipped to ±1"),
            Part("rates", 3, "", "about x, y and z: 100, 100 and 200 °/s per unit, each clipped to ±1"),
        ),
    )


def throttle(weights: Array) -> Array:
    """Return the throttle of `crazyflie_rates` for a thrust in weights, of any shape, clipped to what it has."""
    return jnp.clip(jnp.where(weights < 1, weights - 1, (weights - 1) / (RACING_THRUST - 1)), -1.0, 1.0)


def _rates_command(action: Array) -> Array:
    a = jnp.clip(action, -1.0, 1.0)
    weights = 1 + jnp.where(a[:1] < 0, 1.0, RACING_THRUST - 1) * a[:1]
    return jnp.concatenate([MASS * GRAVITY * weights, RATE_DAMPING * jnp.array(RATES) * a[1:]])


def _command(action: Array) -> Array:
    a = jnp.clip(action, -1.0, 1.0)
    return jnp.concatenate([MAX_THRUST * (a[:1] + 1) / 2, MOMENT * a[1:]])


def _proprioception(body: Body) -> Array:
    """Return HARL-A's first nine numbers: velocity, rates and the down direction, all in the drone's own frame."""
    quat = body.pose[3:]
    down = into_body(quat, jnp.array([0.0, 0.0, -1.0]))
    return jnp.concatenate([into_body(quat, body.velocity[:3]), body.velocity[3:], down])


def _low(floor: float, pose: Array) -> Array:
    return pose[2] <= floor


def _hover(observation: Array, key: Array) -> Array:
    """Brake and stay level, using the first nine numbers of the observation. Needs decisions at 25 Hz or more."""
    velocity, rates, down = observation[:3], observation[3:6], observation[6:9]
    climb = -jnp.sum(velocity * down)
    roll = TILT_GAIN * (down[1] + DRIFT_GAIN * velocity[1])
    pitch = -TILT_GAIN * (down[0] + DRIFT_GAIN * velocity[0])
    moments = jnp.stack([roll, pitch, jnp.zeros(())]) - RATE_GAIN * rates
    return jnp.clip(jnp.concatenate([(HOVER - CLIMB_GAIN * climb)[None], moments]), -1.0, 1.0)


def _build(damping: float, most: tuple[float, float, float, float], colour: Colour) -> mujoco.MjSpec:
    """Build the body; `most` are the largest thrust in N and moments in N·m."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    drone = spec.worldbody.add_body(
        name="drone", pos=[0, 0, HEIGHT / 2], mass=MASS, ipos=[0, 0, 0], inertia=INERTIA, explicitinertial=True
    )
    drone.add_freejoint(name="base").damping = [damping, 0, 0]
    drone.add_site(name="centre", size=[0.002, 0, 0], group=4)
    for name, axis, limit in zip(_ACTUATORS, (2, 3, 4, 5), most, strict=True):
        gear = [0.0] * 6
        gear[axis] = 1.0
        spec.add_actuator(
            name=name, target="centre", trntype=mujoco.mjtTrn.mjTRN_SITE, gear=gear, ctrllimited=True,
            ctrlrange=[0.0 if name == "thrust" else -limit, limit],
        )  # fmt: skip
    radius = HEIGHT / 2
    reach = ARM + ROTOR_RADIUS - radius
    for name, angle in (("arms_left", math.pi / 4), ("arms_right", -math.pi / 4)):
        x, y = reach * math.cos(angle), reach * math.sin(angle)
        drone.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[radius, 0, 0], fromto=[-x, -y, 0, x, y, 0], **_TOUCHES
        )
    _draw(drone, colour)
    return spec


def _draw(drone: mujoco.MjsBody, colour: Colour) -> None:
    dark = [0.12, 0.12, 0.14, 1]
    box, rod, disc = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER
    drone.add_geom(name="board", type=box, size=[0.016, 0.014, 0.006], rgba=colour, **_DRAWN)
    drone.add_geom(name="nose", type=box, size=[0.003, 0.008, 0.003], pos=[0.017, 0, 0.003], rgba=WHITE, **_DRAWN)
    for i, angle in enumerate((45, 135, 225, 315)):
        x, y = ARM * math.cos(math.radians(angle)), ARM * math.sin(math.radians(angle))
        drone.add_geom(name=f"arm{i}", type=rod, size=[0.003, 0, 0], fromto=[0, 0, 0, x, y, 0], rgba=dark, **_DRAWN)
        drone.add_geom(
            name=f"rotor{i}", type=disc, size=[ROTOR_RADIUS, 0.001, 0], pos=[x, y, 0.010],
            rgba=[*colour[:3], 0.45], **_DRAWN,
        )  # fmt: skip
