"""Reading of MJCF and URDF files: the compiled model, and the one robot in it. All else in the file is left out."""

import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from arenas.errors import RobotError

ELONGATED = 1.6  # a mesh so much longer than wide is fitted by a capsule, else by a box
MESH, FREE = int(mujoco.mjtGeom.mjGEOM_MESH), int(mujoco.mjtJoint.mjJNT_FREE)
BALL, SLIDE, HINGE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{name}")) for name in ("BALL", "SLIDE", "HINGE"))
PLANE = ((1, 0, 0), (0, 0, 1), (0, 1, 0))  # axes of the joints of a planar base, as in gymnasium's hopper
# Attributes of numbers, in MJCF and URDF: MuJoCo takes a NaN in them for a number that is not given.
NUMBERS = {
    "mass", "density", "inertia", "diaginertia", "fullinertia", "pos", "quat", "axisangle", "euler", "xyaxes", "zaxis",
    "size", "fromto", "axis", "range", "ref", "springref", "stiffness", "damping", "frictionloss", "armature", "margin",
    "friction", "gear", "kp", "kv", "ctrlrange", "forcerange", "actuatorfrcrange", "gainprm", "biasprm", "qpos",
    "value", "xyz", "rpy", "ixx", "ixy", "ixz", "iyy", "iyz", "izz", "lower", "upper", "effort", "velocity", "radius",
    "length",
}  # fmt: skip
ADDED_JOINT = "free base"  # of a base that the file fixes to the world


@dataclass(frozen=True)
class Source:
    """A compiled file and the robot in it. Meshes have become boxes and capsules in `shapes`, of the same geom ids."""

    path: Path
    model: mujoco.MjModel  # masses, joints, actuators
    shapes: mujoco.MjModel  # geoms, none of them a mesh
    base: int  # body id
    bodies: list[int]  # ids of the robot's bodies, parents first
    joints: list[int]  # ids of its joints except those of its base
    left_out: list[str]  # what the robot does without, in words
    named: int  # bodies, joints and geoms that had no name
    planar: bool = False  # its base slides along the world's x and z and pitches, instead of moving freely

    def joint(self, i: int) -> str:
        """Return the name of a joint."""
        return self.model.joint(i).name

    def body(self, i: int) -> str:
        """Return the name of a body."""
        return self.model.body(i).name


def read_source(path: Path, free_base: bool = False) -> Source:
    """Read a file. With `free_base` a base that is fixed to the world becomes free, as that of a URDF always does.

    Raises RobotError, one line that names the file and the part, for a file that holds no single robot.
    """
    _check_numbers(path)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except (ValueError, OSError) as error:
        raise RobotError(f"{path}: {_flat(error)}") from None
    spec.compiler.discardvisual = False
    urdf = path.suffix == ".urdf" or "<robot" in path.read_text("utf-8", errors="replace")[:5000]
    left_out = [
        f"{_count(len(gone), 'mesh', 'meshes')} without a file" for gone in [_drop_missing_meshes(spec, path)] if gone
    ]
    if urdf or free_base:
        _free(spec, path)
    named = _name(spec)
    model = _compiled(spec, path)
    base = _base(model, path)
    bodies = [i for i in range(model.nbody) if model.body_rootid[i] == base and i > 0]
    joints = [j for j in range(model.njnt) if model.jnt_bodyid[j] in bodies and model.jnt_bodyid[j] != base]
    _check(model, path, joints)
    left_out += list(_left_out(spec, model, base))
    planar = bool(model.jnt_type[model.body_jntadr[base]] != FREE)
    return Source(path, model, _shapes(spec, model, path), base, bodies, joints, left_out, named, planar)


def _check_numbers(path: Path) -> None:
    """Raise RobotError for a NaN in a file; files that it includes are not looked at."""
    try:
        root = ElementTree.fromstring(path.read_bytes())
    except (OSError, ElementTree.ParseError):
        return  # MuJoCo's own reader says what is wrong, if it is no more lenient
    parents = {child: part for part in root.iter() for child in part}
    for part in root.iter():
        for key, value in part.attrib.items():
            if key in NUMBERS and any(each.lower().lstrip("+-") == "nan" for each in value.split()):
                where = part.get("name") or f"of {parents[part].get('name', parents[part].tag)}"
                raise RobotError(f'{path}: {part.tag} {where} has {key}="{value}": give numbers, or leave {key} out')


def _drop_missing_meshes(spec: mujoco.MjSpec, path: Path) -> list[str]:
    """Remove the geoms of meshes whose files are missing, if they are only drawn; return these meshes' names."""
    folder = Path(spec.modelfiledir or path.parent) / (spec.compiler.meshdir or "")
    gone = {}
    for mesh in list(spec.meshes):
        file = Path(mesh.file.removeprefix("package://")) if mesh.file else None
        if file is None or any((folder / each).is_file() for each in (file, file.name)) or file.is_file():
            continue
        gone[mesh.name or file.stem] = file
    for geom in list(spec.geoms):
        if geom.meshname not in gone:
            continue
        if geom.contype or geom.conaffinity or not geom.parent.explicitinertial:
            needs = "touches" if geom.contype or geom.conaffinity else "gives the mass"
            raise RobotError(
                f"{path}: body {geom.parent.name} {needs} by the mesh {gone[geom.meshname]}, which is not in {folder}"
            )
        spec.delete(geom)
    for mesh in list(spec.meshes):
        if mesh.name in gone or (mesh.file and Path(mesh.file).stem in gone):
            spec.delete(mesh)
    return list(gone)


def _free(spec: mujoco.MjSpec, path: Path) -> None:
    """Add a free joint to the only body under the world, unless one has it already; keyframes keep the joints' pose."""
    tops = spec.worldbody.bodies
    if any(int(joint.type) == FREE for body in tops for joint in body.joints):
        return
    if len(tops) != 1:
        names = ", ".join(body.name or "unnamed" for body in tops) or "none"
        raise RobotError(f"{path}: a robot is one body under the world with all others in it; there are: {names}")
    sizes = {FREE: 7, BALL: 4}
    before = sum(sizes.get(int(joint.type), 1) for joint in spec.joints)
    tops[0].add_freejoint(name=ADDED_JOINT)
    for key in spec.keys:
        if len(key.qpos) == before:  # MuJoCo would give its first numbers to the base
            key.qpos = [*tops[0].pos, 1.0, 0.0, 0.0, 0.0, *key.qpos]


def _name(spec: mujoco.MjSpec) -> int:
    """Give names to bodies, joints and geoms without one; return how many there were."""
    count = 0
    for what, parts in (("body", spec.bodies[1:]), ("joint", spec.joints), ("geom", spec.geoms)):
        taken = {part.name for part in parts}
        for number, part in enumerate(parts):
            if part.name:
                continue
            stem = f"{what}{number}" if what == "body" else f"{part.parent.name}_{what}"
            part.name = next(name for name in _tries(stem) if name not in taken)
            taken.add(part.name)
            count += 1
    return count


def _tries(stem: str) -> Iterator[str]:
    yield stem
    yield from (f"{stem}{i}" for i in range(1, 10_000))


def _compiled(spec: mujoco.MjSpec, path: Path) -> mujoco.MjModel:
    try:
        with warnings.catch_warnings():  # of attributes that MuJoCo will drop: the file is a stranger's
            warnings.simplefilter("ignore", UserWarning)
            return spec.compile()
    except ValueError as error:
        raise RobotError(f"{path}: {_flat(error)}") from None


def _base(model: mujoco.MjModel, path: Path) -> int:
    free = [int(model.jnt_bodyid[j]) for j in range(model.njnt) if model.jnt_type[j] == FREE]
    if len(free) == 1:
        return free[0]
    if free:
        names = ", ".join(model.body(i).name for i in free)
        raise RobotError(f"{path}: {len(free)} bodies have a free joint ({names}): a robot has one")
    tops = [i for i in range(1, model.nbody) if model.body_parentid[i] == 0]
    planar = [i for i in tops if _moves_in_a_plane(model, i)]
    if len(planar) == 1:
        return planar[0]
    fixed = [model.body(i).name for i in tops]
    held = f"body {', '.join(fixed)}" if fixed else "it has no body, and nothing"
    raise RobotError(
        f"{path}: no body has a free joint: {held} is fixed to the world; add <freejoint/> to it, or --free-base"
    )


def _moves_in_a_plane(model: mujoco.MjModel, body: int) -> bool:
    """Return whether a body has three joints: slides along the world's x and z, then a hinge about y."""
    first = int(model.body_jntadr[body])
    kinds = [int(kind) for kind in model.jnt_type[first : first + model.body_jntnum[body]]]
    upright = np.allclose(model.body_quat[body], [1, 0, 0, 0])
    return upright and kinds == [SLIDE, SLIDE, HINGE] and np.allclose(model.jnt_axis[first : first + 3], PLANE)


def _check(model: mujoco.MjModel, path: Path, joints: list[int]) -> None:
    """Raise RobotError for parts that cannot be taken over."""
    if not joints:
        raise RobotError(f"{path}: body {model.body(1).name} has no joints that a motor could move")
    for j in joints:
        if model.jnt_type[j] == BALL:
            raise RobotError(f"{path}: joint {model.joint(j).name} is a ball joint; only hinges and slides can be read")
    if model.neq:
        raise RobotError(
            f"{path}: equality {model.equality(0).name or 0} closes a loop or couples joints; such models cannot be"
            " read yet"
        )


def _left_out(spec: mujoco.MjSpec, model: mujoco.MjModel, base: int) -> Iterator[str]:
    floor = int(np.sum(model.body_rootid[model.geom_bodyid] != base))
    if floor:
        yield f"{_count(floor, 'geom')} of the scene"
    for count, what in (
        (len(spec.lights), "light"), (len(spec.cameras), "camera"),
        (len(spec.sensors), "sensor"), (len(spec.tendons), "tendon"), (len(spec.sites), "site"),
        (model.nflex, "flex part"),
    ):  # fmt: skip
        if count:
            yield _count(count, what)
    if slow := int(np.sum(model.actuator_dyntype != int(mujoco.mjtDyn.mjDYN_NONE))):
        yield f"the activation dynamics of {_count(slow, 'actuator')}, which act at once here"
    motors = (model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_NONE)) & (model.actuator_ctrllimited == 1)
    low, high = model.actuator_ctrlrange.reshape(-1, 2).T
    if lopsided := int(np.sum(motors & (abs(low + high) > 1e-6 * (high - low)))):
        yield f"the unequal control range of {_count(lopsided, 'motor')}: both ways as the wider one"
    yield from _of_contact_and_base(model, base)
    forced = [range_ for limited, range_ in zip(model.actuator_forcelimited, model.actuator_forcerange, strict=True)
              if limited]  # fmt: skip
    forced += [
        range_ for limited, range_ in zip(model.jnt_actfrclimited, model.jnt_actfrcrange, strict=True) if limited
    ]
    if unequal := sum(abs(low + high) > 1e-6 * (high - low) for low, high in forced):
        yield f"{_count(unequal, 'unequal range')} of force: both ways as the wider one"


def _of_contact_and_base(model: mujoco.MjModel, base: int) -> Iterator[str]:
    """Yield, in words, the settings of contacts and of the base's joints that the robot does without."""
    mine = model.body_rootid[model.geom_bodyid] == base
    touching = mine & ((model.geom_contype | model.geom_conaffinity) != 0)
    if margins := int(np.sum(touching & ((model.geom_margin != 0) | (model.geom_gap != 0)))):
        yield f"the margin of {_count(margins, 'geom')}, which touch at a distance of 0 here"
    if mixes := int(np.sum(touching & (model.geom_solmix != 1))):
        yield f"solmix of {_count(mixes, 'geom')}, all of which weigh alike here"
    at = slice(model.body_dofadr[base], model.body_dofadr[base] + model.body_dofnum[base])
    joints = slice(model.body_jntadr[base], model.body_jntadr[base] + model.body_jntnum[base])
    held = [model.dof_damping[at], model.dof_armature[at], model.dof_frictionloss[at], model.jnt_stiffness[joints]]
    if any(np.any(each) for each in held):
        yield "damping, armature, friction and springs of the base, which moves freely"


def _count(number: int, one: str, many: str | None = None) -> str:
    return f"{number} {one if number == 1 else many or one + 's'}"


def _shapes(spec: mujoco.MjSpec, model: mujoco.MjModel, path: Path) -> mujoco.MjModel:
    """Compile the file again with boxes in the place of meshes, or capsules where a mesh is long."""
    if not (model.geom_type == MESH).any():
        return model
    fitted = spec.copy()
    meshes = [geom for geom in fitted.geoms if int(geom.type) == MESH]
    for geom in meshes:
        geom.type = mujoco.mjtGeom.mjGEOM_BOX
    boxes = _compiled(fitted, path)
    for geom in meshes:
        half = np.sort(boxes.geom(geom.name).size)
        if half[2] > ELONGATED * half[1] and half[1] < ELONGATED * half[0]:
            geom.type = mujoco.mjtGeom.mjGEOM_CAPSULE
    return _compiled(fitted, path)


def _flat(error: BaseException) -> str:
    return " ".join(str(error).split())
