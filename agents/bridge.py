"""The only place where JAX and torch meet: arrays cross by DLPack, without a copy and without the host.

Two traps are silent. JAX frees a buffer, on its own stream, when the torch tensor made of it dies, while torch kernels
that read it may still be queued: results of `to_torch` must live until torch has finished, which `HappoLearner.learn`
ensures by reading its losses back. Torch changes parameters in place, which JAX may not notice: `to_jax` copies
first.
"""

import math
from collections.abc import Mapping, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import torch
from jax import Array
from torch import Tensor

from agents.batch import Batch, CriticView, zero_absent
from agents.policy.jax_policy import Params
from agents.rollout.command_clock import at_command_clock
from agents.rollout.rollout import CriticObservations, Trajectory
from agents.rollout.team_view import select_agents, select_worlds
from arenas.state import TeamSpec

CriticMemories = Sequence[Tensor]  # (N, units) hidden state of each recurrent critic of a team in N worlds


def to_torch(array: Array) -> Tensor:
    """Return a torch view of a JAX array, on the same device."""
    return torch.from_dlpack(array)


def team_batch(
    trajectory: Trajectory, team: TeamSpec, index: int, worlds: slice | np.ndarray, shaping: float,
    void_penalty: float = 1.0, others: Sequence[TeamSpec] = (), privileged: bool = False,
    common: Sequence[TeamSpec] = (), critic_memories: CriticMemories = (), every: int = 1, gamma: float = 1.0,
    steps: int | None = None,
) -> Batch:  # fmt: skip
    """Return a team's part of a trajectory.

    The reward is the outcome plus `shaping` times the dense reward. A world that the team's own robots made void counts
    as terminated for the team, with the reward `-void_penalty`: a losing team must not gain from breaking the physics.
    For the other teams the decision stays void.

    Args:
        trajectory: of all teams.
        team: the team that learns.
        index: its number in the arena.
        worlds: the worlds in which it acted with its current policy.
        shaping: weight of the dense reward.
        void_penalty: price of a world that its own robots made void.
        others: teams whose observations its critic receives too.
        privileged: append the full state to its observations for the critic; the trajectory must hold it.
        common: all teams, for a critic that judges all of them (`common_critic_order`).
        critic_memories: hidden states (all worlds, units) of recurrent critics before the trajectory; empty if unknown.
        every: decisions for which its policies hold a command (`at_command_clock`).
        gamma: discount factor of rewards within a command, per decision.
        steps: environment steps of the iteration, over all worlds and ranks; None: those of this batch on each rank.
    """
    names = {agent.name for t in (team, *others, *common) for agent in t.agents}
    trajectory = select_worlds(select_agents(trajectory, names, privileged), worlds)
    trajectory = at_command_clock(trajectory, every, gamma) if every > 1 else trajectory
    rewards, terminated, void = map(to_torch, _rewards(select_agents(trajectory), index, shaping, void_penalty))
    critic_views = _common_views(trajectory, common, index, shaping, void_penalty)
    if privileged:
        seen, next_seen = _privileged_inputs(trajectory, team)
        critic_views = [CriticView(seen, next_seen, rewards, terminated, void)]
    return Batch(
        _of_agents(trajectory.observations, [team]),
        _of_agents(trajectory.next_observations, [team]),
        _choices(trajectory.actions, team),
        _of_agents(trajectory.log_probs, [team]),
        _of_agents(trajectory.alive, [team]),
        _of_agents(trajectory.next_alive, [team]),
        rewards,
        terminated,
        to_torch(trajectory.truncated),
        void,
        _of_agents(trajectory.observations, others),
        _of_agents(trajectory.next_observations, others),
        _of_agents(trajectory.alive, others),
        _of_agents(trajectory.next_alive, others),
        critic_views,
        *_recurrent_inputs(trajectory, team),
        [memory[worlds] for memory in critic_memories],
        () if steps is None else (torch.tensor(steps),),
    )


def _of_agents(values: Mapping[str, Array], teams: Sequence[TeamSpec]) -> Sequence[Tensor]:
    """Return the values of all agents of these teams, in their order."""
    return [to_torch(values[agent.name]) for team in teams for agent in team.agents]


def _choices(values: Mapping[str, Array], team: TeamSpec) -> Sequence[Tensor]:
    """Return what a team's agents chose, without the zeros of agents that choose less than others in their stack."""
    sizes = {agent.name: agent.action_size for agent in team.agents}
    own = {
        name: values[name] if values[name].shape[-1] == size else values[name][..., :size]
        for name, size in sizes.items()
    }
    return _of_agents(own, [team])


def _privileged_inputs(trajectory: Trajectory, team: TeamSpec) -> Sequence[Tensor]:
    """Return a team's observations and the full state, before and after each decision, (T, N, inputs) each."""
    known = (trajectory.observations, trajectory.alive), (trajectory.next_observations, trajectory.next_alive)
    return [
        torch.cat([*zero_absent(_of_agents(own, [team]), _of_agents(alive, [team])), to_torch(whole)], -1)
        for (own, alive), whole in zip(known, trajectory.whole, strict=True)
    ]


def _common_views(
    trajectory: Trajectory, teams: Sequence[TeamSpec], index: int, shaping: float, void_penalty: float
) -> list[CriticView]:
    """Return the views of a critic common to all `teams`, that of team `index` first; none without teams."""
    views = []
    for t in sorted(range(len(teams)), key=lambda t: t != index):
        seen = _common_critic_inputs(trajectory.observations, teams, t)
        next_seen = _common_critic_inputs(trajectory.next_observations, teams, t)
        rewards = map(to_torch, _rewards(select_agents(trajectory), t, shaping, void_penalty))
        views.append(CriticView(seen, next_seen, *rewards))
    return views


def evaluation_trajectory(seen: CriticObservations, teams: Sequence[TeamSpec], recurrent: bool) -> Trajectory:
    """Return the critics' observations of whole episodes as a trajectory for evaluation only: its rewards are zeros.

    With `recurrent`, hidden states start at the first decision.
    """
    alive = next(iter(seen.alive.values()))
    T, N = alive.shape
    none, no = jnp.zeros((T, N, len(teams))), jnp.zeros((T, N), bool)
    agents = [agent for team in teams for agent in team.agents]
    idle = {agent.name: jnp.zeros((T, N, agent.action_size)) for agent in agents}
    nothing = {agent.name: jnp.zeros((T, N)) for agent in agents}
    return Trajectory(
        seen.observations, seen.observations, idle, nothing, seen.alive, seen.alive, none, none, none, no, no, no,
        none.astype(bool), no, jnp.broadcast_to(jnp.arange(1, T + 1)[:, None], (T, N)), seen.whole * 2,
        {agent.name: jnp.zeros((1, N, 1)) for agent in agents} if recurrent else None,
    )  # fmt: skip


def _recurrent_inputs(trajectory: Trajectory, team: TeamSpec) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
    """Return a batch's `first` and `memories`: empty if the team's policies are not recurrent."""
    kept = trajectory.memories or {}
    memories = [to_torch(kept[agent.name]) for agent in team.agents if agent.name in kept]
    return [to_torch(trajectory.age == 1)] if memories else (), memories


def scatter_memories(final_memories: CriticMemories, worlds: slice | np.ndarray, number: int) -> CriticMemories:
    """Return hidden states of some `worlds` as those of all `number` worlds, with zeros for the others."""
    found = [memory.new_zeros(number, memory.shape[1]) for memory in final_memories]
    for whole, memory in zip(found, final_memories, strict=True):
        whole[worlds] = memory
    return found


@partial(jax.jit, static_argnums=1)
def _rewards(trajectory: Trajectory, index: int, shaping: float, void_penalty: float) -> tuple[Array, Array, Array]:
    """Return a team's rewards (T, N), and where its game terminated or is void, both (T, N) bool."""
    own = trajectory.void & trajectory.at_fault[..., index]
    rewards = trajectory.reward[..., index] + shaping * trajectory.shaping[..., index]
    return jnp.where(own, -void_penalty, rewards), trajectory.terminated | own, trajectory.void & ~own


def common_critic_order(teams: Sequence[TeamSpec], index: int) -> list[int]:
    """Return the order of teams in the input of a critic common to all teams when it judges team `index`.

    It is the arena's order, but the judged team swaps places with the first team of its roster. Thus teams of one
    roster look alike from either side, and each place always holds the same robots.
    """
    order = list(range(len(teams)))
    first = next(i for i, team in enumerate(teams) if team.roster == teams[index].roster)
    order[first], order[index] = index, first
    return order


def common_critic_size(teams: Sequence[TeamSpec]) -> int:
    """Return the input size of a critic common to all teams: one-hot of the judged team, and all observations."""
    return len(teams) + sum(agent.observation_size for team in teams for agent in team.agents)


def _common_critic_inputs(observations: Mapping[str, Array], teams: Sequence[TeamSpec], index: int) -> Tensor:
    """Return the inputs (T, N, common_critic_size) of a critic common to all teams when it judges one of them."""
    order = common_critic_order(teams, index)
    seen = [observations[agent.name] for t in order for agent in teams[t].agents]
    which = jnp.broadcast_to(jax.nn.one_hot(index, len(teams)), (*seen[0].shape[:2], len(teams)))
    return to_torch(jnp.concatenate([which, *seen], axis=-1))


def to_jax(policies: Sequence[Mapping[str, Tensor]]) -> list[Params]:
    """Return actors' state dicts as JAX policies.

    All floats cross as one flat vector, because each crossing costs 0.1 ms.
    """
    floats = [t for p in policies for t in p.values() if t.is_floating_point()]
    flat = jax.dlpack.from_dlpack(torch.cat([t.flatten() for t in floats]))  # cat copies
    arrays = iter(_split(flat, tuple(tuple(t.shape) for t in floats)))
    return [
        {name: next(arrays) if t.is_floating_point() else jnp.asarray(t.cpu().numpy()) for name, t in policy.items()}
        for policy in policies
    ]


@partial(jax.jit, static_argnums=1)
def _split(flat: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """Cut a flat array into arrays of these shapes, in one program: one program for each would cost as much again."""
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    return [part.reshape(shape) for part, shape in zip(jnp.split(flat, ends[:-1]), shapes, strict=True)]
