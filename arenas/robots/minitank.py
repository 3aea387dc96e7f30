"""MiniTank: a turret of two kinematic joints on a body without drive; it turns on the spot and aims.

HARL-A's asset is not public: its code reveals only the two joints' names, their drives and the pivot's height. All
other values are assumptions and marked as such.

| quantity            | value                                         | source                                      |
|---------------------|-----------------------------------------------|---------------------------------------------|
| joints              | `arm_joint`, `rotor_joint`                    | HARL-A's code                               |
| their axes          | arm: pitch, positive is up; rotor: yaw        | assumed                                     |
| pivot of the barrel | 0.06 m above the base's centre                | HARL-A's code                               |
| joint speed         | at most 5 rad/s (2 in the two-tank game)      | HARL-A's code                               |
| action              | 0.5 rad/s per unit and control step of 0.02 s | HARL-A's code; here 25 rad/s² per unit      |
| drive               | velocity, 1 N·m·s/rad: settles within 8 ms    | assumed; HARL-A's is kinematic, damping 1e8 |
| base                | 0.30 × 0.20 × 0.10 m, 2.4 kg, free            | assumed; HARL-A never moves or resets it    |
| turret, barrel      | 0.3 kg, r 0.05 m; 0.3 kg, 0.25 m, r 0.015 m   | assumed (HARL-A's markers: about 0.25 m)    |
| barrel's balance    | its centre of mass is on the pivot            | assumed: a kinematic barrel never droops    |
| range of the arm    | −0.1 to 1.5 rad                               | assumed: from just below level to overhead  |
| range of the rotor  | none                                          | assumed                                     |
| friction on ground  | 1.0                                           | HARL-A: ground 1.0 × robot 1.0              |

HARL-A sets each joint's speed target to its current speed plus 0.5·action. Here the target is the actuator's own state,
the integral of the action within ± the speed limit. Both are the same as long as the drive holds its target. There is
no torque limit: the implicit integrator keeps the damping of a saturated drive, and the base turned along.

Its collision shapes are two capsules along x, together as wide, long and high as the box, and one for the barrel.
"""

from functools import partial

import jax.numpy as jnp
import mujoco
from jax import Array

from arenas.description import Part
from arenas.robots.robot import Body, Colour, Robot, idle_script, random_script
from arenas.robots.rotations import into_body, up_z

BASE_HALF = (0.15, 0.10, 0.05)  # m
BASE_MASS, TURRET_MASS, BARREL_MASS = 2.4, 0.3, 0.3  # kg
TURRET_RADIUS, TURRET_HALF = 0.05, 0.015  # m
PIVOT = 0.06  # m above the base's centre
BARREL_LENGTH, BARREL_RADIUS = 0.25, 0.015  # m
ELEVATION = (-0.1, 1.5)  # rad
SPEED_LIMIT = 5.0  # rad/s
ACCELERATION = 0.5 / 0.02  # rad/s² per unit of action
KV = 1.0  # N·m·s/rad
ARMATURE = 0.001  # kg·m², assumed
GRIP = (1.0, 0.005, 0.0001)  # friction
STIFF = (0.998, 0.998, 0.001, 0.5, 2.0)  # solimp: with MuJoCo's 0.9 a body creeps under an accelerating turret
FALLEN_UP = 0.3  # world z of the up axis, as for rovers

WHITE = (0.95, 0.95, 0.92, 1.0)

JOINTS = ("arm_joint", "rotor_joint")
_TOUCHES = {"contype": 2, "conaffinity": 3, "group": 3}  # bits as in arenas.scene.props
_DRAWN = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 1}


def minitank(speed_limit: float = SPEED_LIMIT) -> Robot:
    """Make a turret whose action (arm, rotor) means 25 rad/s² per unit, up and left, up to `speed_limit` in rad/s."""
    return Robot(
        kind="minitank",
        action_size=2,
        build=partial(_build, speed_limit),
        base="base",
        joints=JOINTS,
        actuators=JOINTS,
        rest_height=BASE_HALF[2],
        command=lambda action: ACCELERATION * action,
        proprioception=_proprioception,
        fallen=lambda pose: up_z(pose[3:]) < FALLEN_UP,
        scripts={"idle": idle_script(2), "random": random_script(2)},
        proprioception_parts=(
            Part("joint speeds", 2, "rad/s", "arm, rotor: the targets just applied"),
            Part("barrel", 4, "", "quaternion, w first: the shortest rotation from the world's x to its direction"),
        ),
        action_parts=(
            Part("arm", 1, "", f"{ACCELERATION:g} rad/s² upwards per unit, up to {speed_limit:g} rad/s"),
            Part("rotor", 1, "", f"{ACCELERATION:g} rad/s² to the left per unit, up to {speed_limit:g} rad/s"),
        ),
    )


def aim(pose: Array, angles: Array) -> Array:
    """Return the barrel's direction, a unit vector (3,) in the world, from base pose (7,) and joint angles (arm,
    rotor).
    """
    arm, rotor = angles
    ahead = jnp.stack([jnp.cos(arm) * jnp.cos(rotor), jnp.cos(arm) * jnp.sin(rotor), jnp.sin(arm)])
    return into_body(pose[3:] * jnp.array([1.0, -1.0, -1.0, -1.0]), ahead)


def pivot(pose: Array) -> Array:
    """Return the barrel's pivot, (3,) m in the world, from base pose (7,)."""
    return pose[:3] + into_body(pose[3:] * jnp.array([1.0, -1.0, -1.0, -1.0]), jnp.array([0.0, 0.0, PIVOT]))


def from_x(direction: Array) -> Array:
    """Return the shortest rotation from world +x to a unit vector (3,), as a quaternion (4,), w first: HARL-A's aim.

    For the direction straight backwards, where every axis would do, it turns about z.
    """
    x, y, z = direction
    quat = jnp.stack([jnp.maximum(1.0 + x, 0.0), jnp.zeros(()), -z, y])
    length = jnp.sqrt(jnp.sum(quat * quat))
    backwards = length < 1e-6
    return jnp.where(backwards, jnp.array([0.0, 0.0, 0.0, 1.0]), quat / jnp.where(backwards, 1.0, length))


def _proprioception(body: Body) -> Array:
    """Return six numbers: the joints' speeds, which are the targets just applied, and the barrel's quaternion."""
    return jnp.concatenate([body.speeds, from_x(aim(body.pose, body.angles))])


def _build(speed_limit: float, colour: Colour) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    length, width, height = BASE_HALF
    base = spec.worldbody.add_body(
        name="base", pos=[0, 0, height], mass=BASE_MASS, ipos=[0, 0, 0], explicitinertial=True,
        inertia=[BASE_MASS / 3 * (b * b + c * c) for b, c in ((width, height), (length, height), (length, width))],
    )  # fmt: skip
    base.add_freejoint(name="base")
    for name, y in (("track_left", width - height), ("track_right", height - width)):
        end = length - height
        base.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[height, 0, 0], fromto=[-end, y, 0, end, y, 0],
            friction=GRIP, priority=1, solimp=STIFF, mass=0, **_TOUCHES,
        )  # fmt: skip
    turret = base.add_body(name="rotor", pos=[0, 0, PIVOT])
    turret.add_joint(name="rotor_joint", axis=[0, 0, 1], armature=ARMATURE)
    turret.add_geom(
        name="turret_drawn", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[TURRET_RADIUS, TURRET_HALF, 0],
        rgba=colour, **(_DRAWN | {"mass": TURRET_MASS}),
    )  # fmt: skip
    across = BARREL_MASS * BARREL_LENGTH**2 / 3  # kg·m², a rod about its end
    arm = turret.add_body(
        name="arm", mass=BARREL_MASS, ipos=[0, 0, 0], inertia=[across * 0.01, across, across], explicitinertial=True
    )
    arm.add_joint(name="arm_joint", axis=[0, -1, 0], range=ELEVATION, armature=ARMATURE)
    arm.add_geom(
        name="barrel", type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[BARREL_RADIUS, 0, 0], mass=0,
        fromto=[BARREL_RADIUS, 0, 0, BARREL_LENGTH - BARREL_RADIUS, 0, 0], **_TOUCHES,
    )  # fmt: skip
    spec.add_exclude(bodyname1="base", bodyname2="arm")  # the barrel starts inside the hull
    for name in JOINTS:
        spec.add_actuator(
            name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT,
            dyntype=mujoco.mjtDyn.mjDYN_INTEGRATOR, actlimited=True, actrange=[-speed_limit, speed_limit],
            gaintype=mujoco.mjtGain.mjGAIN_FIXED, gainprm=[KV] + [0] * 9,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE, biasprm=[0, 0, -KV] + [0] * 7,
        )  # fmt: skip
    _draw(base, arm, colour)
    return spec


def _draw(base: mujoco.MjsBody, arm: mujoco.MjsBody, colour: Colour) -> None:
    dark = [0.10, 0.11, 0.13, 1]
    length, width, height = BASE_HALF
    box, rod = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE
    base.add_geom(name="hull", type=box, size=[length - 0.03, width - 0.04, height - 0.015], rgba=colour, **_DRAWN)
    base.add_geom(name="nose", type=box, size=[0.006, 0.04, 0.012], pos=[length - 0.025, 0, 0.02], rgba=WHITE, **_DRAWN)
    for name, y in (("left", width - 0.02), ("right", 0.02 - width)):
        base.add_geom(
            name=f"track_{name}_drawn", type=box, size=[length - 0.02, 0.02, height - 0.005], pos=[0, y, -0.005],
            rgba=dark, **_DRAWN,
        )  # fmt: skip
    arm.add_geom(
        name="barrel_drawn", type=rod, size=[BARREL_RADIUS, 0, 0], rgba=dark,
        fromto=[BARREL_RADIUS, 0, 0, BARREL_LENGTH - BARREL_RADIUS, 0, 0], **_DRAWN,
    )  # fmt: skip
