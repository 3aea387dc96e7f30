"""Extents of shapes in a pose: the lowest point and the corners of the box around a geom, in the world, m."""

import itertools

import mujoco
import numpy as np

SPHERE, CAPSULE, CYLINDER, ELLIPSOID = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in ("SPHERE", "CAPSULE", "CYLINDER", "ELLIPSOID")
)


def lowest(data: mujoco.MjData, geom: int) -> float:
    """Return world z of the lowest point of a sphere, capsule, cylinder, ellipsoid or box."""
    model = data.model
    size, up = model.geom_size[geom], data.geom_xmat[geom].reshape(3, 3)[2]
    return float(data.geom_xpos[geom][2] - reach(int(model.geom_type[geom]), size, up))


def reach(kind: int, size: np.ndarray, along: np.ndarray) -> float:
    """Return how far a shape reaches from its middle along a unit vector (3,) in its own frame."""
    if kind == SPHERE:
        return float(size[0])
    if kind == CAPSULE:
        return float(size[0] + size[1] * abs(along[2]))
    if kind == CYLINDER:
        return float(size[0] * np.hypot(along[0], along[1]) + size[1] * abs(along[2]))
    if kind == ELLIPSOID:
        return float(np.linalg.norm(size * along))
    return float(np.abs(size * along).sum())


def corners(data: mujoco.MjData, geom: int) -> np.ndarray:
    """Return the corners (8, 3) in the world of the box around a geom in its own frame."""
    box = data.model.geom_aabb[geom]
    signs = np.array(list(itertools.product((-1, 1), repeat=3)))
    return data.geom_xpos[geom] + (box[:3] + signs * box[3:]) @ data.geom_xmat[geom].reshape(3, 3).T
