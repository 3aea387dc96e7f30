"""The whole state of a game as one vector, which a critic may see in training although no robot does.

It describes the motion of every body in the world frame, for any game:

| part           | numbers | unit           |                                                                   |
|----------------|---------|----------------|-------------------------------------------------------------------|
| place          | 3       | m              |                                                                   |
| ahead, up      | 3 each  |                | the body's own axes; unlike quaternions they are unique            |
| joints         |         | rad or m       | an angle without limits, as a wheel's, as its sine and cosine     |
| velocity       | 3       | m/s            |                                                                   |
| spin           | 3       | rad/s          | in the body's own frame                                           |
| joint speeds   |         | 10 rad/s, 10 m/s | wheels are fast, and networks want numbers near 1               |
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from arenas.description import Part
from arenas.physics.engine import Physics
from arenas.scene.scene import Scene

JOINT_SPEED = 10.0  # rad/s or m/s
FREE, BALL, HINGE = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL, mujoco.mjtJoint.mjJNT_HINGE


class PrivilegedState:
    """Everything that moves in a scene; `parts` describes the bodies' numbers in `read`."""

    def __init__(self, scene: Scene):
        found = [each for name in (*scene.agents, *scene.props) for each in _of(scene.model, name)]
        self.parts = tuple(part for part, _ in found)
        self._reads = [read for _, read in found]

    def read(
        self, physics: Physics, alive: Array | None, game: Any, actions: Mapping[str, Array], left: Array
    ) -> Array:
        """Return the numbers of `parts_of`, (size,). `alive` (agents,) bool, None if agents cannot leave; `left` ()
        share of time.
        """
        found = [read(physics) for read in self._reads]
        found += [] if alive is None else [alive]
        found += [jnp.ravel(value) for _, value in _numbers_of(game)]
        return jnp.concatenate([*found, *actions.values(), left[None]]).astype(jnp.float32)

    def parts_of(self, mortal: bool, game: Any, actions: Mapping[str, int]) -> tuple[Part, ...]:
        """Describe bodies, agents in the game, the game's own numbers, the last actions of these sizes, and the time
        left.

        `game` holds arrays or their shapes.
        """
        return (
            *self.parts,
            *([Part("alive", len(actions), "", "1: in the game; 0: out of it")] if mortal else ()),
            *(Part(name, value.size, "", "the game's own") for name, value in _numbers_of(game) if value.size),
            *(Part(f"{agent} action", size, "", "the latest") for agent, size in actions.items()),
            Part("time left", 1, "", "share of the longest episode"),
        )


def _numbers_of(game: Any) -> list[tuple[str, Any]]:
    """Return a game's own numbers by name; random keys are left out."""
    leaves = jax.tree_util.tree_leaves_with_path(game)
    named = [(jax.tree_util.keystr(path, simple=True, separator="/"), leaf) for path, leaf in leaves]
    return [(f"game {name}".strip(), x) for name, x in named if not jnp.issubdtype(x.dtype, jax.dtypes.prng_key)]


def _of(model: mujoco.MjModel, name: str) -> Iterator[tuple[Part, Callable[[Physics], Array]]]:
    """Yield the parts of one robot or prop that can move, each with its reader."""
    joints = [model.joint(i) for i in range(model.njnt) if model.joint(i).name.startswith(f"{name}/")]
    free = [j for j in joints if j.type[0] == FREE]
    rest = [j for j in joints if j.type[0] != FREE]
    for number, joint in enumerate(free):
        body = name if len(free) == 1 else f"{name} {number}"
        at, moves = int(joint.qposadr[0]), int(joint.dofadr[0])
        yield Part(f"{body} place", 3, "m"), _slice("qpos", at, 3)
        for axis, what in ((0, "ahead"), (2, "up")):
            yield Part(f"{body} {what}", 3, "", "its own axis in the world"), _axis(at + 3, axis)
        yield Part(f"{body} velocity", 3, "m/s", "in the world"), _slice("qvel", moves, 3)
        yield Part(f"{body} spin", 3, "rad/s", "about its own axes"), _slice("qvel", moves + 3, 3)
    angles = [j.qposadr[0] + i for j in rest if not _endless(model, j) for i in range(4 if j.type[0] == BALL else 1)]
    if angles:
        yield Part(f"{name} joints", len(angles), "rad or m"), _picked("qpos", angles)
    turns = np.array([j.qposadr[0] for j in rest if _endless(model, j)], int)
    if turns.size:
        part = Part(f"{name} wheels", 2 * len(turns), "", "joints without limits: sines, then cosines of their angles")
        yield part, lambda physics: jnp.concatenate([jnp.sin(physics.qpos[turns]), jnp.cos(physics.qpos[turns])])
    speeds = [j.dofadr[0] + i for j in rest for i in range(3 if j.type[0] == BALL else 1)]
    if speeds:
        unit = f"{JOINT_SPEED:g} rad/s or m/s"
        yield Part(f"{name} joint speeds", len(speeds), unit), _picked("qvel", speeds, JOINT_SPEED)


def _endless(model: mujoco.MjModel, joint: Any) -> bool:
    return joint.type[0] == HINGE and not model.jnt_limited[joint.id]


def _slice(field: str, start: int, size: int) -> Callable[[Physics], Array]:
    return lambda physics: getattr(physics, field)[start : start + size]


def _picked(field: str, index: list[int], unit: float = 1.0) -> Callable[[Physics], Array]:
    at = np.array(index, int)
    return lambda physics: getattr(physics, field)[at] / unit


def _axis(at: int, axis: int) -> Callable[[Physics], Array]:
    """Return a reader of one column of the rotation matrix of the quaternion (w first) at an index of qpos."""

    def read(physics: Physics) -> Array:
        w, x, y, z = physics.qpos[at : at + 4]
        if axis == 0:
            return jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
        return jnp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])

    return read
