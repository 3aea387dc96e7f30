"""Pictures of a match by MuJoCo's own ray casting, which need no graphics driver, no display and no window.

Rays are cast only where a body may be visible: the ground's colour is computed once for each camera, and a geom lies
within its bounding sphere. Light comes from far above, with shadows on the ground; there are no reflections.
"""

from typing import Any

import numpy as np

from dashboards.replay import FIRST_COLLISION_GROUP, Replay, rgba
from dashboards.viewer.camera import Camera

GROUND, GRID, SKY = np.array([[84, 89, 98], [104, 109, 118], [17, 21, 30]], np.float32)
SUN = np.array([-0.35, -0.45, 0.82])  # towards the light
AMBIENT, SHADOW = 0.45, 0.62  # factors of a colour without direct light
_SEEN = np.array([group < FIRST_COLLISION_GROUP for group in range(6)], np.uint8)


class Raycaster:
    """Pictures of one replay from one camera."""

    def __init__(self, scene: Replay, camera: Camera, spacing: float):
        """Prepare the background; `spacing` is the distance of the lines on the ground, m."""
        self.scene, self.camera = scene, camera
        self._data = _mujoco().MjData(scene.model)
        model = scene.model
        planes = model.geom_type == _mujoco().mjtGeom.mjGEOM_PLANE
        self._solid = np.flatnonzero(~planes & (model.geom_group < FIRST_COLLISION_GROUP) & (model.geom_rgba[:, 3] > 0))
        self._colours = rgba(model, list(range(model.ngeom)))[:, :3].astype(float)
        self._ground = camera.ground()
        self._background = self._paint_ground(spacing)

    def pose(self, qpos: np.ndarray) -> None:
        """Move the bodies to joint positions (nq,)."""
        self._data.qpos[:] = qpos
        _mujoco().mj_kinematics(self.scene.model, self._data)

    def ground(self) -> np.ndarray:
        """Return the picture (height, width, 3) of ground and sky, with the robots' shadows."""
        picture = self._background.copy()
        rows, columns = np.nonzero(self._near(self._shadow_centres()) & np.isfinite(self._ground[..., 0]))
        if rows.size:
            sun = 100 * self.scene.radius * SUN
            way = np.pad(self._ground[rows, columns].astype(float), ((0, 0), (0, 1))) - sun
            far = np.linalg.norm(way, axis=1)
            hit, distance, _ = self._cast(sun, way / far[:, None])
            dark = np.isin(hit, self._solid) & (distance < far - 1e-3)
            picture[rows[dark], columns[dark]] *= SHADOW
        return picture

    def bodies(self) -> tuple[np.ndarray, np.ndarray]:
        """Return colours (height, width, 3), and a mask (height, width) of the pixels that show a body."""
        rows, columns = np.nonzero(self._near(self._data.geom_xpos[self._solid]))
        picture, there = np.zeros_like(self._background), np.zeros(self._background.shape[:2], bool)
        if rows.size:
            hit, _, normal = self._cast(self.camera.eye, self.camera.rays(rows, columns))
            seen = np.isin(hit, self._solid)
            light = AMBIENT + (1 - AMBIENT) * np.clip(normal[seen] @ SUN, 0, 1)
            picture[rows[seen], columns[seen]] = self._colours[hit[seen]] * light[:, None]
            there[rows[seen], columns[seen]] = True
        return picture, there

    def _cast(self, eye: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return for each ray (n, 3) the first geom (n,) or -1, its distance (n,) and its surface normal (n, 3)."""
        n = len(rays)
        hit, far, normal = np.empty(n, np.int32), np.empty(n), np.empty(3 * n)
        _mujoco().mj_multiRay(
            self.scene.model, self._data, eye, np.ascontiguousarray(rays).ravel(), _SEEN, 1, -1, hit, far, normal, n,
            1e6,
        )  # fmt: skip
        return hit, far, normal.reshape(n, 3)

    def _shadow_centres(self) -> np.ndarray:
        """Return the ground points (n, 3) of the shadows of the bodies' centres."""
        at = self._data.geom_xpos[self._solid]
        return at - at[:, 2:] / SUN[2] * SUN

    def _near(self, centres: np.ndarray) -> np.ndarray:
        """Return a mask (height, width) of the pixels in squares around spheres of the geoms' size at these centres."""
        column, row, ahead = self.camera.project(centres).T
        reach = 1.5 * self.scene.model.geom_rbound[self._solid] * self.camera.focus / np.maximum(ahead, 1e-6)
        near, (w, h) = np.zeros(self._background.shape[:2], bool), self.camera.size
        for x, y, r, z in zip(column, row, reach, ahead, strict=True):
            if z > 0:
                near[max(0, int(y - r)) : min(h, int(y + r) + 2), max(0, int(x - r)) : min(w, int(x + r) + 2)] = True
        return near

    def _paint_ground(self, spacing: float) -> np.ndarray:
        """Return the colour (height, width, 3) of ground and sky without bodies."""
        off = np.abs((self._ground + spacing / 2) % spacing - spacing / 2).min(axis=-1, keepdims=True)
        far = np.linalg.norm(self._ground, axis=-1) / self.scene.radius
        fade = np.where(np.isnan(far), 1.0, np.clip((far - 1.5) / 5, 0, 1)).astype(np.float32)[..., None]
        ground = np.where(off < 0.02 * spacing, GRID, GROUND)
        return (1 - fade) * ground + fade * SKY


def _mujoco() -> Any:
    import mujoco  # late, as in `dashboards.replay`

    return mujoco
