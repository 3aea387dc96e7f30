"""Draws a recorded match with rerun: the only module that calls rerun, and only when it is used.

The picture is made from the recorded joint positions on demand; a `.rrd` file is a throw-away view of a recording.
Boxes, spheres, ellipsoids, cylinders, capsules, planes and meshes are drawn; height fields are not.
"""

import io
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from dashboards.errors import ViewerError
from dashboards.replay import Replay, replay, rgba, turn, visible_geoms
from storage.recording import Recording

TEAM_COLOURS = ((64, 132, 255), (255, 78, 66), (70, 190, 110), (240, 180, 50))
MARKER_COLOUR = (255, 200, 60)
BACKGROUND = (17, 21, 30)
TITLE_BAR = 36  # pixels, empty even where the top panel is hidden
NO_WINDOW = "--save match.rrd for a file or --shot match.png for a picture"
PATIENCE = 60.0  # s that a picture may take


def write_rrd(recording: Recording, path: str | Path) -> None:
    """Write the match as a rerun file. Raises ViewerError where rerun is not installed."""
    rr = _rerun()
    scene = replay(recording)
    stream = _stream(rr, recording)
    stream.save(path, default_blueprint=_blueprint(rr, recording, scene))
    _draw(rr, stream, recording, scene)
    stream.disconnect()


def show(recording: Recording, port: int = 9876) -> None:
    """Open the match in rerun's window; a viewer that already listens on the port gets it as one more recording.

    Raises ViewerError where there is no display, no window opens or rerun is not installed.
    """
    rr = _rerun()
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ViewerError(f"there is no display here; use {NO_WINDOW}")
    scene = replay(recording)
    stream = _stream(rr, recording)
    rr.spawn(
        port=port,
        hide_welcome_screen=True,
        executable_path=shutil.which("rerun", path=str(Path(sys.executable).parent)),
        default_blueprint=_blueprint(rr, recording, scene),
        recording=stream,
    )
    _draw(rr, stream, recording, scene)
    try:
        stream.flush(timeout_sec=30.0)
    except RuntimeError as error:
        raise ViewerError(f"rerun's window did not open here; use {NO_WINDOW}") from error
    stream.disconnect()


def shot(recording: Recording, path: str | Path, at_seconds: float, size: tuple[int, int] = (1600, 1000)) -> None:
    """Write a PNG of `size` pixels of the match at a moment, without a display.

    Raises ViewerError where the match does not have that moment, or rerun or a Vulkan driver is not installed.
    """
    rr = _rerun()
    first, last, dt = recording.time[0], recording.time[-1], recording.header.dt
    if not first - dt <= at_seconds <= last + dt:  # the ends as a person writes them: 0, or 2 for 1.9999
        raise ViewerError(f"there is no second {at_seconds:g} in this match; it has {first:g} to {last:g}")
    from PIL import Image

    with tempfile.TemporaryDirectory() as folder:
        rrd = Path(folder, "match.rrd")
        scene = replay(recording)
        stream = _stream(rr, recording)
        stream.save(rrd, default_blueprint=_blueprint(rr, recording, scene, panels=False))
        _draw(rr, stream, recording, scene)
        stream.disconnect()
        with _headless_viewer(Path(folder), size) as viewer:
            viewer.open(str(rrd))
            viewer.set_time("sim_time", duration=float(np.clip(at_seconds, first, last)), play_state="paused")
            picture = _settled_picture(viewer)
    with Image.open(io.BytesIO(picture)) as image:
        image.crop((0, TITLE_BAR, size[0], size[1] + TITLE_BAR)).save(path, format="PNG")


def _rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise ViewerError("watching a match needs rerun; install it with: pip install 'robot-league[view]'") from error
    return rerun


def _stream(rr: Any, recording: Recording) -> Any:
    header = recording.header
    name = f"{header.league}-{header.match}-{header.seed}-{header.world}"
    return rr.RecordingStream("robot-league", recording_id=name)


def _draw(rr: Any, stream: Any, recording: Recording, scene: Replay) -> None:
    header = recording.header
    stream.send_recording_name(f"{' – '.join(header.sides)}: {header.outcome}")
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log("header", rr.TextDocument(_markdown(recording), media_type="text/markdown"), static=True)
    _draw_bodies(rr, stream, recording, scene)
    _draw_circles(rr, stream, recording, thickness=0.006 * scene.radius)
    for what, values in (("score", recording.score), ("reward", recording.reward)):
        for team, name in enumerate(header.teams):
            path = rr.new_entity_path([what, name])
            line = rr.SeriesLines(colors=[_colour(team)], names=[name], widths=[2.0])
            stream.log(path, line, static=True)
            stream.send_columns(path, _times(rr, recording), rr.Scalars.columns(scalars=values[:, team]))
    if recording.events:
        steps = np.array([step for step, _ in recording.events])
        text = rr.TextLog.columns(text=[text for _, text in recording.events], level=["INFO"] * len(steps))
        stream.send_columns("events", _times(rr, recording, steps), text)


def _times(rr: Any, recording: Recording, steps: Any = slice(None)) -> list[Any]:
    step = np.arange(recording.steps)[steps]
    return [rr.TimeColumn("step", sequence=step), rr.TimeColumn("sim_time", duration=recording.time[steps])]


def _draw_bodies(rr: Any, stream: Any, recording: Recording, scene: Replay) -> None:
    model, times = scene.model, _times(rr, recording)
    for body, path in _body_paths(rr, model).items():
        if not _draw_geoms(rr, stream, model, body, path, extent=20 * scene.radius):
            continue
        translation, quaternion = scene.xpos[:, body], scene.xquat[:, body][:, [1, 2, 3, 0]]  # wxyz to xyzw
        if model.body_weldid[body] == 0:
            place = rr.Transform3D(translation=translation[0], quaternion=quaternion[0])
            stream.log(path, place, static=True)
        else:
            stream.send_columns(path, times, rr.Transform3D.columns(translation=translation, quaternion=quaternion))


def _body_paths(rr: Any, model: Any) -> dict[int, str]:
    """Body id -> entity path: `blue/0/chassis` is /world/blue/0/chassis, the world itself /world/ground.

    In rerun an entity moves with those above it, while our poses are in the world: where one body's name leads on from
    another's (`arm`, `arm/hand`), names are one path element each.
    """
    names = {0: "ground"} | {body: model.body(body).name or f"body{body}" for body in range(1, model.nbody)}
    nested = any(a.startswith(f"{b}/") for a in names.values() for b in names.values())
    parts = {body: [name] if nested else name.split("/") for body, name in names.items()}
    return {body: rr.new_entity_path(["world", *part]) for body, part in parts.items()}


def _draw_geoms(rr: Any, stream: Any, model: Any, body: int, path: str, extent: float) -> bool:
    """Log a body's visible geoms as static children, one entity per kind of shape; say whether there were any."""
    kinds = visible_geoms(model, body)
    for kind, geoms in kinds.items():
        if kind == "mesh":
            for geom in geoms:
                quaternion = model.geom_quat[geom][[1, 2, 3, 0]]
                place = rr.Transform3D(translation=model.geom_pos[geom], quaternion=quaternion)
                stream.log(f"{path}/mesh{geom}", place, _mesh(rr, model, geom), static=True)
        elif shapes := _shapes(rr, model, kind, geoms, extent):
            stream.log(f"{path}/{kind}", shapes, static=True)
    return bool(kinds)


def _shapes(rr: Any, model: Any, kind: str, geoms: list[int], extent: float) -> Any:
    """Geoms of one kind as one batch in their body's frame. MuJoCo's sizes are half sizes and radii."""
    size, centers, rotation = model.geom_size[geoms], model.geom_pos[geoms], model.geom_quat[geoms]
    look = {
        "quaternions": rotation[:, [1, 2, 3, 0]],
        "colors": rgba(model, geoms),
        "fill_mode": rr.components.FillMode.Solid,
    }
    match kind:
        case "plane":  # a thin box below it; size 0 means endless
            half = np.column_stack([np.where(size[:, :2] == 0, extent, size[:, :2]), np.full(len(geoms), 0.01)])
            return rr.Boxes3D(half_sizes=half, centers=centers + turn(rotation, [0, 0, -0.01]), **look)
        case "box":
            return rr.Boxes3D(half_sizes=size, centers=centers, **look)
        case "sphere":
            return rr.Ellipsoids3D(half_sizes=size[:, [0, 0, 0]], centers=centers, **look)
        case "ellipsoid":
            return rr.Ellipsoids3D(half_sizes=size, centers=centers, **look)
        case "cylinder":
            return rr.Cylinders3D(lengths=2 * size[:, 1], radii=size[:, 0], centers=centers, **look)
        case "capsule":  # rerun's start at z = 0, MuJoCo's are centred
            starts = centers + turn(rotation, np.outer(size[:, 1], [0, 0, -1]))
            return rr.Capsules3D(lengths=2 * size[:, 1], radii=size[:, 0], translations=starts, **look)
    return None


def _mesh(rr: Any, model: Any, geom: int) -> Any:
    mesh = model.geom_dataid[geom]
    vertex, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    return rr.Mesh3D(
        vertex_positions=model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]],
        triangle_indices=model.mesh_face[face : face + model.mesh_facenum[mesh]],
        albedo_factor=rgba(model, [geom])[0],
    )


def _draw_circles(rr: Any, stream: Any, recording: Recording, thickness: float) -> None:
    for name, kind in recording.header.marker_kinds.items():
        if kind != "circle":
            raise ViewerError(f"marker {name!r} is a {kind!r}; the viewer draws: 'circle'")
        values = recording.markers[name]
        changed = np.flatnonzero(np.r_[True, np.any(np.diff(values, axis=0) != 0, axis=1)])
        angles = np.linspace(0, 2 * math.pi, 65)
        x, y, radius = (values[changed, i, None] for i in range(3))
        height = np.full((len(changed), len(angles)), thickness)  # on the ground rather than half in it
        strips = np.stack([x + radius * np.cos(angles), y + radius * np.sin(angles), height], axis=-1)
        path = rr.new_entity_path(["world", "markers", name])
        look = rr.LineStrips3D.from_fields(colors=[MARKER_COLOUR], radii=[thickness])
        stream.log(path, look, static=True)
        stream.send_columns(path, _times(rr, recording, changed), rr.LineStrips3D.columns(strips=list(strips)))


def _colour(team: int) -> tuple[int, int, int]:
    return TEAM_COLOURS[team % len(TEAM_COLOURS)]


def _markdown(recording: Recording) -> str:
    header = recording.header
    sides = zip(header.teams, header.sides, header.score, header.agents, strict=True)
    rows = [f"| {team} | {side} | {score:g} | {', '.join(agents)} |" for team, side, score, agents in sides]
    where = f"**{header.arena.arena}**, league *{header.league}*, seed {header.seed}, world {header.world}"
    table = ["| team | player | score | agents |", "|---|---|---|---|", *rows]
    return "\n".join([f"# {header.outcome}", where, "", *table])


def _grid_spacing(radius: float) -> float:
    """About six cells across the arena, of a round size: 1, 2 or 5 times a power of ten, m."""
    power = 10.0 ** math.floor(math.log10(radius / 3))
    return power * max(step for step in (1, 2, 5) if step * power <= radius / 3)


def _blueprint(rr: Any, recording: Recording, scene: Replay, panels: bool = True) -> Any:
    rrb = rr.blueprint
    eye = np.array([0.4, -1.6, 1.25]) * scene.radius
    body = rrb.encodings.TextLogColumn(rrb.encodings.TextLogColumnKind.Body)
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(
                origin="/world",
                name=recording.header.arena.arena,
                eye_controls=rrb.EyeControls3D(
                    position=eye, look_target=(0.0, -0.1 * scene.radius, 0.0), eye_up=(0.0, 0.0, 1.0)
                ),
                # Just above the ground, which would hide the half of it that lies below.
                line_grid=rrb.LineGrid3D(
                    visible=True,
                    spacing=_grid_spacing(scene.radius),
                    plane=rr.components.Plane3D((0, 0, 1), 0.001 * scene.radius),
                    stroke_width=1.0,
                    color=(255, 255, 255, 24),
                ),
                background=BACKGROUND,
            ),
            rrb.Vertical(
                rrb.TextDocumentView(origin="/header", name="Match"),
                rrb.TimeSeriesView(origin="/score", name="Score", plot_legend=rrb.Corner2D.LeftTop),
                rrb.TimeSeriesView(origin="/reward", name="Reward", plot_legend=rrb.PlotLegend(visible=False)),
                rrb.TextLogView(origin="/events", name="Events", columns=rrb.TextLogColumns(text_log_columns=[body])),
                row_shares=[1, 1, 1, 0.8],
            ),
            column_shares=[3, 1.15],
        ),
        rrb.TimePanel(
            state="collapsed" if panels else "hidden",
            timeline="sim_time",
            play_state="playing" if panels else "paused",
        ),
        rrb.TopPanel(state="expanded" if panels else "hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


@contextmanager
def _headless_viewer(folder: Path, size: tuple[int, int]):
    """A viewer without a window, as a rerun ViewerClient; it ends with the block.

    Started here rather than by `ViewerClient.spawn`, which cannot set the size of the picture and hides why it failed.
    """
    from rerun.experimental import ViewerClient

    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    window = f"{size[0]}x{size[1] + TITLE_BAR}"
    command = [sys.executable, "-m", "rerun_cli", "--headless", "--window-size", window, "--port", str(port)]
    log = folder / "viewer.log"
    with log.open("wb") as output:
        process = subprocess.Popen(
            [*command, "--bind", "127.0.0.1", "--hide-welcome-screen"],
            env=os.environ | {"RERUN_APP_ONLY": "true", "RUST_LOG": "error"},  # it shows lesser messages as bubbles
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,  # the command starts the viewer as its child: they end as a group
        )
    try:
        deadline = time.monotonic() + PATIENCE
        while True:
            if process.poll() is not None or time.monotonic() > deadline:
                raise ViewerError(_why_no_picture(log.read_text(errors="replace")))
            try:
                viewer = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
                viewer.get_state()
                break
            except (RuntimeError, ConnectionError, ValueError):
                time.sleep(0.1)
        yield viewer
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGTERM)
        process.wait()


def _why_no_picture(log: str) -> str:
    if "adapter" in log or "render context" in log or "Vulkan" in log:
        return "a picture needs a graphics driver (Vulkan); on Debian or Ubuntu: apt-get install mesa-vulkan-drivers"
    last = (log.strip().splitlines() or ["it said nothing"])[-1]
    return f"rerun's viewer did not start: {last}"


def _settled_picture(viewer: Any) -> bytes:
    """The first PNG that equals the one before it, once all is loaded: the viewer loads lazily while it draws."""
    before, deadline = b"", time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        time.sleep(0.4)
        picture = viewer.take_screenshot()
        if picture == before and not viewer.get_state().loading:
            return picture
        before = picture
    raise ViewerError(f"the picture was still changing after {PATIENCE:g} s; is this machine very busy?")
