"""A recorded match as bodies in the world: what there is to draw, known only to MuJoCo and numpy."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dashboards.cast import Performer, strangers, team_colour
from dashboards.errors import ViewerError
from storage.recording import Recording

FIRST_COLLISION_GROUP = 3  # MuJoCo's own viewer hides geom groups 3 to 5 too
EYE, TARGET = np.array([0.4, -1.6, 1.25]), np.array([0.0, -0.1, 0.0])  # of who watches, in radii of the scene


@dataclass(frozen=True)
class Robot:
    """One robot of a side."""

    agent: str  # e.g. "blue/0"
    side: int
    body: int  # its base
    size: float  # m from its base to the farthest that is seen of it, when the match begins


@dataclass(frozen=True, eq=False)
class Replay:
    """Every body's pose in the world at every step, and who is who."""

    model: Any  # MjModel, in the colours of those who play
    xpos: np.ndarray  # (T, nbody, 3) m
    xquat: np.ndarray  # (T, nbody, 4) wxyz
    radius: float  # m, how far from the origin there is something to see
    cast: tuple[Performer, ...]  # by side
    robots: tuple[Robot, ...]  # that have a body

    def label(self, robot: Robot) -> np.ndarray:
        """(T, 3) Where over a robot its label stands, high enough to leave it in sight from afar."""
        return self.xpos[:, robot.body] + [0, 0, self.label_height(robot)]

    def label_height(self, robot: Robot) -> float:
        """How far above a robot's base its label stands, m."""
        return 1.2 * robot.size + 0.05 * self.radius


def replay(recording: Recording, cast: Sequence[Performer] | None = None) -> Replay:
    """Put the recorded joint positions through MuJoCo's kinematics, and everybody into his own colours.

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
    known = tuple(cast or strangers(recording.header))
    _paint(model, known)
    robots = tuple(_robots(model, recording, xpos[0]))
    return Replay(model, xpos, xquat, _radius(recording, xpos), known, robots)


def distances(recording: Recording, scene: Replay) -> dict[str, np.ndarray]:
    """(T, teams) m: how far the robot of each team that is nearest to something is from it.

    "edge" is that of the ring, from inside; another circle goes by its name, and so does what moves freely and is
    nobody's (a ball, a block), whose middle counts.
    """
    found = {}
    at = [scene.xpos[:, [r.body for r in scene.robots if r.side == side]] for side in range(len(scene.cast))]
    if not all(robots.shape[1] for robots in at):
        return {}
    for name, kind in recording.header.marker_kinds.items():
        if kind == "circle":
            x, y, radius = (recording.markers[name][:, None, i] for i in range(3))
            away = [np.hypot(each[..., 0] - x, each[..., 1] - y) - radius for each in at]
            inside = name == "ring"
            gap = [(-each if inside else each).min(axis=1) for each in away]
            found["edge" if inside else name] = np.stack(gap, axis=1)
    for name, body in _loose(scene).items():
        gap = [np.linalg.norm(each - scene.xpos[:, [body]], axis=-1).min(axis=1) for each in at]
        found[name] = np.stack(gap, axis=1)
    return found


def _loose(scene: Replay) -> dict[str, int]:
    """The bodies with a free joint that are no robot's, by name."""
    model, own = scene.model, {robot.body for robot in scene.robots}
    free = model.jnt_bodyid[model.jnt_type == _mujoco().mjtJoint.mjJNT_FREE]
    return {model.body(body).name.partition("/")[0]: int(body) for body in free if body not in own}


def _paint(model: Any, cast: Sequence[Performer]) -> None:
    """Whatever has a team's colour gets that of who plays there; all at once, lest a new colour is painted over."""
    for colours in (model.geom_rgba, model.mat_rgba):
        before = colours[:, :3].copy()
        for side, who in enumerate(cast):
            teams = np.abs(before - team_colour(side)).max(axis=1, initial=0) < 0.005
            colours[teams, :3] = np.array(who.colour) / 255


def _robots(model: Any, recording: Recording, xpos: np.ndarray) -> Iterator[Robot]:
    """The agents that have a body, the base of each and how large it is."""
    names = {body: model.body(body).name for body in range(1, model.nbody)}
    for side, agents in enumerate(recording.header.agents):
        for agent in agents:
            own = [body for body, name in names.items() if name.startswith(f"{agent}/")]
            if own:
                geoms = [g for body in own for kind in visible_geoms(model, body).values() for g in kind]
                far = xpos[model.geom_bodyid[geoms]] - xpos[own[0]]
                reach = np.linalg.norm(far, axis=1) + np.linalg.norm(model.geom_pos[geoms], axis=1)
                half = 0.5 * model.geom_rbound[geoms]  # a sphere round a box reaches farther than most of the box
                yield Robot(agent, side, own[0], float((reach + half).max(initial=0.05)))


def _radius(recording: Recording, xpos: np.ndarray) -> float:
    kinds, markers = recording.header.marker_kinds, recording.markers
    circles = [markers[name] for name, kind in kinds.items() if kind == "circle"]
    reach = [np.hypot(circle[:, 0], circle[:, 1]) + circle[:, 2] for circle in circles]
    if not reach:
        balls = [markers[name][:1] for name, kind in kinds.items() if kind in ("sphere", "ball")]
        reach = [1.2 * np.hypot(at[:, 0], at[:, 1]) for at in (xpos[0], *balls)]
    return max(0.5, float(np.nanmax(np.concatenate(reach))))


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
