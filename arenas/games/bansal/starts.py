"""Starts of Bansal et al.'s games: two bodies that face each other along x, with noise in everything."""

import jax
import jax.numpy as jnp
from jax import Array


def facing_poses(xy: Array, height: float) -> Array:
    """Return poses (2, 7) at places (2, 2) m: the first faces +x, the second -x."""
    zero, one = jnp.zeros(()), jnp.ones(())
    first = jnp.stack([xy[0, 0], xy[0, 1], jnp.asarray(height), one, zero, zero, zero])
    second = jnp.stack([xy[1, 0], xy[1, 1], jnp.asarray(height), zero, zero, zero, one])
    return jnp.stack([first, second])


def noisy(key: Array, poses: Array, joints: Array, noise: float) -> tuple[Array, Array, Array]:
    """Add noise to poses (2, 7) and joints (2, n), and draw speeds (2, 6 + n).

    As in gymnasium's ants, places, quaternions and angles change by at most `noise`, evenly, and speeds are normal with
    this standard deviation. Heights stay, so that no foot begins in the ground.
    """
    pose_key, joint_key, speed_key = jax.random.split(key, 3)
    shift = jax.random.uniform(pose_key, poses.shape, minval=-noise, maxval=noise).at[:, 2].set(0.0)
    moved = poses + shift
    quats = moved[:, 3:] / jnp.sqrt(jnp.sum(moved[:, 3:] ** 2, axis=1, keepdims=True))
    angles = joints + jax.random.uniform(joint_key, joints.shape, minval=-noise, maxval=noise)
    speeds = noise * jax.random.normal(speed_key, (2, 6 + joints.shape[1]))
    return jnp.concatenate([moved[:, :3], quats], axis=1), angles, speeds
