"""The 3D scene of a match: bodies, markers and players. Poses are written column by column.

Boxes, spheres, ellipsoids, cylinders, capsules, planes and meshes are drawn; height fields are not.
"""

import math
from typing import Any

import numpy as np

from dashboards.errors import ViewerError
from dashboards.identity import shape
from dashboards.replay import Replay, drawn_markers, rgba, rotate, visible_geoms
from storage.recordings.recording import Recording

MARKER_COLOURS = {"circle": (255, 200, 60), "segment": (255, 70, 60), "sphere": (120, 200, 255), "ball": (255, 200, 60)}
WHITE = (235, 238, 245)


def times(rr: Any, recording: Recording, steps: Any = slice(None)) -> list[Any]:
    """Return both timelines at these steps: step numbers, and seconds since the start of the match."""
    step = np.arange(recording.steps)[steps]
    return [rr.TimeColumn("step", sequence=step), rr.TimeColumn("sim_time", duration=recording.time[steps])]


def draw_scene(rr: Any, stream: Any, recording: Recording, scene: Replay) -> None:
    """Log everything below /world. Raises ViewerError for a marker of an unknown kind."""
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _draw_bodies(rr, stream, recording, scene)
    _draw_markers(rr, stream, recording, scene, thickness=0.006 * scene.radius)
    _draw_players(rr, stream, recording, scene)


def _draw_players(rr: Any, stream: Any, recording: Recording, scene: Replay) -> None:
    """Log each robot's player above it, its side's shape on the ground around it, and its recent path behind it."""
    when, thin = times(rr, recording), 0.005 * scene.radius
    for robot in scene.robots:
        player, (_, corners) = scene.players[robot.side], shape(robot.side)
        at = scene.xpos[:, robot.body]
        over, below, ground = scene.label(robot), at * [1, 1, 0], np.array([0, 0, thin])
        label = rr.Points3D.from_fields(colors=[player.colour], labels=[player.label], radii=[0.0], show_labels=True)
        side = rr.LineStrips3D(circles(np.array([[0, 0, robot.size]]), thin, corners), colors=[WHITE], radii=[thin])
        trail = rr.Points3D.from_fields(colors=[player.colour], radii=[thin])
        for what, look, move in (
            ("labels", label, rr.Points3D.columns(positions=over)),
            ("sides", side, rr.Transform3D.columns(translation=below)),
            ("trails", trail, rr.Points3D.columns(positions=below + ground)),
        ):
            if what == "labels" and robot not in scene.labelled:
                continue
            path = rr.new_entity_path(["world", what, *robot.agent.split("/")])
            stream.log(path, look, static=True)
            stream.send_columns(path, when, move)


def _draw_bodies(rr: Any, stream: Any, recording: Recording, scene: Replay) -> None:
    model, when = scene.model, times(rr, recording)
    for body, path in _body_paths(rr, model).items():
        if not _draw_geoms(rr, stream, model, body, path, extent=20 * scene.radius):
            continue
        translation, quaternion = scene.xpos[:, body], scene.xquat[:, body][:, [1, 2, 3, 0]]  # wxyz to xyzw
        if model.body_weldid[body] == 0:
            place = rr.Transform3D(translation=translation[0], quaternion=quaternion[0])
            stream.log(path, place, static=True)
        else:
            stream.send_columns(path, when, rr.Transform3D.columns(translation=translation, quaternion=quaternion))


def _body_paths(rr: Any, model: Any) -> dict[int, str]:
    """Return body id -> entity path: `blue/0/chassis` is /world/blue/0/chassis, the world itself /world/ground.

    In rerun an entity moves with its parents, while these poses are in the world frame. If one body's name extends
    another's (`arm`, `arm/hand`), each name is therefore one path element.
    """
    names = {0: "ground"} | {body: model.body(body).name or f"body{body}" for body in range(1, model.nbody)}
    nested = any(a.startswith(f"{b}/") for a in names.values() for b in names.values())
    parts = {body: [name] if nested else name.split("/") for body, name in names.items()}
    return {body: rr.new_entity_path(["world", *part]) for body, part in parts.items()}


def _draw_geoms(rr: Any, stream: Any, model: Any, body: int, path: str, extent: float) -> bool:
    """Log a body's visible geoms as static children, one entity per kind of shape; return whether there were any."""
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
    """Return geoms of one kind as one batch in their body's frame. MuJoCo's sizes are half sizes and radii."""
    size, centers, rotation = model.geom_size[geoms], model.geom_pos[geoms], model.geom_quat[geoms]
    look = {
        "quaternions": rotation[:, [1, 2, 3, 0]],
        "colors": rgba(model, geoms),
        "fill_mode": rr.components.FillMode.Solid,
    }
    match kind:
        case "plane":  # a thin box below it; size 0 means infinite
            half = np.column_stack([np.where(size[:, :2] == 0, extent, size[:, :2]), np.full(len(geoms), 0.01)])
            return rr.Boxes3D(half_sizes=half, centers=centers + rotate(rotation, [0, 0, -0.01]), **look)
        case "box":
            return rr.Boxes3D(half_sizes=size, centers=centers, **look)
        case "sphere":
            return rr.Ellipsoids3D(half_sizes=size[:, [0, 0, 0]], centers=centers, **look)
        case "ellipsoid":
            return rr.Ellipsoids3D(half_sizes=size, centers=centers, **look)
        case "cylinder":
            return rr.Cylinders3D(lengths=2 * size[:, 1], radii=size[:, 0], centers=centers, **look)
        case "capsule":  # rerun's capsules start at z = 0, MuJoCo's are centred
            starts = centers + rotate(rotation, np.outer(size[:, 1], [0, 0, -1]))
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


def _draw_markers(rr: Any, stream: Any, recording: Recording, scene: Replay, thickness: float) -> None:
    for name, (kind, values) in drawn_markers(recording, scene).items():
        if kind not in MARKER_COLOURS:
            known = ", ".join(map(repr, MARKER_COLOURS))
            raise ViewerError(f"marker {name!r} is a {kind!r}; the viewer draws: {known}")
        seen = np.round(values / (0.1 * thickness)) if kind == "circle" else values  # line strips are slow to write
        changed = np.flatnonzero(np.r_[True, np.any(np.diff(seen, axis=0) != 0, axis=1)])
        look, shapes = _marker(rr, kind, values[changed], thickness)
        path = rr.new_entity_path(["world", "markers", name])
        stream.log(path, look, static=True)
        stream.send_columns(path, times(rr, recording, changed), shapes)


def _marker(rr: Any, kind: str, values: np.ndarray, thickness: float) -> tuple[Any, Any]:
    """Return a marker's constant look, and its shapes over time from values (T, m)."""
    colours = [MARKER_COLOURS[kind]]
    if kind in ("sphere", "ball"):
        fill = rr.components.FillMode.Solid if kind == "ball" else rr.components.FillMode.MajorWireframe
        look = rr.Ellipsoids3D.from_fields(colors=colours, fill_mode=fill, line_radii=[0.3 * thickness])
        return look, rr.Ellipsoids3D.columns(centers=values[:, :3], half_sizes=np.repeat(values[:, 3:], 3, axis=1))
    look = rr.LineStrips3D.from_fields(colors=colours, radii=[thickness if kind == "circle" else 0.5 * thickness])
    strips = circles(values, thickness) if kind == "circle" else values.reshape(-1, 2, 3)
    return look, rr.LineStrips3D.columns(strips=list(strips))


def circles(values: np.ndarray, thickness: float, corners: int = 64) -> np.ndarray:
    """Return circles or polygons (T, corners + 1, 3) from x, y and radius (T, 3), on the ground, not half in it."""
    angles = math.pi / corners + np.linspace(0, 2 * math.pi, corners + 1)
    x, y, radius = (values[:, i, None] for i in range(3))
    height = np.full((len(values), len(angles)), thickness)
    return np.stack([x + radius * np.cos(angles), y + radius * np.sin(angles), height], axis=-1)
