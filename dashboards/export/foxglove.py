"""A recorded match as an MCAP file that other viewers open in 3D: Foxglove, and rerun without this program.

    /tf                 foxglove.FrameTransforms, every body's pose in the frame "world" at every step
    /scene              foxglove.SceneUpdate, the shapes of each body in its own frame, and its player; once
    /markers            foxglove.SceneUpdate, rings and goals in the world, whenever they have changed
    /events             foxglove.Log
    /match/step         league.v1.Step, the numbers of the recording: score, rewards, terms, value estimates, ...
    /robot_description  the same shapes as URDF, which rerun draws; it has neither ellipsoids nor meshes

The file is a view, larger than the recording and less exact: only the recording holds the original data.
"""

import functools
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from mcap.writer import Writer

from dashboards.errors import ViewerError
from dashboards.identity import MatchPlayer, named_events
from dashboards.replay import Replay, drawn_markers, replay, rgba, rotate, visible_geoms
from storage.blobs.files import new_file
from storage.recordings.mcap_messages import message_classes
from storage.recordings.recording import Recording, step_messages

WORLD = "world"
RING = (1.0, 0.78, 0.24, 1.0)


def write_foxglove(recording: Recording, path: Path, players: Sequence[MatchPlayer] | None = None) -> None:
    """Write the file. Raises ViewerError where the schemas are not installed, StorageError where the file exists."""
    kinds, scene = _schemas(), replay(recording, players)
    with new_file(path) as file:
        writer = Writer(file, chunk_size=256 * 1024)
        writer.start(profile="", library="robot-league")
        send = _Sender(writer, kinds, recording.header.dt)
        _describe(writer, scene)
        send("/scene", kinds["SceneUpdate"](entities=list(_entities(kinds, scene, recording))), 0)
        events, numbers = sorted(named_events(recording, scene.players)), step_messages(recording)
        markers = drawn_markers(recording, scene)
        for step in range(recording.steps):
            send.bytes("/match/step", message_classes()["Step"], numbers[step], step)
            moved = kinds["FrameTransforms"](transforms=list(_transforms(kinds, scene, send.stamp(step), step)))
            send("/tf", moved, step)
            changed = step == 0 or any((each[step] != each[step - 1]).any() for _, each in markers.values())
            if changed and markers:
                send("/markers", kinds["SceneUpdate"](entities=list(_marks(kinds, markers, step))), step)
            while events and events[0][0] == step:
                text = events.pop(0)[1]
                send("/events", kinds["Log"](timestamp=send.stamp(step), level=2, message=text, name="match"), step)
        writer.finish()


class _Sender:
    """Writer of messages, each kind with its schema."""

    def __init__(self, writer: Writer, kinds: dict[str, Any], dt: float):
        from mcap_protobuf.schema import register_schema

        self._writer, self._dt, self._timestamp = writer, dt, kinds["Timestamp"]
        self._register = functools.cache(
            lambda topic, kind: writer.register_channel(topic, "protobuf", register_schema(writer, kind))
        )

    def __call__(self, topic: str, message: Any, step: int) -> None:
        self.bytes(topic, type(message), message.SerializeToString(), step)

    def bytes(self, topic: str, kind: Any, message: bytes, step: int) -> None:
        """Write a message of that kind that is serialised already."""
        at = round(step * self._dt * 1e9)
        self._writer.add_message(self._register(topic, kind), at, message, at, step)

    def stamp(self, step: int) -> Any:
        at = round(step * self._dt * 1e9)
        return self._timestamp(seconds=at // 10**9, nanos=at % 10**9)


def _schemas() -> dict[str, Any]:
    names = ("FrameTransforms", "FrameTransform", "SceneUpdate", "SceneEntity", "Log", "Pose", "Vector3", "Quaternion",
             "Color", "CubePrimitive", "SpherePrimitive", "CylinderPrimitive", "TriangleListPrimitive", "LinePrimitive",
             "TextPrimitive", "Point3")  # fmt: skip
    try:
        from importlib import import_module

        from google.protobuf.timestamp_pb2 import Timestamp

        found = {name: getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name) for name in names}
    except ImportError as error:
        why = "an export for Foxglove needs its schemas; install them with: pip install 'robot-league[foxglove]'"
        raise ViewerError(why) from error
    return found | {"Timestamp": Timestamp}


def _frame(model: Any, body: int) -> str:
    return model.body(body).name or f"body{body}" if body else WORLD


def _transforms(kinds: dict[str, Any], scene: Replay, stamp: Any, step: int) -> Iterator[Any]:
    for body in range(1, scene.model.nbody):
        x, y, z = scene.xpos[step, body].tolist()
        w, i, j, k = scene.xquat[step, body].tolist()
        yield kinds["FrameTransform"](
            timestamp=stamp, parent_frame_id=WORLD, child_frame_id=_frame(scene.model, body),
            translation=kinds["Vector3"](x=x, y=y, z=z), rotation=kinds["Quaternion"](x=i, y=j, z=k, w=w),
        )  # fmt: skip


def _entities(kinds: dict[str, Any], scene: Replay, recording: Recording) -> Iterator[Any]:
    """Yield the shapes of every body, and the label of the player above the base of each robot."""
    model, labels = scene.model, {robot.body: robot for robot in scene.labelled}
    for body in range(model.nbody):
        entity = kinds["SceneEntity"](frame_id=_frame(model, body), id=_frame(model, body), frame_locked=True)
        for kind, geoms in visible_geoms(model, body).items():
            for geom in geoms:
                _add(kinds, entity, model, kind, geom, 20 * scene.radius)
        if robot := labels.get(body):
            over = _pose(kinds, np.array([0, 0, scene.label_height(robot)]), np.array([1.0, 0, 0, 0]))
            colour = _colour(kinds, np.array([*scene.players[robot.side].colour, 255]))
            label = scene.players[robot.side].label
            entity.texts.add(pose=over, billboard=True, font_size=14, scale_invariant=True, color=colour, text=label)
        yield entity


def _add(kinds: dict[str, Any], entity: Any, model: Any, kind: str, geom: int, extent: float) -> None:
    """Add a geom to its body's entity. MuJoCo's sizes are half sizes and radii."""
    at, quaternion, size = model.geom_pos[geom], model.geom_quat[geom], model.geom_size[geom]
    pose, colour = _pose(kinds, at, quaternion), _colour(kinds, rgba(model, [geom])[0])

    def vector(*xyz: float) -> Any:
        return kinds["Vector3"](x=xyz[0], y=xyz[1], z=xyz[2])

    match kind:
        case "plane":
            half = np.where(size[:2] == 0, extent, size[:2])
            below = _pose(kinds, at + rotate(quaternion[None], [0, 0, -0.01])[0], quaternion)
            entity.cubes.add(pose=below, size=vector(*(2 * half), 0.02), color=colour)
        case "box":
            entity.cubes.add(pose=pose, size=vector(*(2 * size)), color=colour)
        case "sphere" | "ellipsoid":
            entity.spheres.add(
                pose=pose, size=vector(*(2 * size[[0, 0, 0]] if kind == "sphere" else 2 * size)), color=colour
            )
        case "cylinder" | "capsule":
            entity.cylinders.add(
                pose=pose, size=vector(2 * size[0], 2 * size[0], 2 * size[1]), bottom_scale=1, top_scale=1, color=colour
            )
            for end in (-1, 1) if kind == "capsule" else ():
                cap = _pose(kinds, at + rotate(quaternion[None], [0, 0, end * size[1]])[0], quaternion)
                entity.spheres.add(pose=cap, size=vector(*(2 * size[[0, 0, 0]])), color=colour)
        case "mesh":
            mesh = model.geom_dataid[geom]
            vertex, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
            points = model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]].tolist()
            faces = model.mesh_face[face : face + model.mesh_facenum[mesh]].ravel().tolist()
            entity.triangles.add(
                pose=pose, color=colour, indices=faces,
                points=[kinds["Point3"](x=x, y=y, z=z) for x, y, z in points],
            )  # fmt: skip


def _marks(kinds: dict[str, Any], markers: Mapping[str, tuple[str, np.ndarray]], step: int) -> Iterator[Any]:
    """Yield the markers of a step; each replaces the marker of the same name."""
    from dashboards.viewer.scene import circles

    for name, (kind, every) in markers.items():
        values = every[step]
        entity = kinds["SceneEntity"](frame_id=WORLD, id=f"marker {name}")
        colour = kinds["Color"](r=RING[0], g=RING[1], b=RING[2], a=RING[3] if kind in ("circle", "segment") else 0.4)
        if kind in ("circle", "segment"):
            points = circles(values[None], 0.01)[0] if kind == "circle" else values.reshape(2, 3)
            entity.lines.add(
                type=0, thickness=3, scale_invariant=True, color=colour, pose=_pose(kinds, np.zeros(3), np.eye(4)[0]),
                points=[kinds["Point3"](x=x, y=y, z=z) for x, y, z in points.tolist()],
            )  # fmt: skip
        else:
            across = 2 * float(values[3])
            size = kinds["Vector3"](x=across, y=across, z=across)
            entity.spheres.add(pose=_pose(kinds, values[:3], np.eye(4)[0]), size=size, color=colour)
        yield entity


def _pose(kinds: dict[str, Any], at: np.ndarray, wxyz: np.ndarray) -> Any:
    (x, y, z), (w, i, j, k) = at.tolist(), wxyz.tolist()
    return kinds["Pose"](position=kinds["Vector3"](x=x, y=y, z=z), orientation=kinds["Quaternion"](x=i, y=j, z=k, w=w))


def _colour(kinds: dict[str, Any], bytes_: np.ndarray) -> Any:
    r, g, b, a = (bytes_ / 255).tolist()
    return kinds["Color"](r=r, g=g, b=b, a=a)


def _describe(writer: Writer, scene: Replay) -> None:
    """Write the bodies as URDF in a ROS 2 string: links that float in the world, moved by /tf."""
    text = _urdf(scene).encode() + b"\0"
    schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
    channel = writer.register_channel("/robot_description", "cdr", schema)
    writer.add_message(channel, 0, b"\0\1\0\0" + struct.pack("<I", len(text)) + text, 0)


def _urdf(scene: Replay) -> str:
    model, links = scene.model, [f'<link name="{WORLD}"/>']
    for body in range(1, model.nbody):
        name = quoteattr(_frame(model, body))
        shapes = [
            shape
            for kind, geoms in visible_geoms(model, body).items()
            for g in geoms
            for shape in _visual(model, kind, g)
        ]
        links += [f"<link name={name}>{''.join(shapes)}</link>", f'<joint name={name} type="floating">'
                  f'<parent link="{WORLD}"/><child link={name}/></joint>']  # fmt: skip
    return f'<robot name="match">{"".join(links)}</robot>'


def _visual(model: Any, kind: str, geom: int) -> Iterator[str]:
    a, b, c = model.geom_size[geom].tolist()
    shapes = {
        "box": f'<box size="{2 * a} {2 * b} {2 * c}"/>', "sphere": f'<sphere radius="{a}"/>',
        "ellipsoid": f'<sphere radius="{(a * b * c) ** (1 / 3)}"/>',
        "cylinder": f'<cylinder radius="{a}" length="{2 * b}"/>',
        "capsule": f'<capsule radius="{a}" length="{2 * b}"/>',
    }  # fmt: skip
    if kind in shapes:
        w, x, y, z = model.geom_quat[geom].tolist()
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        where = f'<origin xyz="{" ".join(map(str, model.geom_pos[geom].tolist()))}" rpy="{roll} {pitch} {yaw}"/>'
        colour = " ".join(f"{part / 255:.3f}" for part in rgba(model, [geom])[0])
        paint = f'<material name="paint{geom}"><color rgba="{colour}"/></material>'
        yield f"<visual>{where}<geometry>{shapes[kind]}</geometry>{paint}</visual>"
