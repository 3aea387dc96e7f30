"""Distances between two bodies of spheres and capsules, from the places of their parts, on any engine.

No engine needs to report its contacts. A capsule is a segment with a radius, a sphere one without length; other shapes
count as the capsule along their longest axis that lies inside them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from arenas.robots.rotations import into_body

SPHERE, CAPSULE, CYLINDER = (int(getattr(mujoco.mjtGeom, f"mjGEOM_{n}")) for n in ("SPHERE", "CAPSULE", "CYLINDER"))
TINY = 1e-9  # m²


class Segments(NamedTuple):
    """Segments of a body in the world."""

    start: Array  # (n, 3) m
    along: Array  # (n, 3) m, to the end
    radius: Array  # (n,) m


class BodyShape:
    """The shapes that touch of one body of a compiled model, read from `xpos` and `xquat`."""

    def __init__(self, model: mujoco.MjModel, prefix: str):
        """Collect the shapes of the geoms whose names begin with `prefix`."""
        every = [g for g in range(model.ngeom) if model.geom(g).name.startswith(prefix)]
        geoms = [g for g in every if model.geom_contype[g] or model.geom_conaffinity[g]]
        self._bodies = model.geom_bodyid[geoms]
        ends = [_ends(model, g) for g in geoms]
        self._starts = jnp.asarray(np.array([start for start, _, _ in ends]), jnp.float32)
        self._alongs = jnp.asarray(np.array([along for _, along, _ in ends]), jnp.float32)
        self._radii = jnp.asarray(np.array([radius for _, _, radius in ends]), jnp.float32)

    def segments(self, xpos: Array, xquat: Array) -> Segments:
        """Return the segments in the world, from places (nbody, 3) and quaternions (nbody, 4) of all bodies."""
        at, quat = xpos[self._bodies], xquat[self._bodies] * jnp.array([1.0, -1.0, -1.0, -1.0])
        return Segments(at + _turned(quat, self._starts), _turned(quat, self._alongs), self._radii)


def gap(one: Segments, other: Segments) -> Array:
    """Return the least distance () in metres between the surfaces of two bodies; negative if they overlap.

    The closest points of two segments: Ericson, "Real-time collision detection" (2005), section 5.1.9.
    """
    u, v = one.along[:, None], other.along[None]  # (n, 1, 3), (1, m, 3)
    w = one.start[:, None] - other.start[None]
    a, e, f, c = _dot(u, u), _dot(v, v), _dot(v, w), _dot(u, w)
    b = _dot(u, v)
    determinant = a * e - b * b
    s = jnp.where(determinant > TINY, _clamp((b * f - c * e) / jnp.maximum(determinant, TINY)), 0.0)
    t = jnp.where(e > TINY, _clamp((b * s + f) / jnp.maximum(e, TINY)), 0.0)
    s = jnp.where(a > TINY, _clamp((b * t - c) / jnp.maximum(a, TINY)), 0.0)
    apart = jnp.sqrt(_dot(*[w + s[..., None] * u - t[..., None] * v] * 2))
    return (apart - one.radius[:, None] - other.radius[None]).min()


def _ends(model: mujoco.MjModel, g: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return start, direction with length, and radius of a geom's segment in the frame of its body."""
    size, kind = model.geom_size[g], int(model.geom_type[g])
    if kind == SPHERE:
        half, axis, radius = 0.0, 2, float(size[0])
    elif kind in (CAPSULE, CYLINDER):
        half, axis, radius = float(size[1]), 2, float(size[0])
    else:
        axis = int(np.argmax(size))
        radius = float(np.delete(size, axis).min())
        half = float(size[axis]) - radius
    unit, along = np.zeros(3), np.empty(3)
    unit[axis] = 1.0
    mujoco.mju_rotVecQuat(along, unit, model.geom_quat[g])
    return model.geom_pos[g] - half * along, 2 * half * along, radius


def _turned(quats: Array, vectors: Array) -> Array:
    """Rotate vectors (n, 3) by the inverse of quaternions (n, 4)."""
    return jax.vmap(into_body)(quats, vectors)


def _dot(a: Array, b: Array) -> Array:
    return jnp.sum(a * b, axis=-1)


def _clamp(x: Array) -> Array:
    return jnp.clip(x, 0.0, 1.0)
