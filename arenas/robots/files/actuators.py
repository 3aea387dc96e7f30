"""A file's actuators as drives, one for each joint: position, velocity or torque; position where it has none."""

import math
from dataclasses import replace

import mujoco

from arenas.errors import RobotError
from arenas.robots.files.robot_file import Control, Drive
from arenas.robots.files.source import Source

JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
FIXED, NONE, AFFINE = (
    int(each) for each in (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)
)
DIRECT = tuple(
    int(each) for each in (mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
)


def drives_of(source: Source, control: Control | None, passive: tuple[str, ...]) -> dict[str, Drive]:
    """Return the drives by joint, in the file's order of joints; gains and homes that it lacks are 0.

    Without any actuator all joints get position targets; `control` is given to all. Raises RobotError, one line, for
    a joint without an actuator that is not `passive`, and for actuators that move no joint.
    """
    model, found = source.model, _found(source)
    names = [source.joint(j) for j in source.joints]
    for name in passive:
        if name not in names:
            raise RobotError(f"{source.path}: no joint {name} for --passive; it has {', '.join(names)}")
    free = [name for name in names if found and name not in found]
    if unsaid := [name for name in free if name not in passive]:
        told = f"joint {unsaid[0]} has" if len(unsaid) == 1 else f"joints {', '.join(unsaid)} have"
        raise RobotError(
            f"{source.path}: {told} no actuator, while others have: add one, or let them move freely:"
            f" league robot {source.path} --passive {','.join(each for each in names if each in (*free, *passive))}"
        )
    drives: dict[str, Drive] = {}
    for j in source.joints:
        name = source.joint(j)
        if name in passive:
            continue
        drive = found.get(name, Drive("position", 0.0, 0.0))
        if control is not None and control != drive.control:
            drive = Drive(control, 0.0, 0.0, effort=drive.effort)
        low, high = map(float, model.jnt_range[j]) if model.jnt_limited[j] else (0.0, 0.0)
        effort = drive.effort
        if model.jnt_actfrclimited[j]:
            most = float(max(abs(model.jnt_actfrcrange[j])))
            effort = min(effort, most) if effort else most
        rotor = float(model.dof_armature[model.jnt_dofadr[j]])
        drives[name] = replace(drive, low=low, high=high, effort=effort, armature=rotor)
    if not drives:
        raise RobotError(f"{source.path}: all of its joints are passive: a robot needs one that it can move")
    return drives


def _found(source: Source) -> dict[str, Drive]:
    """Return the drive of each joint that the robot's actuators move."""
    model, found = source.model, dict[str, Drive]()
    for i in range(model.nu):
        actuator, joint = model.actuator(i).name or str(i), int(model.actuator_trnid[i, 0])
        if model.actuator_trntype[i] not in JOINTS:
            kind = mujoco.mjtTrn(int(model.actuator_trntype[i])).name.removeprefix("mjTRN_").lower()
            raise RobotError(f"{source.path}: actuator {actuator} moves a {kind}; only those of joints can be read")
        if joint not in source.joints:
            continue
        name, drive = source.joint(joint), _drive(source, i, actuator)
        found[name] = _merged(source, name, found[name], drive) if name in found else drive
    return found


def _drive(source: Source, i: int, actuator: str) -> Drive:
    """Return one actuator as a drive; a gear turns units of the motor into those of the joint.

    Where a gear or gain turns the direction around, a motor's or velocity's scale is negative, also as -0.0.
    """
    model = source.model
    gain, bias, gear = float(model.actuator_gainprm[i, 0]), model.actuator_biasprm[i], float(model.actuator_gear[i, 0])
    most = float(max(abs(model.actuator_ctrlrange[i]))) if model.actuator_ctrllimited[i] else 0.0
    force = abs(gear) * float(max(abs(model.actuator_forcerange[i]))) if model.actuator_forcelimited[i] else 0.0
    plain = model.actuator_gaintype[i] == FIXED and model.actuator_dyntype[i] in DIRECT
    if plain and model.actuator_biastype[i] == NONE:
        torque = abs(gain * gear) * most
        scale = math.copysign(torque or force, gain * gear)
        return Drive("torque", 0.0, scale, effort=min(filter(None, (torque, force)), default=0.0))
    plain &= bias[0] == 0  # a force without a command is none of a drive's settings
    if plain and model.actuator_biastype[i] == AFFINE and bias[1] < 0 and abs(bias[1] + gain) < 1e-6 * gain:
        low, high = _target_range(model, i, 1 / gear)
        return Drive(
            "position", 0.0, 0.0, kp=gain * gear**2, kd=float(-bias[2]) * gear**2, effort=force,
            target_low=low, target_high=high,
        )  # fmt: skip
    if plain and model.actuator_biastype[i] == AFFINE and bias[1] == 0 and bias[2] < 0:
        unit = gain / float(-bias[2]) / gear
        low, high = _target_range(model, i, unit)
        return Drive(
            "velocity", 0.0, most * unit, kd=float(-bias[2]) * gear**2, effort=force, target_low=low, target_high=high
        )
    joint = source.joint(int(model.actuator_trnid[i, 0]))
    raise RobotError(
        f"{source.path}: actuator {actuator} of joint {joint} is no motor, position or velocity actuator; write it as"
        " one of these"
    )


def _target_range(model: mujoco.MjModel, i: int, unit: float) -> tuple[float, float]:
    """Return the range of an actuator's targets at the joint, both 0 without one; `unit` is a command of 1 there."""
    if not model.actuator_ctrllimited[i]:
        return 0.0, 0.0
    low, high = sorted(float(each) * unit for each in model.actuator_ctrlrange[i])
    return low, high


def _merged(source: Source, joint: str, one: Drive, other: Drive) -> Drive:
    """Return the drive of two actuators on a joint, which are PD as position and velocity. Raises RobotError, else."""
    by_control = {drive.control: drive for drive in (other, one)}
    if set(by_control) == {"position", "velocity"}:
        position, velocity = by_control["position"], by_control["velocity"]
        return replace(position, kd=position.kd + velocity.kd)
    kinds = f"{one.control} and {other.control}"
    raise RobotError(
        f"{source.path}: joint {joint} has two actuators ({kinds}), which do not add up to one: keep one of them"
        " (position and velocity together are read as PD)"
    )
