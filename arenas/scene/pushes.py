"""Forces from outside: which bodies of a scene are pushed, and the sum of the forces of all agents that push."""

import difflib
from collections.abc import Mapping

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from arenas.errors import ArenaError
from arenas.robots.robot import Push, Robot


class Pushes:
    """The pushes of a scene's agents; `bodies` are the ids of all bodies that any of them pushes, each once."""

    def __init__(self, model: mujoco.MjModel, robots: Mapping[str, Robot]):
        """Find the bodies. Raises ArenaError, one line, for a body that is not in the model."""
        self._of: dict[str, Push] = {agent: robot.push for agent, robot in robots.items() if robot.push}
        names = [name for push in self._of.values() for name in push.bodies]
        ids = {name: _body(model, name) for name in names}
        self.bodies: tuple[int, ...] = tuple(sorted(set(ids.values())))
        self._rows = {
            agent: np.array([self.bodies.index(ids[name]) for name in push.bodies], int)
            for agent, push in self._of.items()
        }
        self.names: tuple[str, ...] = tuple(model.body(body).name for body in self.bodies)
        most = self.total({agent: jnp.ones(robots[agent].action_size) for agent in self._of})
        self._most = None if most is None else jnp.linalg.norm(most[:, :3], axis=1)

    def total(self, actions: Mapping[str, Array]) -> Array | None:
        """Return the forces and torques (bodies, 6) in N and N·m, in the world frame; None if nobody pushes."""
        if not self._of:
            return None
        total = jnp.zeros((len(self.bodies), 6))
        for agent, push in self._of.items():
            total = total.at[self._rows[agent]].add(push.wrench(actions[agent]))
        return total

    def markers(self, push: Array | None) -> dict[str, Array]:
        """Return by the names of the pushed bodies their forces in N, and those of actions of 1: x, y, z, most.

        `push` is what `total` returned.
        """
        if push is None or self._most is None:
            return {}
        values = jnp.concatenate([push[:, :3], self._most[:, None]], axis=1)
        return {name: values[row] for row, name in enumerate(self.names)}


def _body(model: mujoco.MjModel, name: str) -> int:
    known = [model.body(i).name for i in range(1, model.nbody)]
    if name not in known:
        near = difflib.get_close_matches(name, known, 1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise ArenaError(f"no body {name!r} to push: {hint}(bodies: {', '.join(known) or 'none'})")
    return int(model.body(name).id)
