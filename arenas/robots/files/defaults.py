"""Settings of a robot that only has a model: drives from its actuators, home pose, size, feet, gains.

Gains of PD targets that the file does not have: for one radian a joint gives the torque of the whole weight at the
height of the base, twice what two ankles need to hold a body upright, but at most its effort for 0.1 rad. A sliding
joint gives the whole weight for 0.05 m, and at most its effort for 0.1 m. Damping is critical for its own inertia, and
at least a thirtieth of the stiffness.
"""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from arenas.errors import RobotError
from arenas.robots.files.actuators import drives_of
from arenas.robots.files.body import colliding, home_pose
from arenas.robots.files.extents import corners, lowest
from arenas.robots.files.robot_file import Control, Drive, RobotFile
from arenas.robots.files.source import HINGE, SLIDE, Source, read_source
from arenas.robots.kinds import KINDS

HOLDS, REACH, DAMPED = 1.0, 0.1, 1 / 30
SAG = 0.05  # m, of a sliding joint under the whole weight
SPEEDS = {HINGE: 10.0, SLIDE: 0.5}  # rad/s and m/s of a velocity target per unit of action
GRAVITY = 9.81
SCALE = 0.5  # rad of a position target per unit of action, or a quarter of the joint's or target's range
NO_ROTOR = 0.01  # kg·m² for PD targets where the file has no inertia of rotors: assumed
FALLEN_HEIGHT, FALLEN_UP = 0.5, 0.3  # share of the standing height, world z of the up axis
LEAST_HEIGHT = 0.01  # share of the width: a base at the ground stands no higher than one that has fallen
NEAR_GROUND = 0.05  # share of the height: bodies so near to the ground are feet


def derive(
    path: Path, *, control: Control | None = None, free_base: bool = False, passive: tuple[str, ...] = ()
) -> RobotFile:
    """Return the settings of a model. `control` replaces that of all its actuators. Raises RobotError, one line."""
    source = read_source(path, free_base)
    drives = drives_of(source, control, passive)
    home = home_of(source)
    drives = {name: _homed(drive, home[name]) for name, drive in drives.items()}
    height, width, feet = standing(source, drives)
    drives = _with_gains(source, drives, height)
    touching = len(colliding(source))
    return RobotFile(
        name=_name(path), model=path.name, base=source.body(source.base), height=height, width=width,
        fall_height=_round(FALLEN_HEIGHT * height), fall_up=FALLEN_UP, feet=feet, drives=drives, passive=passive,
        self_contact=_touches_itself(source), free_base=free_base, planar=source.planar, contacts=min(48, 4 + touching),
        rows=len(drives) + 4 * min(24, 4 + touching), folder=str(path.parent),
    )  # fmt: skip


def fitted(source: Source, robot: RobotFile) -> RobotFile:
    """Return the settings with the height, width and feet of their own standing pose, for a pose that was edited."""
    height, width, feet = standing(source, robot.drives)
    fall = _round(robot.fall_height / robot.height * height)
    return replace(robot, height=height, width=width, feet=feet, fall_height=fall)


def home_of(source: Source) -> dict[str, float]:
    """Return the standing pose by joint: keyframe `home` or the first, else gymnasium's init_qpos, else the model's."""
    model = source.model
    qpos = np.array(model.qpos0)
    names = [model.key(i).name for i in range(model.nkey)]
    start = [i for i in range(model.nnumeric) if model.numeric(i).name == "init_qpos"]
    if names:
        qpos = np.array(model.key_qpos[names.index("home") if "home" in names else 0])
    elif start and model.numeric_size[start[0]] == model.nq:
        first = model.numeric_adr[start[0]]
        qpos = np.array(model.numeric_data[first : first + model.nq])
    return {source.joint(j): float(qpos[model.jnt_qposadr[j]]) for j in source.joints}


def _homed(drive: Drive, home: float) -> Drive:
    """Return the drive with its home, brought into the range of the joint."""
    limited = drive.low < drive.high
    if limited and not drive.low - 1e-3 <= home <= drive.high + 1e-3:
        home = min(max(home, drive.low), drive.high)
    return replace(drive, home=_round(home))


def standing(source: Source, drives: dict[str, Drive]) -> tuple[float, float, tuple[str, ...]]:
    """Return height and width in m, and the feet, of the robot in its standing pose."""
    data, touching = home_pose(source, drives), colliding(source)
    if not touching:
        raise RobotError(f"{source.path}: no geom of body {source.body(source.base)} or below it touches anything")
    low = {g: lowest(data, g) for g in touching}
    height = -min(low.values())
    points = np.concatenate([corners(data, g) for g in touching])
    width = 2 * float(np.linalg.norm(points[:, :2], axis=1).max())
    if height <= LEAST_HEIGHT * width:
        raise RobotError(
            f"{source.path}: the origin of base {source.body(source.base)} is not above the lowest of its geoms, so it"
            " would count as fallen: put it inside the body; in a URDF leave out base_footprint and its joint"
        )
    near = min(low.values()) + max(0.01, NEAR_GROUND * height)
    feet = {source.body(int(source.model.geom_bodyid[g])): None for g, z in low.items() if z <= near}
    return _round(height), _round(width), tuple(feet)


def _with_gains(source: Source, drives: dict[str, Drive], height: float) -> dict[str, Drive]:
    """Fill in the gains, scales and rotors' inertias that the file does not have."""
    model = source.model
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    for j in source.joints:
        if source.joint(j) in drives:
            data.qpos[model.jnt_qposadr[j]] = drives[source.joint(j)].home
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    weight = GRAVITY * float(model.body_mass[source.bodies].sum())
    ids = {source.joint(j): j for j in source.joints}
    kinds = {name: int(model.jnt_type[j]) for name, j in ids.items()}
    dofs = {name: int(model.jnt_dofadr[j]) for name, j in ids.items()}
    loads = {HINGE: weight * height, SLIDE: weight}
    return {
        name: _complete(drive, inertia[dofs[name], dofs[name]], loads[kinds[name]], kinds[name])
        for name, drive in drives.items()
    }


def _complete(drive: Drive, inertia: float, load: float, kind: int) -> Drive:
    """Fill in one drive; `inertia` and `load` are in kg·m² and N·m, of a sliding joint (by its `kind`) in kg and N.

    A scale that the file does not have keeps its direction by its sign: -0.0 turns the direction around.
    """
    changes: dict[str, Any] = {}
    if drive.control == "position":
        stiff = load / SAG if kind == SLIDE else load
        kp = drive.kp or min(HOLDS * stiff, drive.effort / REACH if drive.effort else np.inf)
        rotor = drive.armature or (0.0 if drive.kp else NO_ROTOR)
        damping = max(2 * np.sqrt(kp * (inertia + rotor - drive.armature)), DAMPED * kp)
        spans = (drive.high - drive.low, drive.target_high - drive.target_low)
        span = min(filter(None, spans), default=0.0)
        changes = {
            "kp": kp, "kd": drive.kd or damping, "armature": rotor,
            "scale": drive.scale or (min(SCALE, span / 4) if span else SCALE),
        }  # fmt: skip
    elif drive.control == "velocity":
        changes = {"kd": drive.kd or 0.1 * load, "scale": drive.scale or math.copysign(SPEEDS[kind], drive.scale)}
    elif not drive.scale:
        changes = {"scale": math.copysign(drive.effort or HOLDS * load, drive.scale)}
    found = replace(drive, **changes)
    numbers = {key: value for key, value in vars(found).items() if key != "control"}
    return replace(found, **{key: _round(value) for key, value in numbers.items()})


def _touches_itself(source: Source) -> bool:
    """Return whether any two of the robot's geoms can touch each other by the file's bits."""
    model, touching = source.model, colliding(source)
    kind, like = model.geom_contype[touching], model.geom_conaffinity[touching]
    return bool((kind[:, None] & like[None, :]).any())


def _name(path: Path) -> str:
    name = re.sub(r"[^A-Za-z0-9_-]+", "-", path.stem).strip("-")
    name = name if name[:1].isalpha() else f"robot-{name}"
    return f"{name}-file" if name in KINDS else name


def _round(value: float) -> float:
    """Round to four digits, as robot files are written."""
    return float(f"{value:.4g}")
