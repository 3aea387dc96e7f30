"""Collecting experience and playing matches, each one jitted `lax.scan`: nothing leaves the device per step.

T decisions, N worlds, K opponents: worlds are split into K groups of N/K, and in group k each agent acts with the k-th
of its stacked policies.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from agents.policy import Params, sample
from arenas.arena import Arena, Frames, Script, State


class Trajectory(NamedTuple):
    """What happened in T decisions of N worlds. Dicts are keyed by agent name."""

    observations: dict[str, Array]  # (T, N, obs) that the agent acted on
    next_observations: dict[str, Array]  # (T, N, obs) that followed, before any new episode began
    actions: dict[str, Array]  # (T, N, act)
    log_probs: dict[str, Array]  # (T, N)
    reward: Array  # (T, N, teams) outcome
    shaping: Array  # (T, N, teams) dense hints
    score: Array  # (T, N, teams), meaningful where the episode ended
    terminated: Array  # (T, N) bool
    truncated: Array  # (T, N) bool
    void: Array  # (T, N) bool


class Games(NamedTuple):
    """How one episode in each of N worlds ended, and what the recorded worlds R looked like."""

    score: Array  # (N, teams)
    void: Array  # (N,) bool
    decisions: Array  # (N,) int: the length of each episode
    frames: Frames  # (T, hold, R, ...)
    actions: dict[str, Array]  # (T, R, act)
    reward: Array  # (T, R, teams)
    running: Array  # (T, R) bool: the episode was still on before this decision


def make_rollout(arena: Arena, length: int) -> jax.stages.Wrapped:
    """Compile the training rollout: `rollout(policies, state, key) -> (state, trajectory)`.

    `policies` are stacked per agent (K, ...), `state` is a batch of N worlds, a multiple of K. Finished worlds begin
    anew at once.
    """
    act = _make_act(arena)

    def rollout(policies: Mapping[str, Params], state: State, key: Array) -> tuple[State, Trajectory]:
        worlds = state.done.shape[0]

        def decision(state: State, key: Array) -> tuple[State, Trajectory]:
            act_key, place_key = jax.random.split(key)
            actions, log_probs = act(policies, state.observations, jax.random.split(act_key, worlds))
            after = jax.vmap(arena.step)(state, actions)
            verdict = after.verdict
            step = Trajectory(
                state.observations, after.observations, actions, log_probs, verdict.reward, verdict.shaping,
                verdict.score, verdict.terminated, verdict.truncated, after.void,
            )  # fmt: skip
            keys = jax.random.split(place_key, worlds)
            return jax.vmap(arena.restart)(after, keys, after.done), step

        return jax.lax.scan(decision, state, jax.random.split(key, length))

    return jax.jit(rollout, donate_argnums=1)


def make_reset(arena: Arena) -> Callable[[Array], State]:
    """Compile `reset(keys (N,)) -> State` of N fresh worlds."""
    return jax.jit(jax.vmap(arena.reset))


def make_play(arena: Arena, recorded: tuple[int, ...] = ()) -> Callable[[Mapping[str, Params], Array], Games]:
    """Compile a match: `play(policies, keys (N,)) -> Games`, one whole episode in every world.

    Every world plays exactly one episode, so that short episodes do not count more often than long ones. A world's key
    fixes its start and its dice; worlds with equal keys are a seed pair. `recorded` are the worlds to keep frames of.
    """
    act = _make_act(arena)
    kept = jnp.asarray(recorded, jnp.int32)

    def play(policies: Mapping[str, Params], keys: Array) -> Games:
        start, dice = jnp.moveaxis(jax.vmap(lambda key: jax.random.split(key, 2))(keys), 1, 0)

        def decision(state: State, t: Array) -> tuple[State, tuple]:
            keys = jax.vmap(lambda key: jax.random.fold_in(key, t))(dice)
            actions, _ = act(policies, state.observations, keys)
            after, frames = jax.vmap(arena.step_with_frames)(state, actions)
            watched = (
                jax.tree.map(lambda x: jnp.moveaxis(x[kept], 0, 1), frames),
                {name: a[kept] for name, a in actions.items()},
                after.verdict.reward[kept],
                ~state.done[kept],
            )
            return after, (watched, ~state.done)

        state = jax.vmap(arena.reset)(start)
        state, ((frames, actions, reward, running), on) = jax.lax.scan(
            decision, state, jnp.arange(arena.timing.decisions)
        )
        return Games(state.verdict.score, state.void, on.sum(axis=0), frames, actions, reward, running)

    return jax.jit(play)


def _make_act(arena: Arena) -> Callable[[Mapping[str, Params], dict[str, Array], Array], tuple[dict, dict]]:
    """act(policies, observations, keys (N,)) -> (actions, log_probs) by agent name."""
    scripts = tuple(arena.scripts().values())

    def act(policies: Mapping[str, Params], observations: dict[str, Array], keys: Array) -> tuple[dict, dict]:
        actions, log_probs = {}, {}
        for i, agent in enumerate(arena.agents):
            params, seen = policies[agent.name], observations[agent.name]
            groups = params["script"].shape[0]
            own = jax.vmap(lambda key: jax.random.fold_in(key, i))(keys)  # noqa: B023  (called at once)
            decide = jax.vmap(lambda p, o, k: _decide(p, o, k, scripts, agent.action_size))  # noqa: B023  (called at once)
            a, lp = decide(params, seen.reshape(groups, -1, seen.shape[-1]), own.reshape(groups, -1))
            actions[agent.name], log_probs[agent.name] = a.reshape(-1, a.shape[-1]), lp.reshape(-1)
        return actions, log_probs

    return act


def _decide(
    params: Params, observations: Array, keys: Array, scripts: tuple[Script, ...], size: int
) -> tuple[Array, Array]:
    """Actions (n, act) and log densities (n,) of one policy, learned or scripted; a script's density is 0."""
    if "mean.weight" in params:
        action, log_prob = sample(params, observations, keys)
    else:
        action, log_prob = jnp.zeros((len(observations), size)), jnp.zeros(len(observations))
    if not scripts:
        return action, log_prob
    said = jnp.stack([jax.vmap(script)(observations, keys) for script in scripts])  # (scripts, n, act)
    number = params["script"]
    by_script = number > 0
    chosen = said[jnp.maximum(number - 1, 0)]
    return jnp.where(by_script, chosen, action), jnp.where(by_script, 0.0, log_prob)
