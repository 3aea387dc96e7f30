"""Places of robots from files: files of a user, and models in wheels of others with settings of ours. Light.

Each file in `shipped/` is a robot file whose model lies in a wheel; no model is part of this package.
"""

import importlib.util
from functools import cache
from pathlib import Path
from typing import NamedTuple

from arenas.errors import RobotError
from arenas.robots.files import robot_file as files
from arenas.robots.files.robot_file import RobotFile

MODELS = (".xml", ".mjcf", ".urdf")
SUFFIXES = (*MODELS, ".toml")
SHIPPED = Path(__file__).parent / "shipped"


class Wheel(NamedTuple):
    """A package of others that ships models of robots."""

    install: str  # the command that brings it
    licence: str  # of the models


WHEELS = {
    "gymnasium": Wheel("pip install 'robot-league[robots]'", "MIT"),
    # Their requirements pin other versions of MuJoCo than the league's, and only the model files are read.
    "mjlab": Wheel("pip install --no-deps mjlab", "Apache-2.0; Unitree's models BSD-3-Clause"),
    "rcsssmj": Wheel("pip install --no-deps rcsssmj", "T1 Apache-2.0, K1 BSD-3-Clause"),
}


@cache
def shipped() -> tuple[str, ...]:
    """Return the names of the robots whose models come in wheels, sorted."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.toml")))


def robot_file(name: str) -> RobotFile:
    """Return the settings of a robot: of a file of a user, or of a robot whose model comes in a wheel.

    A model without a robot file beside it gets the settings that `league robot` would write. Raises RobotError.
    """
    if name in shipped():
        return _read(SHIPPED / f"{name}.toml", 0)
    path = Path(name)
    if path.suffix not in SUFFIXES:
        raise RobotError(f"{name}: a robot is an MJCF (.xml) or URDF (.urdf) file, a robot file (.toml) or a name")
    if not path.is_file():
        raise RobotError(f"no file {name}: give an MJCF (.xml) or URDF (.urdf) file, or a robot file (.toml)")
    if path.suffix in MODELS:
        beside = path.with_suffix(".toml")
        if not beside.is_file():
            return _derived(path, path.stat().st_mtime_ns)
        path = beside
    return _read(path, path.stat().st_mtime_ns)


def model_path(robot: RobotFile) -> Path:
    """Return the file of a robot's model. Raises RobotError, one line with the command that brings it, if missing."""
    package, colon, inside = robot.model.partition(":")
    if not colon or package not in WHEELS:
        path = Path(robot.folder) / robot.model
        if not path.is_file():
            raise RobotError(f"robot {robot.name}: there is no model {path}; set model in its robot file")
        return path
    spec = importlib.util.find_spec(package)
    found = [Path(folder) / inside for folder in (spec.submodule_search_locations or () if spec else ())]
    for path in found:
        if path.is_file():
            return path
    wheel = WHEELS[package]
    raise RobotError(f"robot {robot.name}: its model comes with the package {package}: {wheel.install}")


@cache
def _read(path: Path, changed: int) -> RobotFile:
    """Read a robot file, again only after it `changed`."""
    return files.read(path)


@cache
def _derived(path: Path, changed: int) -> RobotFile:
    from arenas.robots.files.defaults import derive  # late: loads MuJoCo

    return derive(path)
