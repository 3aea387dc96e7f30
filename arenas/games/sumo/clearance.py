"""Height of an ANYmal's torso, thighs and feet above the ground, from its pose and joint angles alone.

On an open plane the lowest point of a capsule or a sphere decides its contact, so no contact needs to be read from the
engine. The legs' kinematics are a few sines in the arena's own program. To derive `xpos` and `xquat` instead would cost
one more call per control step: on Warp a pass of kernels over all bodies, in C a callback that also collides.
`tests/arenas/games/test_sumo_walk.py` compares it with MuJoCo's own geometry.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.robots.anymal import (
    FOOT_AT,
    FOOT_RADIUS,
    HIP_AT,
    LEGS,
    SHANK_AT,
    THIGH_AT,
    THIGH_AXIS,
    THIGH_RADIUS,
    TORSO_HALF,
    TORSO_RADIUS,
    TORSO_SIDE,
)
from arenas.robots.kinematics import Heights
from arenas.robots.rotations import into_body

_MIRROR = np.array([(*leg, 1) for leg in LEGS.values()], np.float32)  # (4, 3), from the left front leg to each
_TORSO = np.array([(x, y, 0.0) for x in (-TORSO_HALF, TORSO_HALF) for y in (-TORSO_SIDE, TORSO_SIDE)], np.float32)


def clearance(pose: Array, angles: Array) -> Heights:
    """Return the heights of an ANYmal's torso, thighs (its limbs, 4) and feet (4), from its base pose (7,) and joint
    angles (12,), both as in `Body`; legs LF, LH, RF, RH.
    """
    up = into_body(pose[3:], jnp.array([0.0, 0.0, 1.0]))  # the world's z in the base's frame

    def height(points: Array) -> Array:
        """Return world z (...,) of points (..., 3) in the base's frame, without a matrix product, which GPUs would
        round.
        """
        return pose[2] + jnp.sum(points * up, axis=-1)

    abduction, hip, knee = angles.reshape(3, 4)
    thigh_ends = jnp.stack([_from_thigh(abduction, hip, _mirrored(end)) for end in THIGH_AXIS])  # (2, legs, 3)
    feet = _from_thigh(abduction, hip, _mirrored(SHANK_AT) + _about_y(knee, _mirrored(FOOT_AT)))
    return Heights(
        height(jnp.asarray(_TORSO)).min() - TORSO_RADIUS,
        height(thigh_ends).min(axis=0) - THIGH_RADIUS,
        height(feet) - FOOT_RADIUS,
    )


def _from_thigh(abduction: Array, hip: Array, points: Array) -> Array:
    """Transform points (4, 3) from the frames of the four thighs into the base's frame."""
    return _mirrored(HIP_AT) + _about_x(abduction, _mirrored(THIGH_AT) + _about_y(hip, points))


def _mirrored(point: tuple[float, float, float]) -> Array:
    """Mirror a point of the left front leg to all four legs (4, 3)."""
    return jnp.asarray(_MIRROR * np.array(point, np.float32))


def _about_x(angle: Array, points: Array) -> Array:
    c, s, (x, y, z) = jnp.cos(angle), jnp.sin(angle), points.T
    return jnp.stack([x, c * y - s * z, s * y + c * z], axis=1)


def _about_y(angle: Array, points: Array) -> Array:
    c, s, (x, y, z) = jnp.cos(angle), jnp.sin(angle), points.T
    return jnp.stack([c * x + s * z, y, c * z - s * x], axis=1)
