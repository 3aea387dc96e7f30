"""Robot files: the settings of a robot whose model is an MJCF or URDF file, as TOML. Loads nothing heavy.

`league robot FILE` writes one, and a person edits it. A unit stands with each setting in the written file.
"""

import json
import re
import tomllib
from dataclasses import MISSING, asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args

from arenas.errors import RobotError

Control = Literal["position", "velocity", "torque"]
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")  # of a kind of robot: part of rosters
MOTION_SIZE = 9  # velocity, rates and the down direction, which proprioception begins with


@dataclass(frozen=True)
class Drive:
    """One driven joint; angles in rad, of sliding joints in m (and N for N·m)."""

    control: Control
    home: float  # position when standing
    scale: float  # per unit of action: rad of the target from home, rad/s of the target, or N·m
    kp: float = 0.0  # N·m/rad, of position targets
    kd: float = 0.0  # N·m·s/rad, of position and velocity targets
    effort: float = 0.0  # N·m at most; 0: no limit
    low: float = 0.0  # range of the joint; both 0: no limit
    high: float = 0.0
    armature: float = 0.0  # kg·m², the motor's inertia seen at the joint
    target_low: float = 0.0  # range of position and velocity targets; both 0: no limit
    target_high: float = 0.0

    @property
    def settings(self) -> dict[str, Any]:
        """Its settings, without a range of targets where there is none, as in robot files of earlier versions."""
        free = () if self.target_low or self.target_high else ("target_low", "target_high")
        return {key: value for key, value in asdict(self).items() if key not in free}


@dataclass(frozen=True)
class RobotFile:
    """All settings of a robot from a file."""

    name: str  # its kind in rosters
    model: str  # the MJCF or URDF file, or package:path for a file in an installed package
    base: str  # the body with the free joint, or the three of a planar base
    height: float  # m, base's origin above the ground when standing
    width: float  # m, diameter of the circle that it covers when standing, in any heading
    fall_height: float  # m, a base below this has fallen
    fall_up: float  # world z of the base's up axis below which it has fallen
    feet: tuple[str, ...]  # bodies that it stands on
    drives: dict[str, Drive]  # by joint, in the order of observations and actions
    passive: tuple[str, ...] = ()  # joints without an actuator, which move freely
    self_contact: bool = True  # its own bodies touch each other
    free_base: bool = False  # the model has no free joint, and the base gets one
    planar: bool = False  # the base moves in the world's x and z alone, and pitches
    ls_iterations: int = 4  # line-search steps of the solver, at least; arenas' own are 4
    contacts: int = 16  # Warp's contact slots for it
    rows: int = 64  # Warp's constraint rows for it
    folder: str = "."  # where `model` is relative to
    file: str = field(default="", compare=False)  # the robot file that it was read from; empty: from none

    @property
    def proprioception_size(self) -> int:
        """Numbers in its proprioception: its motion, and per joint angle, speed and last action."""
        return MOTION_SIZE + 3 * len(self.drives)

    @property
    def identity(self) -> str:
        """All settings that decide how it moves, as text: part of an arena's configuration hash.

        The model decides `planar`, and the arena's scene, which counts too, has `ls_iterations`.
        """
        apart = {"folder", "file", "model", "contacts", "rows", "width", "name", "planar", "ls_iterations"}
        drives = {name: drive.settings for name, drive in self.drives.items()}
        return json.dumps({k: v for k, v in (asdict(self) | {"drives": drives}).items() if k not in apart})


def torque_driven(robot: RobotFile) -> RobotFile:
    """Return the robot with torques for actions, shares of each drive's largest torque; another kind, NAME-torque.

    A robot that has only such drives is returned as it is. Raises RobotError, one line, for a drive without a limit.
    """
    if all(drive.control == "torque" for drive in robot.drives.values()):
        return robot
    for name, drive in robot.drives.items():
        if not drive.effort:
            raise RobotError(f"robot {robot.name}: joint {name} has no largest torque; set effort in its robot file")
    drives = {
        name: replace(drive, control="torque", scale=drive.effort, kp=0.0, kd=0.0, target_low=0.0, target_high=0.0)
        for name, drive in robot.drives.items()
    }
    return replace(robot, name=f"{robot.name}-torque", drives=drives)


def read(path: Path) -> RobotFile:
    """Read a robot file. Raises RobotError, one line that names the file and the setting."""
    try:
        table = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise RobotError(f"cannot read {path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RobotError(f"{path}: not a robot file: {error}") from None
    joints = table.pop("joints", None)
    if not isinstance(joints, dict) or not joints:
        raise RobotError(f"{path}: no [joints]: a robot needs at least one; `league robot FILE` writes them")
    drives = {name: _record(Drive, each, f"{path}: joint {name}") for name, each in joints.items()}
    known = {"drives": drives, "folder": str(path.parent), "file": str(path)}
    found: RobotFile = _record(RobotFile, {**_folded(table), **known}, str(path))
    _check(found, path)
    return found


def written(robot: RobotFile) -> str:
    """Write a robot file as commented TOML that `read` reads back."""
    joints = "\n".join(f"{_text(name)} = {_inline(drive)}" for name, drive in robot.drives.items())
    return f"""\
# A robot of Robot League, written by `league robot`. Edit any value, then run `league robot` on this file to check it.
name = {_text(robot.name)}
model = {_text(robot.model)}  # MJCF or URDF, relative to this file
base = {_text(robot.base)}  # the body that moves freely
free_base = {_text(robot.free_base)}  # true: the model has no free joint, and the base gets one
planar = {_text(robot.planar)}  # true: the model's base slides along x and z and pitches, and does no more
height = {_text(robot.height)}  # m, base above the ground when standing
width = {_text(robot.width)}  # m, diameter of the circle that it covers
feet = {_text(list(robot.feet))}  # bodies that it stands on
passive = {_text(list(robot.passive))}  # joints without an actuator
self_contact = {_text(robot.self_contact)}  # its own bodies touch each other
ls_iterations = {robot.ls_iterations}  # line-search steps of the solver: 10 or more if its physics becomes unstable

[fall]
height = {_text(robot.fall_height)}  # m: a base below this has fallen
up = {_text(robot.fall_up)}  # world z of its up axis: below this it has fallen

[buffers]  # Warp's, per robot
contacts = {robot.contacts}
rows = {robot.rows}

# control: position (target = home + scale * action), velocity (target = scale * action), torque (scale * action).
# rad, rad/s, N·m; kp N·m/rad; kd N·m·s/rad; effort: the most torque, 0: no limit; low, high: range, both 0: no limit;
# armature kg·m²; target_low, target_high: range of position and velocity targets, left out: no limit.
[joints]
{joints}
"""


def _folded(table: dict[str, Any]) -> dict[str, Any]:
    """Return the table with the keys of [fall] and [buffers] as fields."""
    fall, buffers = (dict(table.pop(name, None) or {}) for name in ("fall", "buffers"))
    return table | {f"fall_{key}": value for key, value in fall.items()} | buffers


def _record(cls: Any, table: Any, where: str) -> Any:
    """Build a dataclass from plain values, each checked by the type of its field."""
    if not isinstance(table, dict):
        raise RobotError(f'{where}: expected a table such as {{ control = "position", home = 0.0, scale = 0.5 }}')
    known = {field.name: field for field in fields(cls)}
    for key in table:
        if key not in known:
            raise RobotError(f"{where}: unknown setting {key}; known are {', '.join(known)}")
    missing = [name for name, field in known.items() if name not in table and field.default is MISSING]
    if missing:
        raise RobotError(f"{where}: {missing[0]} is missing")
    return cls(**{key: _value(known[key].type, value, f"{where}: {key}") for key, value in table.items()})


def _value(kind: Any, value: Any, where: str) -> Any:
    if kind is float and type(value) in (int, float) and abs(value) < 1e9:
        return float(value)
    if kind is int and type(value) is int and value > 0:
        return value
    if kind in (bool, str) and type(value) is kind:
        return value
    if kind == tuple[str, ...] and isinstance(value, list) and all(isinstance(each, str) for each in value):
        return tuple(value)
    if kind is Control and value in get_args(Control):
        return value
    if kind == dict[str, Drive]:
        return value
    expected = {float: "a number", int: "a whole number from 1", bool: "true or false", str: "text in quotes"}
    names = f"one of {', '.join(get_args(Control))}" if kind is Control else "a list of names"
    raise RobotError(f"{where} = {value!r}: expected {expected.get(kind, names)}")


def _check(robot: RobotFile, path: Path) -> None:
    if not NAME.fullmatch(robot.name):
        raise RobotError(f"{path}: name = {robot.name!r}: use a letter, then letters, digits, - and _")
    for name, drive in robot.drives.items():
        if drive.low > drive.high:
            raise RobotError(f"{path}: joint {name}: low = {drive.low:g} is above high = {drive.high:g}")
        if drive.target_low > drive.target_high:
            lowest, highest = f"target_low = {drive.target_low:g}", f"target_high = {drive.target_high:g}"
            raise RobotError(f"{path}: joint {name}: {lowest} is above {highest}")
        if min(drive.kp, drive.kd, drive.effort, drive.armature) < 0:
            raise RobotError(f"{path}: joint {name}: kp, kd, effort and armature must be at least 0")
        if (drive.control == "position" and drive.kp == 0) or (drive.control == "velocity" and drive.kd == 0):
            gain = "kp" if drive.control == "position" else "kd"
            raise RobotError(f"{path}: joint {name}: control = {drive.control!r} needs {gain} above 0")
    for key in ("height", "width"):
        if getattr(robot, key) <= 0:
            raise RobotError(f"{path}: {key} = {getattr(robot, key):g}: must be above 0 m")


def _inline(drive: Drive) -> str:
    return "{ " + ", ".join(f"{key} = {_text(value)}" for key, value in drive.settings.items()) + " }"


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return repr(float(f"{value:.4g}"))
    return json.dumps(value, ensure_ascii=False)
