"""Soccer put down by hand: robots and ball where a test wants them."""

import math

import jax.numpy as jnp
import numpy as np

from arenas.physics.engine import Physics


def put(arena, poses, ball=(0.0, 0.0), rolls=(0.0, 0.0), height=None, time=1.0, flipped=(), moves=None, up=None):
    """Physics of robots at `poses` (x, y, heading) in the order of agents, and of a ball that `rolls` at (vx, vy).

    `height` is the ball's, in metres, if it does not lie on the ground; robots listed in `flipped` lie on their backs;
    `moves` and `up` are velocities (vx, vy) and heights by the robot's number.
    """
    model, scene = arena.scene.model, arena.scene
    qpos, qvel = scene.rest.copy(), np.zeros(model.nv)
    for i, (agent, (x, y, heading)) in enumerate(zip(arena.agents, poses, strict=True)):
        at = scene.agents[agent.name]
        z = (up or {}).get(i, arena.robots[agent.name].rest_height)
        quat = [0, 1, 0, 0] if i in flipped else [math.cos(heading / 2), 0, 0, math.sin(heading / 2)]
        qpos[at.qpos : at.qpos + 7] = [x, y, z, *quat]
        qvel[at.qvel : at.qvel + 2] = (moves or {}).get(i, (0.0, 0.0))
    at = scene.props["ball"]
    qpos[at.qpos : at.qpos + 2] = ball
    qpos[at.qpos + 2] = arena.rules.ball.radius if height is None else height
    qvel[at.qvel : at.qvel + 2] = rolls
    total_size = (jnp.asarray(x, jnp.float32) for x in (qpos, qvel, np.zeros(model.nu), time))
    return Physics(*total_size, causes=jnp.zeros((), jnp.uint8), carry=())
