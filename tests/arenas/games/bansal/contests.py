"""Bodies of Bansal et al.'s games put down by hand."""

from dataclasses import replace

import jax.numpy as jnp
import mujoco
import numpy as np

import arenas
from arenas.games.bansal.match import Contest, GameState
from arenas.physics.engine import Physics
from arenas.state import Verdict
from tests.arenas.hooks import judging


def built(name: str, **rules) -> Contest:
    """The arena of that name with these rules, on the C engine."""
    settings = arenas.settings(name)
    return replace(settings, rules=replace(settings.rules, **rules)).build(engine="c", threads=1)


def put(arena: Contest, bases, ball=None, time=1.0) -> Physics:
    """Both bodies at rest by team, each (x, y, z) or (x, y, z, heading); `ball` (x, y, velocity along x)."""
    model, qpos, qvel = arena.scene.model, arena.scene.rest.copy(), np.zeros(arena.scene.model.nv)
    for at, base in zip(arena.bodies_at, bases, strict=True):
        x, y, z, heading = (*base, 0.0)[:4]
        qpos[at.qpos : at.qpos + 7] = [x, y, z, np.cos(heading / 2), 0, 0, np.sin(heading / 2)]
    if ball is not None:
        at = arena.scene.props["ball"]
        qpos[at.qpos : at.qpos + 2], qvel[at.qvel] = ball[:2], ball[2]
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    numbers = (jnp.asarray(x, jnp.float32) for x in (qpos, qvel, np.zeros(model.nu), time))
    places = {"xpos": jnp.asarray(data.xpos, jnp.float32), "xquat": jnp.asarray(data.xquat, jnp.float32)}
    return Physics(*numbers, causes=jnp.zeros((), jnp.uint8), carry=(), **places)


def state(arena: Contest, own=(), second_first=False) -> GameState:
    """The game's state, with no actions."""
    return GameState(jnp.asarray(second_first), jnp.zeros((2, arena.robot.action_size)), own)


def judged(arena: Contest, bases, own=(), second_first=False, ball=None, time=1.0) -> Verdict:
    """The verdict on bodies that stay where they are."""
    now = put(arena, bases, ball, time)
    return judging(arena)(now, now, state(arena, own, second_first))[1]


def outcome(verdict: Verdict) -> tuple:
    """Score if it is over, else nothing, and the rewards by team."""
    score = tuple(np.asarray(verdict.score).tolist()) if bool(verdict.terminated) else None
    return score, tuple(np.asarray(verdict.reward).tolist())
