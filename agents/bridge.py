"""The one place where jax and torch meet: arrays cross by dlpack, without a copy and without the host.

Two traps, both silent. A JAX buffer handed to torch is freed when the torch tensor dies, on JAX's stream, while torch
kernels may still be queued: `to_torch` tensors must live until torch has finished, which `Learner.update` ensures by
reading its losses back. And torch changes parameters in place, which JAX may not see happen: `to_jax` copies first.
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

from agents.batch import Batch, Side, held
from agents.outcomes import of_worlds, watched
from agents.policy import Params
from agents.rollout import Seen, Trajectory
from arenas.state import TeamSpec

Recalled = Sequence[Tensor]  # (N, units) of each recurrent critic of a team: what it remembers of N worlds


def to_torch(array: Array) -> Tensor:
    """A torch view of a JAX array, on the same device."""
    return torch.from_dlpack(array)


def team_batch(
    trajectory: Trajectory,
    team: TeamSpec,
    index: int,
    worlds: slice | np.ndarray,
    shaping: float,
    blame: float = 1.0,
    others: Sequence[TeamSpec] = (),
    privileged: bool = False,
    common: Sequence[TeamSpec] = (),
    recalled: Recalled = (),
) -> Batch:
    """A team's part of a trajectory: `worlds` are those in which it acted with its present policy.

    What its critic sees beside, or instead of, the team's own observations: `others` are the teams whose observations
    it sees too; `privileged`: behind its own it sees the whole state, which the trajectory then holds; `common` are all
    teams, where it judges for all of them (`common_order`). `recalled` is what recurrent critics remember of all worlds
    as the trajectory begins, nothing where that is not known.

    The reward is the outcome plus `shaping` times the dense hints. Where the team's own robots made a world void, that
    is the end of the game for it, at the price of `blame`: a team that is losing must not gain from breaking physics.
    For the other teams the decision stays void.
    """
    names = {agent.name for t in (team, *others, *common) for agent in t.agents}
    trajectory = of_worlds(watched(trajectory, names, privileged), worlds)

    def of_agents(values: Mapping[str, Array], teams: Sequence[TeamSpec] = (team,)) -> Sequence[Tensor]:
        return [to_torch(values[agent.name]) for team in teams for agent in team.agents]

    rewards, terminated, void = map(to_torch, _earned(watched(trajectory), index, shaping, blame))
    sides = []
    if privileged:
        known = (trajectory.observations, trajectory.alive), (trajectory.next_observations, trajectory.next_alive)
        seen, next_seen = (
            torch.cat([*held(of_agents(own), of_agents(there)), to_torch(whole)], -1)
            for (own, there), whole in zip(known, trajectory.whole, strict=True)
        )
        sides = [Side(seen, next_seen, rewards, terminated, void)]
    for t in sorted(range(len(common)), key=lambda t: t != index):
        seen = _seen_by_all(trajectory.observations, common, t)
        next_seen = _seen_by_all(trajectory.next_observations, common, t)
        sides.append(Side(seen, next_seen, *map(to_torch, _earned(watched(trajectory), t, shaping, blame))))
    return Batch(
        of_agents(trajectory.observations),
        of_agents(trajectory.next_observations),
        of_agents(trajectory.actions),
        of_agents(trajectory.log_probs),
        of_agents(trajectory.alive),
        of_agents(trajectory.next_alive),
        rewards,
        terminated,
        to_torch(trajectory.truncated),
        void,
        of_agents(trajectory.observations, others),
        of_agents(trajectory.next_observations, others),
        of_agents(trajectory.alive, others),
        of_agents(trajectory.next_alive, others),
        sides,
        *_past(trajectory, team),
        [memory[worlds] for memory in recalled],
    )


def unlearnt(seen: Seen, teams: Sequence[TeamSpec], recurrent: bool) -> Trajectory:
    """What critics see of whole episodes, as a trajectory to judge and not to learn from: it says nothing of rewards.

    With `recurrent` all that they remember begins with its first decision.
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


def _past(trajectory: Trajectory, team: TeamSpec) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
    """A batch's `first` and `memories`: empty where the team's policies remember nothing."""
    kept = trajectory.memories or {}
    memories = [to_torch(kept[agent.name]) for agent in team.agents if agent.name in kept]
    return [to_torch(trajectory.age == 1)] if memories else (), memories


def everywhere(remembered: Recalled, worlds: slice | np.ndarray, number: int) -> Recalled:
    """What critics remember of some worlds as what they remember of all, of so many: nothing of the others."""
    found = [memory.new_zeros(number, memory.shape[1]) for memory in remembered]
    for whole, memory in zip(found, remembered, strict=True):
        whole[worlds] = memory
    return found


@partial(jax.jit, static_argnums=1)
def _earned(trajectory: Trajectory, index: int, shaping: float, blame: float) -> tuple[Array, Array, Array]:
    """A team's rewards (T, N), and where its game ended or is void, (T, N) bool."""
    own = trajectory.void & trajectory.culprits[..., index]
    rewards = trajectory.reward[..., index] + shaping * trajectory.shaping[..., index]
    return jnp.where(own, -blame, rewards), trajectory.terminated | own, trajectory.void & ~own


def common_order(teams: Sequence[TeamSpec], index: int) -> list[int]:
    """In which order a critic common to all teams sees them when it judges for one: numbers of teams.

    That of the arena, but the team itself changes places with the first of its roster. So teams of one roster look
    alike from either side, and in each place there stand always the same robots.
    """
    order = list(range(len(teams)))
    first = next(i for i, team in enumerate(teams) if team.roster == teams[index].roster)
    order[first], order[index] = index, first
    return order


def common_size(teams: Sequence[TeamSpec]) -> int:
    """Numbers that a critic common to all teams sees: which team it judges for (one-hot), and all observations."""
    return len(teams) + sum(agent.observation_size for team in teams for agent in team.agents)


def _seen_by_all(observations: Mapping[str, Array], teams: Sequence[TeamSpec], index: int) -> Tensor:
    """What a critic common to all teams sees when it judges for one of them, (T, N, common_size)."""
    order = common_order(teams, index)
    seen = [observations[agent.name] for t in order for agent in teams[t].agents]
    which = jnp.broadcast_to(jax.nn.one_hot(index, len(teams)), (*seen[0].shape[:2], len(teams)))
    return to_torch(jnp.concatenate([which, *seen], axis=-1))


def to_jax(policies: Sequence[Mapping[str, Tensor]]) -> list[Params]:
    """Actors' state dicts as policies: all floats cross as one flat vector, for each crossing costs 0.1 ms."""
    floats = [t for p in policies for t in p.values() if t.is_floating_point()]
    flat = jax.dlpack.from_dlpack(torch.cat([t.flatten() for t in floats]))  # cat copies
    arrays = iter(_apart(flat, tuple(tuple(t.shape) for t in floats)))
    return [
        {name: next(arrays) if t.is_floating_point() else jnp.asarray(t.cpu().numpy()) for name, t in policy.items()}
        for policy in policies
    ]


@partial(jax.jit, static_argnums=1)
def _apart(flat: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """Arrays of these shapes, which lie one after the other; in one program, for each by itself costs as much."""
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    return [part.reshape(shape) for part, shape in zip(jnp.split(flat, ends[:-1]), shapes, strict=True)]
