"""Compiled programs of a team's environment: N worlds in which an opponent plays the other teams.

A row is what a learner sees as one environment: a whole team in one world (`joint`), or one of its agents (`shared`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax import Array

from arenas.arena import Arena
from arenas.state import State, TeamSpec, mean_pairwise_score


class Carry(NamedTuple):
    """All that decides how the worlds continue."""

    state: State  # of N worlds
    key: Array  # () key
    memory: Any  # the opponent's own
    first: Array  # (N,) bool: an episode begins with the next decision


class Weights(NamedTuple):
    """Weights of the reward of one decision."""

    shaping: float  # of the dense reward
    void_penalty: float  # price of a world that the team's own robots made void


class TeamStep(NamedTuple):
    """Result of one decision, by row."""

    observations: Array  # (rows, obs), of the new episode where one has ended
    alive: Array  # (rows,) or (rows, agents) bool: agents that take part in the next decision
    final_observations: Array  # (rows, obs), of the episode of this decision
    reward: Array  # (rows,)
    terminated: Array  # (rows,) bool
    truncated: Array  # (rows,) bool
    done: Array  # (rows,) bool
    outcome: Array  # (rows,) the reward without shaping
    shaping: Array  # (rows,) dense reward
    score: Array  # (rows,) of the team, 1 win, ½ draw, 0 loss, a mean over other teams; 0 unless `scored`
    scored: Array  # (rows,) bool: the episode has ended with a result
    void: Array  # (rows,) bool: physics failed in this decision


class Reset(Protocol):
    """Compiled start of N worlds: (key (), the opponent's memory, N) -> carry, observations and `alive` by row."""

    def __call__(self, key: Array, memory: Any, worlds: int) -> tuple[Carry, Array, Array]:
        """Start the worlds."""
        ...


class Step(Protocol):
    """Compiled decision in all worlds, which donates the buffers of the carry. `actions` are (rows, act)."""

    def __call__(self, carry: Carry, actions: Array, params: Any, weights: Weights) -> tuple[Carry, TeamStep]:
        """Take the decision, and restart the worlds whose episode has ended."""
        ...


class TeamRows:
    """Conversion of a team's values to rows and back."""

    def __init__(self, arena: Arena, index: int, shared: bool):
        self.team: TeamSpec = arena.teams[index]
        self.index, self.shared = index, shared
        names = [agent.name for agent in arena.agents]
        self._columns = jnp.array([names.index(agent.name) for agent in self.team.agents])

    @property
    def per_world(self) -> int:
        """The rows of one world."""
        return len(self.team.agents) if self.shared else 1

    def observations(self, state: State) -> Array:
        """Return the team's observations (rows, obs)."""
        own = [state.observations[agent.name] for agent in self.team.agents]
        return jnp.stack(own, axis=1).reshape(-1, own[0].shape[-1]) if self.shared else jnp.concatenate(own, axis=-1)

    def alive(self, state: State) -> Array:
        """Return `alive` of the team's agents: (rows,) where they are rows of their own, else (rows, agents)."""
        own = state.alive[:, self._columns]
        return own.reshape(-1) if self.shared else own

    def actions(self, rows: Array) -> dict[str, Array]:
        """Return the actions (N, act) by agent name, given those of the rows (rows, act)."""
        sizes = [agent.action_size for agent in self.team.agents]
        flat = rows.reshape(-1, sum(sizes))
        ends = [sum(sizes[: i + 1]) for i in range(len(sizes) - 1)]
        return {a.name: part for a, part in zip(self.team.agents, jnp.split(flat, ends, axis=-1), strict=True)}

    def repeated(self, values: Array) -> Array:
        """Return values of worlds (N,) by row."""
        return jnp.repeat(values, self.per_world, total_repeat_length=self.per_world * values.shape[0])


def make_reset(arena: Arena, rows: TeamRows) -> Reset:
    """Compile the start of N worlds."""

    def reset(key: Array, memory: Any, worlds: int) -> tuple[Carry, Array, Array]:
        key, place = jax.random.split(key)
        state = jax.vmap(arena.reset)(jax.random.split(place, worlds))
        return Carry(state, key, memory, jnp.ones(worlds, bool)), rows.observations(state), rows.alive(state)

    return _compiled(reset, static_argnums=2)


def make_step(arena: Arena, rows: TeamRows, act: Any) -> Step:
    """Compile a decision in which `act` (see Opponent) moves the other teams, if there are any."""
    others = [team for i, team in enumerate(arena.teams) if i != rows.index]

    def step(carry: Carry, actions: Array, params: Any, weights: Weights) -> tuple[Carry, TeamStep]:
        state, worlds = carry.state, carry.first.shape[0]
        key, act_key, place_key = jax.random.split(carry.key, 3)
        chosen, memory = rows.actions(actions), carry.memory
        if others:
            seen = {agent.name: state.observations[agent.name] for team in others for agent in team.agents}
            theirs, memory = act(params, seen, jax.random.split(act_key, worlds), memory, carry.first)
            chosen |= theirs
        after = jax.vmap(arena.step)(state, chosen)
        done = after.done
        fresh = jax.vmap(arena.restart)(after, jax.random.split(place_key, worlds), done)
        return Carry(fresh, key, memory, done), _judged(rows, state, after, fresh, weights)

    return _compiled(step, donate_argnums=0)


def _compiled(function: Callable, **options: Any) -> Any:
    """Apply `jax.jit` with all inputs on this process's device.

    Actions that came from another library are bound to the device and others are not; without this, the second step
    would be compiled anew.
    """
    return jax.jit(function, in_shardings=jax.sharding.SingleDeviceSharding(jax.devices()[0]), **options)


def _judged(rows: TeamRows, before: State, after: State, fresh: State, weights: Weights) -> TeamStep:
    """Return the decision's result, given the worlds before it, after it, and after restarts.

    The result of a void decision is unknown. It ends as if cut off where it began, with reward 0, so that a learner
    that values the last observation learns next to nothing from it. A world that the team's own robots made void is a
    defeat instead, as in the league's training: a losing team must not gain from breaking the physics.
    """
    verdict, void = after.verdict, after.void
    guilty = void & after.at_fault[:, rows.index]
    outcome, shaping = verdict.reward[:, rows.index], verdict.shaping[:, rows.index]
    outcome = jnp.where(guilty, -weights.void_penalty, jnp.where(void, 0.0, outcome))
    shaping = jnp.where(void, 0.0, shaping)
    terminated = guilty | (verdict.terminated & ~void)
    scored = after.done & ~void
    spread = rows.repeated
    final = jnp.where(spread(void)[:, None], rows.observations(before), rows.observations(after))
    return TeamStep(
        rows.observations(fresh), rows.alive(fresh), final, spread(outcome + weights.shaping * shaping),
        spread(terminated), spread(after.done & ~terminated), spread(after.done), spread(outcome), spread(shaping),
        spread(jnp.where(scored, mean_pairwise_score(verdict.score)[:, rows.index], 0.0)), spread(scored), spread(void),
    )  # fmt: skip
