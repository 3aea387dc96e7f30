"""`league robot`: read a robot from an MJCF or URDF file, try it, draw it, and write its robot file."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any, Literal

from arenas.arena_settings import EngineName
from dashboards.system.outputs import PICTURES, require_output
from dashboards.tables import Column, render
from league.commands.options import parse, positional, spelt
from league.config.schema import ConfigError
from league.system import exit_codes

if TYPE_CHECKING:
    from arenas.contract.robot_trial import Finding, RobotTrial
    from arenas.robots.files.robot_file import Drive, RobotFile
    from arenas.robots.files.source import Source

DRIVES = (Column("joint", no_wrap=True), "control", "home", "scale", "kp", "kd", "effort", "range", "moves")

PICTURE, FRAME = (640, 480), 1.45  # pixels, and the framed radius for a radius of the robot


@dataclass(frozen=True)
class RobotOptions:
    """The robot, what its robot file should hold, and what to try."""

    file: str = positional()
    """An MJCF (.xml) or URDF (.urdf) file, a robot file (.toml), or a name such as ant or go1."""
    control: Literal["position", "velocity", "torque"] | None = None
    """Control of all joints; none: that of the file's actuators, and position (PD) for a file without any."""
    passive: tuple[str, ...] = ()
    """Joints that have no actuator, and move freely."""
    free_base: bool = False
    """Free the base of a model that is fixed to the world; that of a URDF always is."""
    output: Path | None = None
    """The robot file to write, also as -o FILE (default: beside the model, with .toml; never over another one)."""
    fit: bool = False
    """Write a robot file again with the height, width and feet of its standing pose, after that was edited."""
    shot: Path | None = None
    """A picture of the standing robot to write, *.png."""
    engine: EngineName = "c"
    """A further engine to compare with C: warp, which runs on a CPU too, or jax."""


def robot(args: list[str]) -> int:
    """Read, try and write; return 0 if the robot passed all checks, 1 if not."""
    options = parse(
        RobotOptions, spelt(args), "robot",
        "Read a robot from a file, try it on the ground, draw it, and write the robot file that arenas take:"
        " --arena.blue my/robot.toml.",
    )  # fmt: skip
    from arenas.robots.files.catalogue import MODELS
    from arenas.robots.files.defaults import fitted
    from arenas.robots.files.loading import robot_of, source_of

    target = _target(options)
    if options.shot is not None:
        require_output(options.shot, PICTURES)
    settings = _settings(options)
    source = source_of(settings)
    if options.fit:
        settings = fitted(source, settings)
    print(_reading(settings, source))
    if target is None and Path(options.file).suffix in MODELS:
        beside = Path(options.file).with_suffix(".toml")
        print(f"drives and pose of {beside}, not of the model: to read these again, remove it, or give --output")
    from arenas.contract.robot_trial import RobotTrial

    trial = RobotTrial(robot_of(settings))
    failed = _try(settings, trial)
    if target is not None:
        _write(target, _with_buffers(settings, trial))
    if options.shot is not None:
        _draw(trial, settings.name, settings.width, options.shot)
    if options.engine not in ("c", "auto"):
        failed += _compare(options.engine, _with_buffers(settings, trial), trial)
    file = options.file if target is None else str(target)
    if failed:
        _mend(file, failed)
        return exit_codes.NO
    _next(file, settings, trial.rests_after)
    return exit_codes.DONE


def _target(options: RobotOptions) -> Path | None:
    """Return the robot file to write; None if one is read, and nothing is written."""
    from arenas.robots.files.catalogue import MODELS, shipped

    file = Path(options.file)
    beside = file.with_suffix(".toml")
    is_model = file.suffix in MODELS
    target = options.output or (beside if is_model and not beside.exists() else None)
    if target is None and (options.control or options.passive or options.free_base):
        why = f"{beside} is there already: edit it, or give --output" if is_model else "it is a robot file: edit it"
        raise ConfigError((), f"--control, --passive and --free-base are for reading a model; {why}")
    if options.fit:
        if file.suffix != ".toml" or options.output:
            raise ConfigError(("fit",), "--fit is for a robot file (.toml), which it writes again")
        return file
    if target is not None and target.exists():
        raise ConfigError(("output",), f"{target} is there already: give another --output, or remove it")
    if target is not None and target.suffix != ".toml":
        raise ConfigError(("output",), f"a robot file is named *.toml, not {target.name}")
    if target is not None and not target.parent.is_dir():
        raise ConfigError(("output",), f"there is no folder {target.parent}")
    if not is_model and file.suffix != ".toml" and options.file not in shipped():
        raise ConfigError(
            ("file",),
            f"{options.file}: give an MJCF (.xml) or URDF (.urdf) file, a robot file (.toml), or one of"
            f" {', '.join(shipped())}",
        )
    return target


def _settings(options: RobotOptions) -> "RobotFile":
    from arenas.robots.files import catalogue
    from arenas.robots.files.defaults import derive

    file = Path(options.file)
    fresh = options.output or not file.with_suffix(".toml").exists()
    if file.suffix in catalogue.MODELS and fresh and file.is_file():
        return derive(file, control=options.control, free_base=options.free_base, passive=options.passive)
    return catalogue.robot_file(options.file)


def _reading(settings: "RobotFile", source: "Source") -> str:
    """Describe in words what was read and what was left out."""
    controls = [drive.control for drive in settings.drives.values()]
    driven = ", ".join(f"{controls.count(each)} by {each}" for each in dict.fromkeys(controls))
    lines = [
        f"{settings.name}: base {settings.base}, {len(controls)} driven joints ({driven}), feet"
        f" {', '.join(settings.feet) or 'none'}",
        f"read {source.path}",
    ]
    if source.left_out:
        lines.append(f"left out: {', '.join(source.left_out)}")
    if source.named:
        parts = "body, joint or geom" if source.named == 1 else "bodies, joints and geoms"
        lines.append(f"named: {source.named} {parts} that had no name")
    return "\n".join(lines)


def _try(settings: "RobotFile", trial: "RobotTrial") -> list["Finding"]:
    """Print the checks and the joints; return the checks that failed."""
    failed = []
    for finding in trial.findings():
        failed += [] if finding.ok else [finding]
        print(f"{'ok    ' if finding.ok else 'FAILED'}  {finding.name}: {finding.detail}", flush=True)
    print(f"        speed: {trial.speed():,.0f} control steps per second on engine c, while standing")
    moved = {each.joint: each for each in trial.moved()}
    rows: list[dict[str, Any]] = [
        {"joint": name, **{key: getattr(drive, key) for key in ("control", "home", "scale", "kp", "kd")},
         "effort": drive.effort or "none", "range": _range(drive), "moves": round(moved[name].by, 3)}
        for name, drive in settings.drives.items()
    ]  # fmt: skip
    print(render(rows, DRIVES))
    return failed


def _compare(engine: EngineName, settings: "RobotFile", trial: "RobotTrial") -> list["Finding"]:
    """Print how far another engine is from C; return that check if it failed."""
    from arenas.arena_settings import Solver

    finding = trial.compare(engine, Solver(contacts=settings.contacts + 8, rows=settings.rows + 16))
    print(f"{'ok    ' if finding.ok else 'FAILED'}  {finding.name}: {finding.detail}")
    return [] if finding.ok else [finding]


def _range(drive: "Drive") -> str:
    return f"{drive.low:.2f} {drive.high:.2f}" if drive.low < drive.high else "free"


def _with_buffers(settings: "RobotFile", trial: "RobotTrial") -> "RobotFile":
    """Return the settings with buffers that hold half as much again as the trial needed."""
    return replace(settings, contacts=max(8, 4 + 3 * trial.contacts // 2), rows=max(32, 8 + 3 * trial.rows // 2))


def _write(target: Path, settings: "RobotFile") -> None:
    import os

    from arenas.robots.files.robot_file import written

    if ":" not in settings.model:
        model = os.path.relpath(Path(settings.folder) / settings.model, target.parent)
        settings = replace(settings, model=Path(model).as_posix())
    if target.stem != settings.name and settings.name in _names():
        settings = replace(settings, name=target.stem)
    target.write_text(written(settings), "utf-8")
    print(f"Wrote {target}: edit it, and try it again with: league robot {quote(str(target))}")


def _names() -> tuple[str, ...]:
    from arenas.robots.files.catalogue import shipped

    return shipped()


def _draw(trial: "RobotTrial", name: str, width: float, path: Path) -> None:
    """Draw the robot in its standing pose, without a graphics driver."""
    import numpy as np

    from arenas.contract.robot_trial import AGENT, STEPS
    from dashboards.film.film import Film, save_picture
    from storage.recordings.recording import Recording, RecordingHeader
    from storage.records import ArenaKey

    scene, size = trial.scenes[STEPS[0]], trial.robot.action_size
    header = RecordingHeader(
        league="", match=0, seed=0, world=0, arena=ArenaKey("robot", "", "c"), sides=(name,), digests=("",),
        teams=("blue",), agents=((AGENT,),), score=(0.5,), outcome="", dt=0.02,
    )  # fmt: skip
    one = np.zeros((1, 1))
    recording = Recording(header, scene.xml, np.zeros(1), scene.rest[None], {AGENT: np.zeros((1, size))}, one, one)
    top = trial.top()
    stage = np.array([0.0, 0.0, top / 2]), FRAME * max(top / 2, width / 2)
    save_picture(Film(recording, PICTURE, labels=False, stage=stage), path, 0.0)
    print(f"Wrote {path}")


def _mend(file: str, failed: "list[Finding]") -> None:
    """Print what to do about the checks that failed."""
    print("Mend it first:")
    for mend in dict.fromkeys(finding.mend for finding in failed):
        print(f"  {mend}")
    print(f"then try it again with: league robot {quote(file)}")


def _next(file: str, settings: "RobotFile", rests_after: float | None) -> None:
    """Print commands that play it, in an arena that its body allows."""
    given = f"--arena.blue {quote(file)}"
    arena = "disturbance" if settings.planar else "walk"
    if rests_after is not None and not settings.planar:
        arena, given = "sumo-1v1", f"{given} --arena.red {quote(file)}{_ring(settings.width)}"
        print(
            f"Its base touches the ground after {rests_after:.2g} s of the zero action, where an episode of walk ends:"
            " it plays other arenas"
        )
    print(f"Play it: league check {arena} {given}")
    print(f"         league run --arena.name {arena} {given}")


def _ring(width: float) -> str:
    """Return the flag of a ring in which two robots of this width can start, m; empty where sumo's own is enough."""
    import arenas
    from arenas.games.sumo.settings import SumoSettings, diameter_ring

    least, sumo = diameter_ring((1, 1), width), arenas.settings("sumo-1v1")
    assert isinstance(sumo, SumoSettings)
    low = math.ceil(10 * least + 0.1) / 10  # the width in the file is rounded
    return f" --arena.rules.ring {low:g},{1.5 * low:g}" if sumo.rules.ring[0] < least else ""
