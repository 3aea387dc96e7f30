"""Pictures of a match by MuJoCo's own ray casting, which need no graphics driver, no display and no window.

Rays are cast only where a body may be visible: the ground's colour is computed once for each camera, and a geom lies
within its bounding sphere. Light comes from far above, with shadows on the ground; there are no reflections.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from dashboards.replay import EYE, FIRST_COLLISION_GROUP, TARGET, Replay, rgba

FIELD_OF_VIEW = math.radians(48)  # of the picture's height
GROUND, GRID, SKY = np.array([[84, 89, 98], [104, 109, 118], [17, 21, 30]], np.float32)
SUN = np.array([-0.35, -0.45, 0.82])  # towards the light
AMBIENT, SHADOW = 0.45, 0.62  # factors of a colour without direct light
_SEEN = np.array([group < FIRST_COLLISION_GROUP for group in range(6)], np.uint8)


@dataclass(frozen=True)
class Camera:
    """The camera of a picture of `size` (width, height) pixels; lengths in metres."""

    eye: np.ndarray  # (3,)
    axes: np.ndarray  # (3, 3) right, up, forward
    size: tuple[int, int]

    @classmethod
    def framing(cls, centre: np.ndarray, radius: float, size: tuple[int, int]) -> "Camera":
        """Return the camera that sees everything within `radius` of a centre (3,), in the view direction of `league
        watch`.
        """
        eye, forward = centre + EYE * radius, (TARGET - EYE) / np.linalg.norm(TARGET - EYE)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        return cls(eye, np.stack([right, np.cross(right, forward), forward]), size)

    @property
    def focus(self) -> float:
        """The focal length in pixels: the offset from the middle of a point that is as far sideways as it is ahead."""
        return self.size[1] / 2 / math.tan(FIELD_OF_VIEW / 2)

    def rays(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return unit vectors (n, 3) through the centres of pixels."""
        x, y = columns + 0.5 - self.size[0] / 2, self.size[1] / 2 - rows - 0.5
        ahead = np.stack([x, y, np.full(len(x), self.focus)], axis=-1) @ self.axes
        return ahead / np.linalg.norm(ahead, axis=-1, keepdims=True)

    def ground(self) -> np.ndarray:
        """Return the ground point (height, width, 2) seen at each pixel, nan for the sky. Pixel rows are horizontal."""
        w, h = self.size
        right, up, forward = self.axes
        row = (h / 2 - np.arange(h) - 0.5)[:, None] * up + self.focus * forward
        far = np.where(row[:, 2] < -1e-3 * self.focus, -self.eye[2] / row[:, 2], np.nan)[:, None, None]
        across = (np.arange(w) + 0.5 - w / 2)[None, :, None] * right[:2]
        return (self.eye[:2] + far * (row[:, None, :2] + across)).astype(np.float32)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return pixel column, pixel row and distance ahead (n, 3) of points (n, 3); the distance is below 0 behind the
        camera.
        """
        right, up, ahead = ((points - self.eye) @ self.axes.T).T
        scale = self.focus / np.maximum(ahead, 1e-6)
        return np.stack([self.size[0] / 2 + right * scale, self.size[1] / 2 - up * scale, ahead], axis=-1)


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
