"""The camera of pictures, films and the 3D viewer: its place, and what it sees."""

import math
from dataclasses import dataclass

import numpy as np

from dashboards.replay import Replay, visible_geoms

EYE, TARGET = np.array([0.4, -1.6, 1.25]), np.array([0.0, -0.1, 0.0])  # of the camera, in radii of what it frames
FIELD_OF_VIEW = math.radians(48)  # of the picture's height; rerun's is larger
FARTHEST = 2.0  # times the distance from which a region fills the picture


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


def framed_radius(scene: Replay, centre: np.ndarray, radius: float) -> float:
    """Return the radius to frame around a region's centre (3,), so that bodies, as they start, do not end above the
    picture: the region's own, or up to FARTHEST times as much.
    """
    model = scene.model
    geoms = [geom for body in range(1, model.nbody) for kind in visible_geoms(model, body).values() for geom in kind]
    tops = scene.xpos[0, model.geom_bodyid[geoms]]
    tops = tops + [0.0, 0.0, 1.0] * (np.linalg.norm(model.geom_pos[geoms], axis=1) + model.geom_rbound[geoms])[:, None]
    radii = radius * np.linspace(1.0, FARTHEST, 11)
    rows = (Camera.framing(centre, each, (2, 2)).project(tops)[:, 1] for each in radii)
    return float(next((each for each, row in zip(radii, rows, strict=True) if (row >= 0).all()), radii[-1]))
