"""Arenas built and compiled once, on the C engine."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

import arenas
from arenas.games.sumo.match import Sumo
from arenas.physics.engine import Physics
from arenas.state import State


class Worlds:
    """A batch of sumo worlds with their verbs compiled."""

    def __init__(self, arena: Sumo):
        self.arena = arena
        self.reset = jax.jit(jax.vmap(arena.reset))
        self.restart = jax.jit(jax.vmap(arena.restart))
        self.step_with_frames = jax.jit(jax.vmap(arena.step_with_frames))
        self.place = jax.jit(jax.vmap(arena.engine.place))

    def step(self, state: State, actions: dict[str, Array]) -> State:
        return self.step_with_frames(state, actions)[0]

    def idle(self, worlds: int) -> dict[str, Array]:
        return {agent.name: jnp.zeros((worlds, agent.action_size)) for agent in self.arena.agents}

    def play(self, blue: str, red: str, worlds: int, seed: int = 0) -> State:
        """The state after each decision (T, worlds, ...) of whole episodes between two scripts."""
        arena, scripts = self.arena, self.arena.scripts()
        sides = zip(arena.teams, (blue, red), strict=True)
        acting = {a.name: scripts[s][a.kind] for team, s in sides for a in team.agents}

        def decision(state: State, key: Array) -> tuple[State, State]:
            actions = {
                name: jax.vmap(script)(state.observations[name], jax.random.split(jax.random.fold_in(key, i), worlds))
                for i, (name, script) in enumerate(acting.items())
            }
            state = jax.vmap(arena.step)(state, actions)
            return state, state._replace(physics=state.physics._replace(carry=()))

        @jax.jit
        def run(key: Array) -> State:
            starts, actions_key = jax.random.split(key)
            state = jax.vmap(arena.reset)(jax.random.split(starts, worlds))
            return jax.lax.scan(decision, state, jax.random.split(actions_key, arena.timing.decisions))[1]

        return jax.device_get(run(jax.random.key(seed)))


@pytest.fixture(scope="session")
def worlds() -> type[Worlds]:
    return Worlds


@pytest.fixture(scope="session")
def duel() -> Worlds:
    return Worlds(arenas.load("sumo-1v1", engine="c"))


@pytest.fixture(scope="session")
def brawl() -> Worlds:
    return Worlds(arenas.load("sumo-2v2", engine="c"))


@pytest.fixture(scope="session")
def by_team() -> Worlds:
    return Worlds(arenas.load("sumo-by-team", engine="c"))


@pytest.fixture(scope="session")
def stand() -> Callable[..., Physics]:
    """Robots put down by hand: `stand(arena, [(x, y, heading), ...], time=0.0, flipped=(), velocity={}, height={})`."""

    def stand(
        arena: Sumo, poses: Sequence[tuple[float, float, float]], time: float = 0.0, flipped: Sequence[int] = (),
        velocity: dict[int, tuple[float, float, float]] | None = None, height: dict[int, float] | None = None,
    ) -> Physics:  # fmt: skip
        """Per robot: `velocity` (world x, y, yaw rate), `height` if not at rest; `flipped` ones lie upside down."""
        model = arena.scene.model
        qpos, qvel = arena.scene.rest.copy(), np.zeros(model.nv)
        for i, (agent, (x, y, heading)) in enumerate(zip(arena.agents, poses, strict=True)):
            at = arena.scene.agents[agent.name]
            half = heading / 2
            upright, on_back = [np.cos(half), 0, 0, np.sin(half)], [0, np.cos(half), np.sin(half), 0]
            z = (height or {}).get(i, arena.robots[agent.name].rest_height)
            qpos[at.qpos : at.qpos + 7] = [x, y, z, *(on_back if i in flipped else upright)]
            vx, vy, yaw_rate = (velocity or {}).get(i, (0, 0, 0))
            qvel[at.qvel : at.qvel + 6] = [vx, vy, 0, 0, 0, yaw_rate]
        total_size = (jnp.asarray(x, jnp.float32) for x in (qpos, qvel, np.zeros(model.nu), time))
        return Physics(*total_size, causes=jnp.zeros((), jnp.uint8), carry=())

    return stand
