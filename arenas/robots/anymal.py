"""ANYmal C: ANYbotics' quadruped of 52 kg, twelve joints under a PD law with limits of torque and speed.

| quantity                   | value                                       | source                              |
|----------------------------|---------------------------------------------|-------------------------------------|
| masses, inertias, anchors  | 52.135 kg; numbers below                    | ANYbotics' URDF, fixed links merged |
| joint ranges               | HAA −0.72 to 0.49 rad (left), HFE, KFE ±3π  | same                                |
| joint effort               | ±80 N·m                                     | same, and HARL-A's actuator         |
| PD                         | 40 N·m/rad, 5 N·m·s/rad                     | HARL-A's stand-in for its LSTM      |
| torque and speed           | 120·(1 − q̇/7.5) N·m, at most 80; mirrored   | HARL-A: 120 and 80 N·m, 7.5 rad/s   |
| default pose               | HAA 0, HFE ±0.4, KFE ∓0.8 (front, hind) rad | HARL-A                              |
| standing height            | 0.549 m, foot spheres on the ground         | derived                             |
| rotor inertia at the joint | 0.02 kg·m²                                  | assumed: HARL-A and URDF have none  |
| friction of feet           | 1.0                                         | HARL-A: ground 1.0 × robot 1.0      |
| friction of all else       | 0.3                                         | chosen, as rovers: bodies slide off |

HARL-A drives this robot with a learned model of the motors (an LSTM over position error and speed), which is not
published. The PD law is the substitute named in the same file. Measured values are on the robot's page in docs/.

Joints are listed in PhysX's breadth-first order (all HAA, all HFE, all KFE; LF, LH, RF, RH), as in HARL-A's
observations and actions; MuJoCo's own order is leg by leg.

Collision shapes are capsules and spheres: every engine collides their pairs in closed form, while boxes and cylinders
need the general convex routine. Feet, shanks, thighs and torso touch the ground and everything else. A leg's hip, thigh
and shank do not touch each other, nor do hips and thighs touch the robot's own torso.
"""

import math
from functools import partial
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from arenas.description import Part
from arenas.robots.robot import MOTION, Body, Colour, Robot, idle_script, random_script
from arenas.robots.rotations import into_body, up_z

LEGS = {"LF": (1, 1), "LH": (-1, 1), "RF": (1, -1), "RH": (-1, -1)}  # front +1 or hind −1, left +1 or right −1
DRIVES = ("HAA", "HFE", "KFE")  # hip abduction, hip flexion, knee flexion
JOINTS = tuple(f"{leg}_{drive}" for drive in DRIVES for leg in LEGS)
_ORDER = f"{', '.join(DRIVES)}, each of {', '.join(LEGS)}"

# Lengths in metres in the base's axes with all joints at 0, for the left front leg; (f, s) mirrors them to the others.
HIP_AT = (0.2999, 0.104, 0.0)  # HAA from the base's origin
THIGH_AT = (0.0599, 0.08381, 0.0)  # HFE from HAA
SHANK_AT = (0.0, 0.1003, -0.285)  # KFE from HFE
FOOT_AT = (0.08795, 0.01305, -0.31547)  # the foot sphere's centre from KFE
FOOT_RADIUS = 0.03

# Mass kg; centre of mass m; inertia about it kg·m², as xx, yy, zz, xy, xz, yz.
BASE = (26.37317, (-0.01779, -0.00018, 0.0085), (0.21671, 1.78516, 1.8337, 0.00922, 0.05893, -0.00016))
HIP = (2.781, (0.0567, 0.01739, -0.00046), (0.0033, 0.00494, 0.00583, 0.0, 0.0, 0.0))
THIGH = (3.071, (0.0, 0.03081, -0.2457), (0.0299, 0.02956, 0.00486, 0.0, 0.0, 0.00414))
SHANK = (0.58842, (0.06125, 0.00546, -0.08066), (0.00881, 0.01016, 0.00155, 0.0, 0.00182, 0.0))  # with the foot

OUTWARD, INWARD = 0.49, 0.72  # rad, how far HAA spreads a leg, and how far it moves it under the body
FLEXION = 9.42478  # rad, in both directions
REST = {"HAA": 0.0, "HFE": 0.4, "KFE": -0.8}  # rad, front legs; hind legs bend the other way
REST_HEIGHT = 0.5492  # m, of the base's origin

KP, KD = 40.0, 5.0  # N·m/rad, N·m·s/rad
STALL, EFFORT, MAX_SPEED = 120.0, 80.0, 7.5  # N·m, N·m, rad/s
ACTION_SCALE = 0.5  # rad
ARMATURE = 0.02  # kg·m²
GRIP, SLIDE = (1.0, 0.005, 0.0001), (0.3, 0.005, 0.0001)  # friction
STIFF = (
    0.998,
    0.998,
    0.001,
    0.5,
    2.0,
)  # solimp of feet: with MuJoCo's 0.9 they creep apart, and the robot lies down after 4 s
DARK, GREY = (0.10, 0.11, 0.13, 1.0), (0.45, 0.47, 0.50, 1.0)

# Collision shapes: radius m, and the ends of each capsule's axis in the frame of its body. The torso's two capsules
# replace the URDF's cylinders along x, of the same radius and place, and the boxes between them.
TORSO_RADIUS, TORSO_SIDE, TORSO_HALF = 0.09, 0.07, 0.4345  # the hull is 1.05 m × 0.32 m × 0.18 m
THIGH_RADIUS, THIGH_AXIS = 0.05, ((0.0, 0.035, 0.0), (0.0, 0.0303, -0.285))
SHANK_RADIUS, SHANK_AXIS = 0.025, ((0.02, 0.02, 0.0), (0.08795, 0.01305, -0.27))

# Bits as in arenas.scene.props: 1 the ground, 2 bodies.
_TOUCHES = {"contype": 2, "conaffinity": 3, "mass": 0, "group": 3}
_DRAWN = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 1}

# The trot, found by random search in this simulation at 0.005 s (see the robot's page).
PACE = 3.19  # Hz
FEET = (0.09287, -0.51882)  # m, a front foot from its HFE in the default pose
STRIDE, LIFT = 0.19, 0.168  # m, half the sweep of a foot, and its height: soft motors reach about half of both
STAND_TALL, LEAN = 0.0712, -0.017  # m, feet lower than in the default pose, and further back
SPREAD = 0.0115  # rad, hips inwards
STRIDE_BY_SPEED = -0.198  # m per m/s
SIDESTEP_BY_SPEED = 0.126  # rad per m/s
TURN, STRIDE_BY_TURN, YAW_DAMPING = 0.36, 0.025, 0.89  # rad, m, s/rad: feet aside, and the inner side's sweep longer
ROLL_STIFFNESS = 0.135  # m per unit of sin(roll)
HAND = 0.01  # rad

_FRONT, _LEFT = (np.array(side, np.float32) for side in zip(*LEGS.values(), strict=True))
_PAIR = np.array([0, 1, 1, 0])  # legs that step together

_REST = tuple(REST[drive] * (1 if drive == "HAA" else LEGS[leg][0]) for drive in DRIVES for leg in LEGS)


PROPRIOCEPTION = (
    *MOTION, Part("joint angles", 12, "rad", f"less the default pose: {_ORDER}"),
    Part("joint speeds", 12, "rad/s", "in the same order"), Part("last action", 12),
)  # fmt: skip


def anymal(fall_height: float = 0.17, fall_up: float = 0.3, decision: float = 0.02) -> Robot:
    """Make a quadruped whose action (12,) moves the joints' targets from the default pose, 0.5 rad per unit, unclipped.

    It has fallen when its torso's centre of mass is below `fall_height` in metres (HARL-A: 0.17 in block push, 0.10 in
    matches; with the belly on the ground it is at 0.099) or its up axis below `fall_up` (HARL-A: -1, no such rule).
    `decision` is the time in seconds between two actions of the script `trot`.
    """
    scripts = {"idle": idle_script(12), "random": random_script(12), "trot": partial(_trot, decision)}
    return Robot(
        kind="anymal",
        action_size=12,
        build=_build,
        base="base",
        joints=JOINTS,
        actuators=JOINTS,
        rest_height=REST_HEIGHT,
        rest=_REST,
        command=lambda action: jnp.asarray(_REST) + ACTION_SCALE * action,
        law=torques,
        proprioception=_proprioception,
        fallen=partial(_fallen, fall_height, fall_up),
        feet=tuple(f"{leg}_SHANK" for leg in LEGS),
        scripts=scripts,
        proprioception_parts=PROPRIOCEPTION,
        action_parts=(
            Part("targets", 12, "", f"of the joints, {ACTION_SCALE:g} rad per unit from the default pose: {_ORDER}"),
        ),
    )


def torques(angles: Any, speeds: Any, targets: Any) -> Any:
    """Return torques (..., 12) in N·m that move the joints towards `targets` in rad, limited by effort and speed.

    Accepts arrays of JAX or NumPy.
    """
    most = (STALL * (1 - speeds / MAX_SPEED)).clip(0, EFFORT)
    least = (STALL * (-1 - speeds / MAX_SPEED)).clip(-EFFORT, 0)
    return (KP * (targets - angles) - KD * speeds).clip(least, most)


def _proprioception(body: Body) -> Array:
    """Return HARL-A's 45 numbers: velocity, rates, down direction, joints from default, their speeds, last action."""
    quat = body.pose[3:]
    down = into_body(quat, jnp.array([0.0, 0.0, -1.0]))
    velocity = into_body(quat, body.velocity[:3])
    return jnp.concatenate(
        [velocity, body.velocity[3:], down, body.angles - jnp.asarray(_REST), body.speeds, body.action]
    )


def _fallen(height: float, up: float, pose: Array) -> Array:
    quat = pose[3:]
    centre = pose[2] + into_body(quat * jnp.array([1, -1, -1, -1]), jnp.asarray(BASE[1]))[2]
    return (centre < height) | (up_z(quat) < up)


# The trot -------------------------------------------------------------------------------------------------------------


def gait(observation: Array, forward: Array | float, turn: Array | float, decision: float) -> Array:
    """Return a trotting ANYmal's next action (12,); the observation must begin with its 45 proprioceptive numbers.

    `forward` and `turn` are shares of the maximum, `turn` from -1 (right) to 1 (left); `decision` is the time in
    seconds until the next action. The gait uses velocity, yaw rate and roll for balance. It needs no memory: the last
    action encodes the phase of the gait as offsets of 0.01 rad at the hips.
    """
    front, left = jnp.asarray(_FRONT), jnp.asarray(_LEFT)
    velocity, yaw_rate, roll, last = observation[:2], observation[5], observation[7], observation[33:37]
    phase = _phase(last) + 2 * jnp.pi * PACE * decision
    mine = phase + jnp.pi * _PAIR
    sweep = -jnp.cos(mine)  # −1 at lift-off, 1 at touch-down, when the foot is ahead
    turning = turn - YAW_DAMPING * yaw_rate
    ahead = forward * STRIDE + STRIDE_BY_SPEED * velocity[0] + left * STRIDE_BY_TURN * turning
    aside = SIDESTEP_BY_SPEED * velocity[1] - front * TURN * turning
    x = front * (front * FEET[0] + LEAN + ahead * sweep)
    z = FEET[1] - STAND_TALL + LIFT * jnp.maximum(0.0, jnp.sin(mine)) - ROLL_STIFFNESS * roll * left
    hip, knee = _reach(x, z)
    hands = HAND * (front * jnp.cos(phase) + jnp.sin(phase))
    spread = aside * sweep - SPREAD * left + hands
    return (jnp.concatenate([spread, front * hip, front * knee]) - jnp.asarray(_REST)) / ACTION_SCALE


def _phase(last: Array) -> Array:
    """Decode the gait's phase in rad from the hips' last abductions (4,): all other terms in them sum to zero."""
    return jnp.arctan2(jnp.sum(last), jnp.sum(_FRONT * last))


def _reach(x: Array, z: Array) -> tuple[Array, Array]:
    """Return angles of a front leg's HFE and KFE that put its foot at (x, z) from HFE, knee behind; any one shape."""
    upper, lower = -SHANK_AT[2], math.hypot(FOOT_AT[0], FOOT_AT[2])
    square = x * x + z * z
    inside = jnp.arccos(jnp.clip((upper**2 + lower**2 - square) / (2 * upper * lower), -1.0, 1.0))
    above = jnp.arccos(jnp.clip((upper**2 + square - lower**2) / (2 * upper * jnp.sqrt(square)), -1.0, 1.0))
    return above - jnp.arctan2(x, -z), inside - math.pi + math.atan2(FOOT_AT[0], -FOOT_AT[2])


def _trot(decision: float, observation: Array, key: Array) -> Array:
    """Trot straight ahead at full speed."""
    return gait(observation, 1.0, 0.0, decision)


# The body -------------------------------------------------------------------------------------------------------------


def _build(colour: Colour) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    base = spec.worldbody.add_body(name="base", pos=[0, 0, REST_HEIGHT], **_inertia(BASE, 1, 1))
    base.add_freejoint(name="base")
    for side, y in (("left", TORSO_SIDE), ("right", -TORSO_SIDE)):
        ends = ((-TORSO_HALF, y, 0.0), (TORSO_HALF, y, 0.0))
        _capsule(base, f"torso_{side}", TORSO_RADIUS, ends, **_TOUCHES, friction=SLIDE)
    _draw_torso(base, colour)
    for leg in LEGS:
        _add_leg(spec, base, leg, colour)
    return spec


def _add_leg(spec: mujoco.MjSpec, base: mujoco.MjsBody, leg: str, colour: Colour) -> None:
    f, s = LEGS[leg]
    spread = (-INWARD, OUTWARD) if s > 0 else (-OUTWARD, INWARD)
    hip = base.add_body(name=f"{leg}_HIP", pos=_at(HIP_AT, f, s), **_inertia(HIP, f, s))
    thigh = hip.add_body(name=f"{leg}_THIGH", pos=_at(THIGH_AT, f, s), **_inertia(THIGH, f, s))
    shank = thigh.add_body(name=f"{leg}_SHANK", pos=_at(SHANK_AT, f, s), **_inertia(SHANK, f, s))
    limbs = zip((hip, thigh, shank), DRIVES, ((1, 0, 0), (0, 1, 0), (0, 1, 0)), strict=True)
    for body, drive, axis in limbs:
        body.add_joint(
            name=f"{leg}_{drive}", axis=axis, range=spread if drive == "HAA" else (-FLEXION, FLEXION),
            armature=ARMATURE, actfrclimited=True, actfrcrange=[-EFFORT, EFFORT],
        )  # fmt: skip
        spec.add_actuator(name=f"{leg}_{drive}", target=f"{leg}_{drive}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    for body, name, radius, axis in (
        (thigh, "thigh", THIGH_RADIUS, THIGH_AXIS),
        (shank, "shank", SHANK_RADIUS, SHANK_AXIS),
    ):
        ends = _at(axis[0], f, s), _at(axis[1], f, s)
        _capsule(body, f"{leg}_{name}", radius, ends, **_TOUCHES, friction=SLIDE)
    shank.add_geom(
        name=f"{leg}_foot", size=[FOOT_RADIUS, 0, 0], pos=_at(FOOT_AT, f, s), friction=GRIP, solimp=STIFF, priority=1,
        **_TOUCHES,
    )  # fmt: skip
    # Hips carry no shapes. Thighs lie against the torso, which would push them off when a leg moves inwards.
    spec.add_exclude(bodyname1="base", bodyname2=thigh.name)
    _draw_leg(hip, thigh, shank, (f, s), colour)


def _at(point: tuple[float, float, float], f: int, s: int) -> list[float]:
    """Mirror a point of the left front leg to another leg."""
    return [f * point[0], s * point[1], point[2]]


def _inertia(link: tuple, f: int, s: int) -> dict:
    """Mirror a link's mass properties: products of inertia change sign with each mirrored axis."""
    mass, centre, (xx, yy, zz, xy, xz, yz) = link
    return {
        "mass": mass,
        "ipos": _at(centre, f, s),
        "fullinertia": [xx, yy, zz, f * s * xy, f * xz, s * yz],
        "explicitinertial": True,
    }


def _capsule(body: mujoco.MjsBody, name: str, radius: float, ends: tuple, **more: Any) -> None:
    (a, b) = ends
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[radius, 0, 0], fromto=[*a, *b], **more)


def _draw_torso(base: mujoco.MjsBody, colour: Colour) -> None:
    """Draw the torso: a hull in the team's colour, dark ends and sides, a white nose, the lidar's cage."""
    box, rod, can = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER
    for name, kind, size, pos, rgba in (
        ("hull", box, [0.29, 0.11, 0.085], [0, 0, 0], colour),
        ("front", box, [0.055, 0.12, 0.08], [0.45, 0, 0], DARK),
        ("rear", box, [0.055, 0.12, 0.08], [-0.45, 0, 0], DARK),
        ("nose", box, [0.012, 0.09, 0.02], [0.51, 0, 0.01], [0.95, 0.95, 0.92, 1]),
        ("lidar", can, [0.07, 0.06, 0], [-0.364, 0, 0.1335], DARK),
    ):
        base.add_geom(name=f"{name}_drawn", type=kind, size=size, pos=pos, rgba=rgba, **_DRAWN)
    for side, y in (("left", 0.11), ("right", -0.11)):
        ends = [-0.42, y, -0.035, 0.42, y, -0.035]
        base.add_geom(name=f"rail_{side}", type=rod, size=[0.05, 0, 0], fromto=ends, rgba=GREY, **_DRAWN)


def _draw_leg(
    hip: mujoco.MjsBody, thigh: mujoco.MjsBody, shank: mujoco.MjsBody, mirror: tuple[int, int], colour: Colour
) -> None:
    """Draw the drives at hip and knee, and the limbs between them, along the collision shapes."""
    for body, name, radius, ends, rgba in (
        (hip, "hip", 0.06, ((0.0, 0.0, 0.0), (0.0599, 0.05, 0.0)), GREY),
        (thigh, "drive", 0.06, ((0.0, -0.01, 0.0), (0.0, 0.06, 0.0)), DARK),
        (thigh, "thigh", 0.04, ((0.0, 0.035, -0.03), (0.0, 0.0303, -0.26)), colour),
        (thigh, "knee", 0.048, ((0.0, -0.02, -0.285), (0.0, 0.07, -0.285)), DARK),
        (shank, "calf", 0.03, ((0.03, 0.02, 0.0), (0.08, 0.0147, -0.04)), GREY),
        (shank, "tube", 0.0175, ((0.08, 0.0147, -0.04), FOOT_AT), GREY),
    ):
        a, b = (_at(end, *mirror) for end in ends)
        body.add_geom(
            name=f"{body.name}_{name}_drawn", type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[radius, 0, 0], fromto=[*a, *b],
            rgba=rgba, **_DRAWN,
        )  # fmt: skip
    shank.add_geom(
        name=f"{shank.name}_foot_drawn", size=[FOOT_RADIUS, 0, 0], pos=_at(FOOT_AT, *mirror), rgba=DARK, **_DRAWN
    )
