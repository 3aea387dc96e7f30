"""A yard with one robot and no game: what a robot's own test needs to see it move under its own law and commands."""

from collections.abc import Callable
from functools import partial
from typing import Any, Unpack

import jax
import jax.numpy as jnp
from jax import Array

from arenas.arena import Arena
from arenas.arena_settings import EngineOptions, Timing
from arenas.physics.engine import Physics
from arenas.robots.robot import Robot, Script
from arenas.state import State, Verdict

TIMING = Timing(timestep=0.005, substeps=4, hold=1, episode=30.0)


class Yard(Arena):
    """One robot, put down in its rest pose `lifted` metres above the ground. It sees its own proprioception."""

    def __init__(self, robot: Robot, lifted: float = 0.0, timing: Timing = TIMING, **where: Unpack[EngineOptions]):
        super().__init__("yard", {"solo": (robot,)}, timing, {}, **(EngineOptions(engine="c") | where))
        self.robot = robot
        self.at = self.scene.agents["solo/0"]
        self.lifted = lifted
        self._compiled: dict[tuple[Script, int], Callable[..., State]] = {}

    def observation_size(self, agent: str) -> int:
        return self.robot.proprioception_size

    def place(self, key: Array) -> tuple[Array, Array, Any]:
        """The key turns the robot's joints by up to 0.05 rad each, as no two robots stand quite alike."""
        joints = jnp.asarray(self.at.joint_qpos)
        qpos = jnp.asarray(self.scene.rest, jnp.float32).at[self.at.qpos + 2].add(self.lifted)
        qpos = qpos.at[joints].add(jax.random.uniform(key, joints.shape, minval=-0.05, maxval=0.05))
        return qpos, jnp.zeros(self.scene.model.nv), ()

    def observe(self, physics: Physics, game: Any, actions: dict[str, Array]) -> dict[str, Array]:
        return {"solo/0": self.robot.observe_self(self.body("solo/0", physics, actions))}

    def judge(self, before: Physics, physics: Physics, game: Any) -> tuple[Any, Verdict]:
        never = jnp.zeros((), bool)
        return game, Verdict({"none": jnp.zeros(1)}, {}, jnp.zeros(1), never, never, {"fall": self.fallen(physics)})

    def play(self, script: Script, seconds: float, start: State | None = None, seed: int = 0) -> State:
        """The state after each decision (T, ...) under a script, without the engine's own part."""
        decisions = round(seconds / (self.timing.control_interval * self.timing.hold))
        key = jax.random.key(seed)
        first = self.reset(key) if start is None else start
        if (script, decisions) not in self._compiled:
            self._compiled[script, decisions] = jax.jit(partial(self._run, script, decisions))
        return jax.device_get(self._compiled[script, decisions](first, key))

    def _run(self, script: Script, decisions: int, first: State, key: Array) -> State:
        def decide(state: State, key: Array) -> tuple[State, State]:
            state = self.step(state, {"solo/0": script(state.observations["solo/0"], key)})
            return state, state._replace(physics=state.physics._replace(carry=()))

        return jax.lax.scan(decide, first, jax.random.split(key, decisions))[1]

    def base(self, played: State) -> Array:
        """Base poses (T, 7) of what was played."""
        return played.physics.qpos[:, self.at.qpos : self.at.qpos + 7]


def steadily(*action: float) -> Script:
    """The script of one action for ever."""
    return lambda observation, key: jnp.asarray(action, jnp.float32)
