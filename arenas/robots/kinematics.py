"""Height of a robot's parts above the ground, from qpos alone, for any robot of hinges and slides.

On an open plane the lowest point of a shape decides its contact, so no contact needs to be read from the engine. Only
heights are computed: each body has the height of its origin and the world's up in its own frame, which joints turn. To
derive `xpos` and `xquat` instead would cost one more call per control step.
"""

from collections.abc import Collection
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from arenas.robots.rotations import into_body

FREE, SLIDE = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE)
SPHERE, CAPSULE, CYLINDER, ELLIPSOID = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in ("SPHERE", "CAPSULE", "CYLINDER", "ELLIPSOID")
)


class Heights(NamedTuple):
    """Metres from the ground at z = 0 to the lowest point of each part; negative if pressed in."""

    torso: Array  # () the base body
    limbs: Array  # (limbs,) bodies that are neither base nor feet
    feet: Array  # (feet,)


class HeightReader:
    """Reads the heights of one robot of a compiled model."""

    def __init__(self, model: mujoco.MjModel, base: int, feet: Collection[str]):
        """Prepare for the robot with this base (body id); `feet` are its bodies' names in the model."""
        self._model, self._base = model, base
        self._bodies = [i for i in range(model.nbody) if model.body_rootid[i] == base]
        touching = [g for g in range(model.ngeom) if model.geom_contype[g] or model.geom_conaffinity[g]]
        self._geoms = {i: [g for g in touching if model.geom_bodyid[g] == i] for i in self._bodies}
        self._feet = [model.body(name).id for name in feet]

    def read(self, qpos: Array) -> Heights:
        """Return the heights in a state qpos (nq,)."""
        low = {}
        frames = self._frames(qpos)
        for i, (height, up) in frames.items():
            if self._geoms[i]:
                low[i] = jnp.stack([self._lowest(g, height, up) for g in self._geoms[i]]).min()
        limbs = [low[i] for i in low if i != self._base and i not in self._feet]
        torso = low.get(self._base, jnp.asarray(jnp.inf))
        empty = jnp.zeros(0)
        return Heights(torso, jnp.stack(limbs) if limbs else empty, jnp.stack([low[i] for i in self._feet]))

    def _frames(self, qpos: Array) -> dict[int, tuple[Array, Array]]:
        """Return for each body the height of its origin () and the world's up (3,) in its own frame."""
        model = self._model
        root = int(model.body_jntadr[self._base])
        at, up = model.jnt_qposadr[root], jnp.array([0.0, 0.0, 1.0])
        frames = {0: (jnp.zeros(()), up)}
        if model.jnt_type[root] == FREE:
            frames[self._base] = qpos[at + 2], into_body(qpos[at + 3 : at + 7], up)
        for i in self._bodies:
            if i in frames:
                continue
            height, up = frames[int(model.body_parentid[i])]
            height = height + jnp.sum(up * model.body_pos[i])
            up = _into(model.body_quat[i], up)
            first = int(model.body_jntadr[i])
            for j in range(first, first + int(model.body_jntnum[i])):
                height, up = self._moved(j, qpos, height, up)
            frames[i] = height, up
        return {i: frames[i] for i in self._bodies}

    def _moved(self, j: int, qpos: Array, height: Array, up: Array) -> tuple[Array, Array]:
        """Return height and up of a body after the motion of one of its joints."""
        model = self._model
        at = int(model.jnt_qposadr[j])
        axis, anchor, by = model.jnt_axis[j], model.jnt_pos[j], qpos[at] - float(model.qpos0[at])
        if model.jnt_type[j] == SLIDE:
            return height + by * jnp.sum(up * axis), up
        c, s = jnp.cos(by), jnp.sin(by)
        # Rodrigues, backwards: the body turns by the angle, and the world's up in its frame by its negative.
        turned = c * up - s * jnp.cross(axis, up) + (1 - c) * jnp.sum(axis * up) * axis
        return height + jnp.sum((up - turned) * anchor), turned

    def _lowest(self, g: int, height: Array, up: Array) -> Array:
        """Return the height of a shape's lowest point."""
        model = self._model
        middle = height + jnp.sum(up * model.geom_pos[g])
        along, size, kind = _into(model.geom_quat[g], up), model.geom_size[g], int(model.geom_type[g])
        if kind == SPHERE:
            return middle - size[0]
        if kind == CAPSULE:
            return middle - size[0] - size[1] * jnp.abs(along[2])
        if kind == CYLINDER:
            return middle - size[0] * jnp.sqrt(along[0] ** 2 + along[1] ** 2) - size[1] * jnp.abs(along[2])
        if kind == ELLIPSOID:
            return middle - jnp.sqrt(jnp.sum((size * along) ** 2))
        return middle - jnp.sum(jnp.abs(size * along))


def _into(quat: np.ndarray, up: Array) -> Array:
    """Rotate up (3,) into a frame with this constant quaternion, without a matrix product, which GPUs would round."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return jnp.sum(jnp.asarray(matrix.reshape(3, 3).T, jnp.float32) * up, axis=1)
