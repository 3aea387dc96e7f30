"""Construction of a robot from a file: a new body with the file's masses, joints and shapes, and our actuators.

Nothing but numbers is taken over, so that recordings need no mesh, and the same body stands in every scene. The frame
of the base is turned so that it is upright in the standing pose.
"""

import difflib
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from arenas.errors import RobotError
from arenas.robots.files.robot_file import Drive, RobotFile
from arenas.robots.files.source import MESH, PLANE, Source
from arenas.robots.robot import Colour

# Bits as in arenas.scene.props: 1 the ground, 2 bodies. A file's own bits fit its own scene alone: two of gymnasium's
# ants would pass through each other.
TOUCHES = {"contype": 2, "conaffinity": 3, "group": 3}
DRAWN = {"contype": 0, "conaffinity": 0, "group": 1}
STIFF = (0.998, 0.998, 0.001, 0.5, 2.0)  # solimp of feet, as ANYmal's: with MuJoCo's own they creep apart
USUAL = (0.9, 0.95, 0.001, 0.5, 2.0)  # MuJoCo's own


def build_body(source: Source, robot: RobotFile, colour: Colour) -> mujoco.MjSpec:
    """Build the robot as one body under the world, with one actuator for each drive, in their order."""
    spec, model = mujoco.MjSpec(), source.model
    spec.compiler.degree = False
    made: dict[int, mujoco.MjsBody] = {}
    upright = upright_turn(source)
    for i in source.bodies:
        parent = made.get(int(model.body_parentid[i]))
        turn = upright if i == source.base else None
        place = {"pos": [0, 0, robot.height]} if parent is None else _placed(model.body_pos[i], model.body_quat[i])
        if parent is not None and int(model.body_parentid[i]) == source.base:
            place = _placed(*_turned(upright, model.body_pos[i], model.body_quat[i]))
        made[i] = (parent or spec.worldbody).add_body(name=source.body(i), **place, **_inertia(model, i, turn))
        if parent is None:
            _add_base(made[i], source.planar)
        _add_joints(source, robot, made[i], i)
        _add_geoms(source, robot, made[i], i, turn, colour)
    _add_actuators(spec, robot)
    _add_excludes(spec, source, robot, made)
    return spec


def _add_base(body: mujoco.MjsBody, planar: bool) -> None:
    """Add the joints of the base: a free one, or slides along x and z and a hinge about y."""
    if not planar:
        body.add_freejoint(name="base")
        return
    kinds = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
    for name, kind, axis in zip(("base_x", "base_z", "base_pitch"), kinds, PLANE, strict=True):
        body.add_joint(name=name, type=kind, axis=axis)


def upright_turn(source: Source) -> np.ndarray:
    """Return the quaternion (4,) of the base in the standing pose without its heading."""
    model = source.model
    quat = model.body_quat[source.base]
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    heading = np.arctan2(matrix[3], matrix[0])
    back = np.array([np.cos(heading / 2), 0, 0, -np.sin(heading / 2)])
    turn = np.empty(4)
    mujoco.mju_mulQuat(turn, back, quat)
    return turn


def colliding(source: Source) -> list[int]:
    """Return the ids of the robot's geoms that touch anything in the file."""
    model = source.model
    paired = {int(i) for pair in zip(model.pair_geom1, model.pair_geom2, strict=True) for i in pair}
    mine = [i for i in range(model.ngeom) if model.geom_bodyid[i] in source.bodies]
    return [i for i in mine if model.geom_contype[i] or model.geom_conaffinity[i] or i in paired]


def _placed(pos: np.ndarray, quat: np.ndarray) -> dict[str, Any]:
    return {"pos": pos, "quat": quat}


def _turned(turn: np.ndarray | None, pos: np.ndarray, quat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a place in a frame that is turned by a quaternion; unchanged without one."""
    if turn is None:
        return pos, quat
    at, rotated = np.empty(3), np.empty(4)
    mujoco.mju_rotVecQuat(at, pos, turn)
    mujoco.mju_mulQuat(rotated, turn, quat)
    return at, rotated


def _inertia(model: mujoco.MjModel, i: int, turn: np.ndarray | None) -> dict[str, Any]:
    ipos, iquat = _turned(turn, model.body_ipos[i], model.body_iquat[i])
    mass, inertia = float(model.body_mass[i]), model.body_inertia[i]
    return {
        "mass": mass, "ipos": ipos, "iquat": iquat, "inertia": inertia, "explicitinertial": mass > 0,
        "gravcomp": float(model.body_gravcomp[i]),
    }  # fmt: skip


def _add_joints(source: Source, robot: RobotFile, body: mujoco.MjsBody, i: int) -> None:
    model = source.model
    for j in source.joints:
        if model.jnt_bodyid[j] != i:
            continue
        name, dof = source.joint(j), int(model.jnt_dofadr[j])
        drive = robot.drives.get(name)
        low, high = (drive.low, drive.high) if drive else model.jnt_range[j]
        limited = bool(low or high) if drive else bool(model.jnt_limited[j])
        effort = drive.effort if drive else 0.0
        body.add_joint(
            name=name, type=model.jnt_type[j], axis=model.jnt_axis[j], pos=model.jnt_pos[j],
            limited=limited, range=[low, high] if limited else [0, 0],
            ref=float(model.qpos0[model.jnt_qposadr[j]]),
            springref=float(model.qpos_spring[model.jnt_qposadr[j]]),
            stiffness=_first(model.jnt_stiffness[j]), damping=_first(model.dof_damping[dof]),
            armature=drive.armature if drive else float(model.dof_armature[dof]),
            frictionloss=float(model.dof_frictionloss[dof]),
            solref_friction=model.dof_solref[dof], solimp_friction=model.dof_solimp[dof],
            solref_limit=model.jnt_solref[j], solimp_limit=model.jnt_solimp[j], margin=float(model.jnt_margin[j]),
            actgravcomp=bool(model.jnt_actgravcomp[j]),
            actfrclimited=effort > 0, actfrcrange=[-effort, effort],
        )  # fmt: skip


def _add_geoms(
    source: Source, robot: RobotFile, body: mujoco.MjsBody, i: int, turn: np.ndarray | None, colour: Colour
) -> None:
    """Add a body's shapes. Shapes that touch are drawn too where the body has no others that a mesh replaced."""
    model, shapes, touching = source.model, source.shapes, colliding(source)
    own = [g for g in range(model.ngeom) if model.geom_bodyid[g] == i]
    heaviest = max(source.bodies, key=lambda body: model.body_mass[body])  # a humanoid's base is its small pelvis
    drawn = [g for g in own if g not in touching and (model.geom_type[g] != MESH or not set(own) & set(touching))]
    for g in own:
        if g not in touching and g not in drawn:
            continue
        pos, quat = _turned(turn, shapes.geom_pos[g], shapes.geom_quat[g])
        rgba = colour if i in (source.base, heaviest) else _colour(model, g)
        touch = {} if g not in touching else _contact(model, g, body.name in robot.feet)
        bits = DRAWN if g not in touching else TOUCHES | ({} if drawn else {"group": 0})
        body.add_geom(
            name=model.geom(g).name, type=shapes.geom_type[g], size=shapes.geom_size[g], pos=pos, quat=quat,
            rgba=rgba, mass=0, **bits, **touch,
        )  # fmt: skip


def _contact(model: mujoco.MjModel, g: int, foot: bool) -> dict[str, Any]:
    """Return the contact of a geom as in the file; feet decide their own friction on our smooth ground."""
    solimp = model.geom_solimp[g]
    return {
        "friction": model.geom_friction[g],
        "condim": max(3, int(model.geom_condim[g])) if foot else int(model.geom_condim[g]),
        "solref": model.geom_solref[g],
        "solimp": STIFF if foot and np.allclose(solimp, USUAL) else solimp,
        "priority": max(int(foot), int(model.geom_priority[g])),
    }


def _colour(model: mujoco.MjModel, g: int) -> np.ndarray:
    material = model.geom_matid[g]
    rgba = np.array(model.mat_rgba[material] if material >= 0 else model.geom_rgba[g])
    return np.append(rgba[:3], 1.0)


def _add_actuators(spec: mujoco.MjSpec, robot: RobotFile) -> None:
    for name, drive in robot.drives.items():
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        if drive.control == "position":
            motor.set_to_position(kp=drive.kp, kv=drive.kd)
        elif drive.control == "velocity":
            motor.set_to_velocity(kv=drive.kd)
        else:
            motor.set_to_motor()


def _add_excludes(spec: mujoco.MjSpec, source: Source, robot: RobotFile, made: dict[int, mujoco.MjsBody]) -> None:
    """Let bodies pass through each other as in the file, where they overlap in its pose, or all if so set."""
    touching = {int(source.model.geom_bodyid[g]) for g in colliding(source)}
    pairs = {tuple(divmod(int(each), 1 << 16)) for each in source.model.exclude_signature}
    if robot.self_contact:
        pairs |= overlaps(source, robot)
    else:
        pairs |= {(a, b) for a in touching for b in touching if a < b}
    for a, b in sorted({(min(pair), max(pair)) for pair in pairs}):
        if a in made and b in made:
            spec.add_exclude(bodyname1=made[a].name, bodyname2=made[b].name)


def overlaps(source: Source, robot: RobotFile) -> set[tuple[int, int]]:
    """Return the pairs of the robot's bodies (ids) that would touch each other in the standing pose."""
    shapes = source.shapes
    data = home_pose(source, robot.drives)
    shapes = data.model
    touching, found = colliding(source), set()
    for n, one in enumerate(touching):
        for other in touching[n + 1 :]:
            a, b = int(shapes.geom_bodyid[one]), int(shapes.geom_bodyid[other])
            if shapes.body_weldid[a] == shapes.body_weldid[b]:
                continue
            reach = shapes.geom_rbound[one] + shapes.geom_rbound[other]
            if np.linalg.norm(data.geom_xpos[one] - data.geom_xpos[other]) > reach:
                continue
            if mujoco.mj_geomDistance(shapes, data, one, other, 0.01, None) <= 0.0:
                found.add((a, b))
    return found


def home_pose(source: Source, drives: dict[str, Drive]) -> mujoco.MjData:
    """Return the shapes of the file with the drives at home, the base at the origin of the world."""
    model = source.shapes
    data = mujoco.MjData(model)
    root = model.jnt_qposadr[model.body_jntadr[source.base]]
    if source.planar:  # its zeros are the file's, so they are moved to put the base at the origin
        data.qpos[root : root + 3] = model.qpos0[root : root + 3] - [*model.body_pos[source.base][[0, 2]], 0]
    else:
        data.qpos[root : root + 7] = [0, 0, 0, *upright_turn(source)]
    for j in source.joints:
        drive = drives.get(source.joint(j))
        if drive is not None:
            data.qpos[model.jnt_qposadr[j]] = drive.home
    mujoco.mj_kinematics(model, data)
    return data


def _first(values: Any) -> float:
    """Return a coefficient of a joint, the linear one of a polynomial."""
    return float(np.ravel(values)[0])


def check_names(source: Source, robot: RobotFile) -> None:
    """Raise RobotError, one line with the robot file, its key and the possible names, for names not in the model."""
    bodies, joints = [source.body(i) for i in source.bodies], [source.joint(j) for j in source.joints]
    where = robot.file or f"robot {robot.name}"
    for key, what, names, known in (
        ("base", "body", [robot.base], bodies[:1]), ("feet", "body", robot.feet, bodies),
        ("[joints]", "joint", robot.drives, joints), ("passive", "joint", robot.passive, joints),
    ):  # fmt: skip
        for name in names:
            if name not in known:
                raise RobotError(f"{where}: {key}: {source.path} has no {what} {name!r}: {_possible(name, known)}")
    for name in joints:
        if name not in robot.drives and name not in robot.passive:
            raise RobotError(f"{where}: joint {name} of {source.path} is missing in [joints]; or list it as passive")


def _possible(name: str, known: Sequence[str]) -> str:
    """Return the names that one may have been meant to be: those close to it, and all that there are."""
    near = difflib.get_close_matches(name, known, 2)
    hint = f"did you mean {' or '.join(near)}? " if near else ""
    return f"{hint}(possible: {', '.join(known)})"
