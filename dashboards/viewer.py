"""Draws a recorded match with rerun: the only module that calls rerun, and only when it is used.

The picture is made from the recorded joint positions on demand; a `.rrd` file is a throw-away view of a recording.
Boxes, spheres, ellipsoids, cylinders, capsules, planes and meshes are drawn; height fields are not.
"""

import math
import os
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np

from dashboards.errors import ViewerError
from dashboards.headless import headless_viewer
from dashboards.replay import Replay, replay, rgba, turn, visible_geoms
from storage.recording import Recording

TEAM_COLOURS = ((64, 132, 255), (255, 78, 66), (70, 190, 110), (240, 180, 50))
TERM_COLOURS = ((102, 194, 165), (252, 141, 98), (141, 160, 203), (231, 138, 195), (166, 216, 84), (255, 217, 47))
MARKER_COLOURS = {"circle": (255, 200, 60), "segment": (255, 70, 60), "sphere": (120, 200, 255), "ball": (255, 200, 60)}
BACKGROUND = (17, 21, 30)
NO_WINDOW = "--save match.rrd for a file or --shot match.png for a picture"


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
    with headless_viewer(size) as viewer:
        rrd = viewer.folder / "match.rrd"
        stream, scene = _stream(rr, recording), replay(recording)
        stream.save(rrd, default_blueprint=_blueprint(rr, recording, scene, panels=False))
        _draw(rr, stream, recording, scene)
        stream.disconnect()
        picture = viewer.picture(rrd, "sim_time", float(np.clip(at_seconds, first, last)))
    Path(path).write_bytes(picture)


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
    _draw_markers(rr, stream, recording, thickness=0.006 * scene.radius)
    for what, values in (("score", recording.score), ("reward", recording.reward)):
        for team, name in enumerate(header.teams):
            path = rr.new_entity_path([what, name])
            line = rr.SeriesLines(colors=[_colour(team)], names=[name], widths=[2.0])
            stream.log(path, line, static=True)
            stream.send_columns(path, _times(rr, recording), rr.Scalars.columns(scalars=values[:, team]))
    for number, (term, values) in enumerate(recording.terms.items()):
        colour = TERM_COLOURS[number % len(TERM_COLOURS)]  # the same in every team's plot
        for team, name in enumerate(header.teams):
            path = rr.new_entity_path(["terms", name, term])
            stream.log(path, rr.SeriesLines(colors=[colour], names=[term], widths=[2.0]), static=True)
            stream.send_columns(path, _times(rr, recording), rr.Scalars.columns(scalars=values[:, team]))
    _draw_events(rr, stream, recording)


def _draw_events(rr: Any, stream: Any, recording: Recording) -> None:
    """Events as lines of a log, and each text as a lane of its own on the time line, lit for a moment."""
    if not recording.events:
        return
    steps = np.array([step for step, _ in recording.events])
    text = rr.TextLog.columns(text=[text for _, text in recording.events], level=["INFO"] * len(steps))
    stream.send_columns("events", _times(rr, recording, steps), text)
    moment = max(1, recording.steps // 100)
    for text in dict.fromkeys(text for _, text in recording.events):
        lit = np.zeros(recording.steps + 1, bool)
        for step, other in recording.events:
            lit[step : step + moment] |= other == text
        changes = np.flatnonzero(np.diff(lit[:-1], prepend=False))
        states = rr.StateChange.columns(state=[text if lit[step] else "" for step in changes])
        stream.send_columns(rr.new_entity_path(["lanes", text]), _times(rr, recording, changes), states)


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


def _draw_markers(rr: Any, stream: Any, recording: Recording, thickness: float) -> None:
    for name, kind in recording.header.marker_kinds.items():
        if kind not in MARKER_COLOURS:
            known = ", ".join(map(repr, MARKER_COLOURS))
            raise ViewerError(f"marker {name!r} is a {kind!r}; the viewer draws: {known}")
        values = recording.markers[name]
        changed = np.flatnonzero(np.r_[True, np.any(np.diff(values, axis=0) != 0, axis=1)])
        look, shapes = _marker(rr, kind, values[changed], thickness)
        path = rr.new_entity_path(["world", "markers", name])
        stream.log(path, look, static=True)
        stream.send_columns(path, _times(rr, recording, changed), shapes)


def _marker(rr: Any, kind: str, values: np.ndarray, thickness: float) -> tuple[Any, Any]:
    """How a marker looks at all times, and its shapes over time from values (T, m)."""
    colours = [MARKER_COLOURS[kind]]
    if kind in ("sphere", "ball"):
        fill = rr.components.FillMode.Solid if kind == "ball" else rr.components.FillMode.MajorWireframe
        look = rr.Ellipsoids3D.from_fields(colors=colours, fill_mode=fill, line_radii=[0.3 * thickness])
        return look, rr.Ellipsoids3D.columns(centers=values[:, :3], half_sizes=np.repeat(values[:, 3:], 3, axis=1))
    look = rr.LineStrips3D.from_fields(colors=colours, radii=[thickness if kind == "circle" else 0.5 * thickness])
    strips = _circles(values, thickness) if kind == "circle" else values.reshape(-1, 2, 3)
    return look, rr.LineStrips3D.columns(strips=list(strips))


def _circles(values: np.ndarray, thickness: float) -> np.ndarray:
    """Circles (T, points, 3) from x, y and radius (T, 3), on the ground rather than half in it."""
    angles = np.linspace(0, 2 * math.pi, 65)
    x, y, radius = (values[:, i, None] for i in range(3))
    height = np.full((len(values), len(angles)), thickness)
    return np.stack([x + radius * np.cos(angles), y + radius * np.sin(angles), height], axis=-1)


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


def _reward_views(rr: Any, recording: Recording) -> list[Any]:
    """The teams' rewards in one plot, then one a team with the named terms that its reward is made of."""
    rrb = rr.blueprint
    views = [rrb.TimeSeriesView(origin="/reward", name="Reward", plot_legend=rrb.PlotLegend(visible=False))]
    for team in recording.header.teams if recording.terms else ():
        origin = rr.new_entity_path(["terms", team])
        views.append(rrb.TimeSeriesView(origin=origin, name=f"Terms of {team}", plot_legend=rrb.Corner2D.LeftTop))
    return views


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
                rrb.Tabs(*_reward_views(rr, recording)),
                rrb.Tabs(
                    rrb.TextLogView(
                        origin="/events", name="Events", columns=rrb.TextLogColumns(text_log_columns=[body])
                    ),
                    rrb.StateTimelineView(origin="/lanes", name="Time line"),
                ),
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
