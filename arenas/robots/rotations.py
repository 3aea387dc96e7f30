"""Directions from a base's quaternion, w first: up axis, heading, world vectors in the body's frame."""

import jax.numpy as jnp
from jax import Array


def up_z(quat: Array) -> Array:
    """Return world z of the body's up axis from its quaternion (4,), w first: 1 upright, -1 on its back."""
    return 1.0 - 2.0 * (quat[1] ** 2 + quat[2] ** 2)


def yaw(quat: Array) -> Array:
    """Return the heading in radians from a quaternion (4,), w first."""
    w, x, y, z = quat
    return jnp.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def into_body(quat: Array, vector: Array) -> Array:
    """Rotate a world vector (3,) into the frame of the body with this quaternion (4,), w first.

    It uses no matrix product: by default GPUs round its factors to 10 bits.
    """
    w, axis = quat[0], -quat[1:]
    turned = 2.0 * jnp.cross(axis, vector)
    return vector + w * turned + jnp.cross(axis, turned)
