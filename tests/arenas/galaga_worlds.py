"""Tanks and drones put down by hand, for the tests of 3D Galaga."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

import arenas
from arenas.games.galaga.match import GameState
from arenas.physics.engine import Physics

PIVOT = 0.05 + 0.06  # m above the ground, of a tank that stands


def variant(name, defects=None, **rules):
    """An arena on the C engine with other rules; `defects` are those to be reproduced. Other settings by their name."""
    settings = arenas.settings(name)
    own = {key: rules.pop(key) for key in list(rules) if hasattr(settings, key)}
    if defects:
        rules["defects"] = replace(settings.rules.defects, **dict.fromkeys(defects, True))
    return replace(settings, rules=replace(settings.rules, **rules), **own).build(engine="c")


def put(arena, drones=(), tanks=((0.0, 0.0),), barrels=((0.0, 0.0),), time=1.0, **moving):
    """Drones at (x, y, z), level; tanks at (x, y) on the ground, facing +x; barrels at (elevation, azimuth) in rad.

    Of the drones `quat`, `velocity` in the world and `rates` may be given, the same for all.
    """
    model = arena.scene.model
    qpos, qvel = arena.scene.rest.copy(), np.zeros(model.nv)
    names = list(arena.robots)
    blue, red = ([name for name in names if name.startswith(team)] for team in ("blue", "red"))
    for name, (x, y), joints in zip(blue, tanks, barrels, strict=False):
        at = arena.scene.agents[name]
        qpos[at.qpos : at.qpos + 7] = [x, y, 0.05, 1, 0, 0, 0]
        qpos[at.joint_qpos] = joints
    for name, place in zip(red, drones, strict=True):
        at = arena.scene.agents[name]
        qpos[at.qpos : at.qpos + 7] = [*place, *moving.get("quat", (1, 0, 0, 0))]
        qvel[at.qvel : at.qvel + 6] = [*moving.get("velocity", (0, 0, 0)), *moving.get("rates", (0, 0, 0))]
    total_size = (jnp.asarray(v, jnp.float32) for v in (qpos, qvel, np.zeros(model.nu), time))
    return Physics(*total_size, causes=jnp.zeros((), jnp.uint8), carry=())


def game(goals, alive=None, reached=None, pending=(False, False)):
    """A game with these goals, in which by default all live and none has arrived."""
    goals = jnp.asarray(goals, jnp.float32)
    alive, reached = alive or [True] * len(goals), reached or [False] * len(goals)
    return GameState(goals, jnp.array(alive), jnp.array(reached), jnp.array(pending))


def judged(arena, physics, playing, before=None):
    """The game after a control step, and its verdict."""
    return compiled(arena)(physics if before is None else before, physics, playing)


@cache
def compiled(arena):
    """An arena's judge, compiled once."""
    return jax.jit(arena.judge)


def ending(verdict):
    """How a verdict ends, in a word, or with whose win."""
    if verdict.truncated:
        return "cut"
    return {1.0: "tanks", 0.0: "drones", 0.5: "draw"}[float(verdict.score[0])] if verdict.terminated else ""
