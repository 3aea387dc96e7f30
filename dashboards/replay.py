"""A recorded match as bodies in the world: what there is to draw, known only to MuJoCo and numpy."""

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np

from dashboards.errors import ViewerError
from storage.recording import Recording

FIRST_COLLISION_GROUP = 3  # MuJoCo's own viewer hides geom groups 3 to 5 too


@dataclass(frozen=True, eq=False)
class Replay:
    """Every body's pose in the world at every step."""

    model: Any  # MjModel
    xpos: np.ndarray  # (T, nbody, 3) m
    xquat: np.ndarray  # (T, nbody, 4) wxyz
    radius: float  # m, how far from the origin there is something to see


def replay(recording: Recording) -> Replay:
    """Put the recorded joint positions through MuJoCo's kinematics.

    Raises ViewerError where they do not fit the recording's own arena.
    """
    mujoco = _mujoco()
    model = mujoco.MjModel.from_xml_string(recording.xml)
    if recording.qpos.shape[1] != model.nq:
        raise ViewerError(f"the recording has {recording.qpos.shape[1]} joint positions, its arena {model.nq}")
    data = mujoco.MjData(model)
    xpos = np.empty((recording.steps, model.nbody, 3))
    xquat = np.empty((recording.steps, model.nbody, 4))
    for t, qpos in enumerate(recording.qpos):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        xpos[t], xquat[t] = data.xpos, data.xquat
    kinds, markers = recording.header.marker_kinds, recording.markers
    circles = [markers[name] for name, kind in kinds.items() if kind == "circle"]
    reach = [np.hypot(circle[:, 0], circle[:, 1]) + circle[:, 2] for circle in circles]
    if not reach:
        balls = [markers[name][:1] for name, kind in kinds.items() if kind in ("sphere", "ball")]
        reach = [1.2 * np.hypot(at[:, 0], at[:, 1]) for at in (xpos[0], *balls)]
    return Replay(model, xpos, xquat, radius=max(0.5, float(np.nanmax(np.concatenate(reach)))))


def visible_geoms(model: Any, body: int) -> dict[str, list[int]]:
    """A body's geoms that are meant to be seen, by kind of shape, e.g. {"box": [3], "capsule": [4, 5]}."""
    geom_type = _mujoco().mjtGeom
    kinds: dict[str, list[int]] = defaultdict(list)
    for geom in np.flatnonzero(model.geom_bodyid == body):
        if model.geom_group[geom] < FIRST_COLLISION_GROUP and model.geom_rgba[geom, 3] > 0:
            kinds[geom_type(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()].append(int(geom))
    return dict(kinds)


def rgba(model: Any, geoms: list[int]) -> np.ndarray:
    """(n, 4) bytes. As in MuJoCo, a geom's own colour wins over its material's unless it is the default grey."""
    colours = model.geom_rgba[geoms].copy()
    for i, geom in enumerate(geoms):
        if model.geom_matid[geom] >= 0 and np.allclose(colours[i], (0.5, 0.5, 0.5, 1)):
            colours[i] = model.mat_rgba[model.geom_matid[geom]]
    return np.round(colours * 255).astype(np.uint8)


def turn(quaternions: np.ndarray, vectors: Any) -> np.ndarray:
    """Rotate vectors (n, 3) or (3,) by unit quaternions (n, 4), wxyz: v + 2w (u × v) + 2u × (u × v)."""
    w, u = quaternions[:, :1], quaternions[:, 1:]
    cross = np.cross(u, np.broadcast_to(vectors, u.shape))
    return vectors + 2 * (w * cross + np.cross(u, cross))


def _mujoco() -> Any:
    import mujoco  # late, because it is slow to load, and as Any, because its type stubs lack most of it

    return mujoco
