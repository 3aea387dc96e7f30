"""Recorded games of sumo as arrays for `experiments.role_metrics`: positions, gaps between robots, and the end."""

import jax.numpy as jnp
import mujoco
import numpy as np

from arenas.arena import Arena
from experiments.role_metrics import BODY, LIMB, REACH, TOUCH, End, Game, Track, ends, numbers
from storage.recordings.recording import Recording

INTERVAL = 0.2  # s between the moments of a track
BEFORE = 1.0  # s before the end in which a touch counts
MEETS_ROBOTS = 2  # bit of the contype of shapes that collide with other robots, see arenas.robots


class Gaps:
    """Distances between the collision shapes of an arena's robots, by MuJoCo."""

    def __init__(self, arena: Arena):
        """Find the shapes of each agent's base and limbs; those that meet the ground alone do not count."""
        model = self._model = arena.scene.model
        self._data, self._size = mujoco.MjData(model), len(arena.agents)
        shapes: list[tuple[int, int, int]] = []  # geom, agent, part
        for number, agent in enumerate(arena.agents):
            base = arena.scene.agents[agent.name].base
            for geom in range(model.ngeom):
                body = model.geom_bodyid[geom]
                if model.body_rootid[body] == base and model.geom_contype[geom] & MEETS_ROBOTS:
                    shapes.append((geom, number, BODY if body == base else LIMB))
        self._pairs = np.array([(a, b) for i, a in enumerate(shapes) for b in shapes[i:] if a[1] != b[1]])
        self._geoms = self._pairs[:, :, 0]  # (pairs, 2)
        self._spheres = model.geom_rbound[self._geoms].sum(axis=1)

    def __call__(self, qpos: np.ndarray, reach: float) -> np.ndarray:
        """Return gaps (T, A, A, 2) in m from agent i to the BODY and LIMB of agent j, from qpos (T, nq).

        They are negative where shapes overlap, and inf above `reach` or where there is no such part.
        """
        found = np.full((len(qpos), self._size, self._size, 2), np.inf)
        model, data = self._model, self._data
        for gaps, row in zip(found, qpos, strict=True):
            data.qpos[:] = row
            mujoco.mj_kinematics(model, data)
            ways = np.diff(data.geom_xpos[self._geoms], axis=1)[:, 0]
            near = np.linalg.norm(ways, axis=1) < self._spheres + reach
            for (g, i, part), (h, j, other) in self._pairs[near].tolist():
                gap = mujoco.mj_geomDistance(model, data, g, h, reach, None)
                if gap < reach:
                    gaps[i, j, other] = min(gaps[i, j, other], gap)
                    gaps[j, i, part] = min(gaps[j, i, part], gap)
        return found


class Observer:
    """Measurement of recorded games of one arena of sumo."""

    def __init__(self, arena: Arena):
        """Prepare the measurement."""
        self._robots, self._gaps = arena.robots, Gaps(arena)
        self._index = [arena.scene.agents[agent.name] for agent in arena.agents]
        self._xy = np.array([at.qpos for at in self._index])[:, None] + np.arange(2)  # (A, 2) columns of qpos
        self._team = np.array([t for t, team in enumerate(arena.teams) for _ in team.agents])
        self._kind = [agent.kind for agent in arena.agents]

    def game(self, recording: Recording, side: int, start: int) -> Game:
        """Measure a game in which policy A played team `side`, and which began as all games of the same `start`."""
        dt, found = recording.header.dt, self._ends(recording)
        moments = slice(None, None, round(INTERVAL / dt))
        qpos, radius = recording.qpos[moments], recording.markers["ring"][moments, 2]
        track = Track(
            qpos[:, self._xy], radius, self._gaps(qpos, REACH), round(INTERVAL / dt) * dt, self._team, self._kind
        )
        return Game(numbers(track), found, self._team, self._kind, side, start)

    def _ends(self, recording: Recording) -> list[End]:
        """Return how a game ended; nothing if time was up."""
        teams = list(recording.header.teams)
        events = [(step, *text.split(": ")) for step, text in recording.events if text.startswith(("out: ", "fall: "))]
        if not events:
            return []
        last = min(step for step, _, _ in events)
        out, fallen = (
            np.isin(self._team, [teams.index(team) for step, event, team in events if (step, event) == (last, name)])
            for name in ("out", "fall")
        )
        qpos, radius = recording.qpos[last], recording.markers["ring"][last, 2]
        out &= np.linalg.norm(qpos[self._xy], axis=1) > radius - 1e-5  # the game judged in float32
        robots = zip(self._robots.values(), self._index, strict=True)
        fallen &= np.array([robot.fallen(at.pose(jnp.asarray(qpos))) for robot, at in robots])
        window = recording.qpos[max(0, last + 1 - round(BEFORE / recording.header.dt)) : last + 1]
        return ends(out, fallen, self._gaps(window, 2 * TOUCH).min(axis=-1), window[:, self._xy], self._team)
