"""A recorded match as bodies in the world: everything there is to draw. Only MuJoCo and numpy are needed."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dashboards.errors import ViewerError
from dashboards.identity import MatchPlayer, anonymous_players, team_colour
from storage.recordings.recording import Recording

FORCE_LENGTH = 1.5  # of a segment for the largest force, in sizes of the largest robot
FIRST_COLLISION_GROUP = 3  # MuJoCo's own viewer hides geom groups 3 to 5 too
FEW = 3  # robots of a side that all have a label


@dataclass(frozen=True)
class Robot:
    """One robot of a side."""

    agent: str  # e.g. "blue/0"
    side: int
    body: int  # its base
    size: float  # m from its base to its farthest visible point, at the start of the match


@dataclass(frozen=True, eq=False)
class Replay:
    """Every body's pose in the world at every step, and the players."""

    model: Any  # MjModel, in the players' colours
    xpos: np.ndarray  # (T, nbody, 3) m
    xquat: np.ndarray  # (T, nbody, 4) wxyz
    radius: float  # m, distance from the origin within which everything visible lies
    players: tuple[MatchPlayer, ...]  # by side
    robots: tuple[Robot, ...]  # the robots that have a body

    @property
    def labelled(self) -> tuple[Robot, ...]:
        """The robots with their player's label: all of a small side; of a swarm, which labels would hide, the first."""
        sizes = Counter(robot.side for robot in self.robots)
        first = {side: next(robot for robot in self.robots if robot.side == side) for side in sizes}
        return tuple(robot for robot in self.robots if sizes[robot.side] <= FEW or robot is first[robot.side])

    def label(self, robot: Robot) -> np.ndarray:
        """Return the positions (T, 3) of a robot's label in m, high enough to leave the robot visible from afar."""
        return self.xpos[:, robot.body] + [0, 0, self.label_height(robot)]

    def label_height(self, robot: Robot) -> float:
        """Return the height of a robot's label above its base, m."""
        return 1.2 * robot.size + 0.05 * self.radius


def replay(recording: Recording, players: Sequence[MatchPlayer] | None = None) -> Replay:
    """Compute all bodies' poses from the recorded joint positions, and paint the robots in their players' colours.

    Raises ViewerError where the joint positions do not fit the recording's own arena.
    """
    mujoco = _mujoco()
    try:
        model = mujoco.MjModel.from_xml_string(recording.xml)
    except ValueError as error:
        raise ViewerError(f"the recording's model cannot be read by MuJoCo: {' '.join(str(error).split())}") from error
    if recording.qpos.shape[1] != model.nq:
        raise ViewerError(f"the recording has {recording.qpos.shape[1]} joint positions, its arena {model.nq}")
    data = mujoco.MjData(model)
    xpos = np.empty((recording.steps, model.nbody, 3))
    xquat = np.empty((recording.steps, model.nbody, 4))
    for t, qpos in enumerate(recording.qpos):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        xpos[t], xquat[t] = data.xpos, data.xquat
    known = tuple(players or anonymous_players(recording.header))
    _paint(model, known)
    robots = tuple(_robots(model, recording, xpos[0]))
    return Replay(model, xpos, xquat, _radius(recording, xpos), known, robots)


def distances(recording: Recording, scene: Replay) -> dict[str, np.ndarray]:
    """Return the distance of each team's nearest robot to objects, (T, teams) in m, by the object's name.

    "edge" is the distance to the ring's edge, from inside. Other circles go by their names, and so do free bodies that
    belong to no robot (a ball, a block), of which the centre counts.
    """
    found = {}
    at = [scene.xpos[:, [r.body for r in scene.robots if r.side == side]] for side in range(len(scene.players))]
    if not all(robots.shape[1] for robots in at):
        return {}
    for name, kind in recording.header.marker_kinds.items():
        if kind == "circle":
            x, y, radius = (recording.markers[name][:, None, i] for i in range(3))
            away = [np.hypot(each[..., 0] - x, each[..., 1] - y) - radius for each in at]
            inside = name == "ring"
            gap = [(-each if inside else each).min(axis=1) for each in away]
            found["edge" if inside else name] = np.stack(gap, axis=1)
    for name, body in loose_bodies(scene).items():
        gap = [np.linalg.norm(each - scene.xpos[:, [body]], axis=-1).min(axis=1) for each in at]
        found[name] = np.stack(gap, axis=1)
    return found


def drawn_markers(recording: Recording, scene: Replay) -> dict[str, tuple[str, np.ndarray]]:
    """Return what is drawn beside bodies: name -> kind and values (T, m), as `Arena.marker_kinds` describes them.

    A force is a segment from its body along the force, FORCE_LENGTH sizes of the largest robot long for the largest
    force.
    """
    length = FORCE_LENGTH * max((robot.size for robot in scene.robots), default=scene.radius)
    found = {}
    for name, kind in recording.header.marker_kinds.items():
        values = recording.markers[name]
        if kind == "force":
            kind, values = "segment", _force(scene, name, values, length)
        found[name] = kind, values
    return found


def _force(scene: Replay, name: str, values: np.ndarray, length: float) -> np.ndarray:
    """Return segments (T, 6) from a body along forces and the largest possible one, values (T, 4).

    A force may be larger than that of actions of 1, where it does not grow with them. Raises ViewerError for a body
    that is not there.
    """
    body = _mujoco().mj_name2id(scene.model, _mujoco().mjtObj.mjOBJ_BODY, name)
    if body < 0 or values.shape[1] != 4:
        raise ViewerError(f"the recording's force on {name!r} has {values.shape[1]} numbers of 4, or no such body")
    force = np.nan_to_num(values[:, :3])
    most = max(float(np.linalg.norm(force, axis=1).max()), float(np.nan_to_num(values[:, 3]).max()), 1e-9)
    begins = scene.xpos[:, body]
    return np.concatenate([begins, begins + length * force / most], axis=1)


def loose_bodies(scene: Replay) -> dict[str, int]:
    """Return the bodies with a free joint that belong to no robot, by name."""
    model, own = scene.model, {robot.body for robot in scene.robots}
    free = model.jnt_bodyid[model.jnt_type == _mujoco().mjtJoint.mjJNT_FREE]
    return {model.body(body).name.partition("/")[0]: int(body) for body in free if body not in own}


def _paint(model: Any, players: Sequence[MatchPlayer]) -> None:
    """Replace each team's colour by its player's colour; all at once, so that no new colour is painted over."""
    for colours in (model.geom_rgba, model.mat_rgba):
        before = colours[:, :3].copy()
        for side, who in enumerate(players):
            teams = np.abs(before - team_colour(side)).max(axis=1, initial=0) < 0.005
            colours[teams, :3] = np.array(who.colour) / 255


def _robots(model: Any, recording: Recording, xpos: np.ndarray) -> Iterator[Robot]:
    """Yield the agents that have a body, with its base and size."""
    names = {body: model.body(body).name for body in range(1, model.nbody)}
    for side, agents in enumerate(recording.header.agents):
        for agent in agents:
            own = [body for body, name in names.items() if name.startswith(f"{agent}/")]
            if own:
                geoms = [g for body in own for kind in visible_geoms(model, body).values() for g in kind]
                far = xpos[model.geom_bodyid[geoms]] - xpos[own[0]]
                reach = np.linalg.norm(far, axis=1) + np.linalg.norm(model.geom_pos[geoms], axis=1)
                half = 0.5 * model.geom_rbound[geoms]  # a bounding sphere of a box is larger than most of the box
                yield Robot(agent, side, own[0], float((reach + half).max(initial=0.05)))


def _radius(recording: Recording, xpos: np.ndarray) -> float:
    kinds, markers = recording.header.marker_kinds, recording.markers
    circles = [markers[name] for name, kind in kinds.items() if kind == "circle"]
    reach = [np.hypot(circle[:, 0], circle[:, 1]) + circle[:, 2] for circle in circles]
    if not reach:
        balls = [markers[name][:1] for name, kind in kinds.items() if kind in ("sphere", "ball")]
        lines = [
            markers[name][:1]
            for name, kind in kinds.items()
            if kind == "segment" and not np.ptp(markers[name], 0).any()
        ]
        middles = [(line[:, :3] + line[:, 3:]) / 2 for line in lines]  # of lines that never move, such as a goal's
        reach = [1.2 * np.hypot(at[:, 0], at[:, 1]) for at in (xpos[0], *balls, *middles)]
    return max(0.5, float(np.nanmax(np.concatenate(reach))))


def visible_geoms(model: Any, body: int) -> dict[str, list[int]]:
    """Return a body's visible geoms by kind of shape, e.g. {"box": [3], "capsule": [4, 5]}."""
    geom_type = _mujoco().mjtGeom
    kinds: dict[str, list[int]] = defaultdict(list)
    for geom in np.flatnonzero(model.geom_bodyid == body):
        if model.geom_group[geom] < FIRST_COLLISION_GROUP and model.geom_rgba[geom, 3] > 0:
            kinds[geom_type(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()].append(int(geom))
    return dict(kinds)


def rgba(model: Any, geoms: list[int]) -> np.ndarray:
    """Return colours as bytes (n, 4). As in MuJoCo, a geom's own colour overrides its material's unless it is default
    grey.
    """
    colours = model.geom_rgba[geoms].copy()
    for i, geom in enumerate(geoms):
        if model.geom_matid[geom] >= 0 and np.allclose(colours[i], (0.5, 0.5, 0.5, 1)):
            colours[i] = model.mat_rgba[model.geom_matid[geom]]
    return np.round(colours * 255).astype(np.uint8)


def rotate(quaternions: np.ndarray, vectors: Any) -> np.ndarray:
    """Rotate vectors (n, 3) or (3,) by unit quaternions (n, 4), wxyz: v + 2w (u × v) + 2u × (u × v)."""
    w, u = quaternions[:, :1], quaternions[:, 1:]
    cross = np.cross(u, np.broadcast_to(vectors, u.shape))
    return vectors + 2 * (w * cross + np.cross(u, cross))


def _mujoco() -> Any:
    import mujoco  # late, because it loads slowly, and as Any, because its type stubs are incomplete

    return mujoco
