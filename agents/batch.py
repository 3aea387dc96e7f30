"""What a learner learns from: a team's experience, and what of it an actor and a critic look at."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class Batch(NamedTuple):
    """A team's experience of T decisions in N worlds, one entry per agent in the sequences."""

    observations: Sequence[Tensor]  # (T, N, obs)
    next_observations: Sequence[Tensor]  # (T, N, obs)
    actions: Sequence[Tensor]  # (T, N, act)
    log_probs: Sequence[Tensor]  # (T, N)
    alive: Sequence[Tensor]  # (T, N) bool: the agent took part in this decision
    next_alive: Sequence[Tensor]  # (T, N) bool: and in the state that followed
    rewards: Tensor  # (T, N)
    terminated: Tensor  # (T, N) bool
    truncated: Tensor  # (T, N) bool
    void: Tensor  # (T, N) bool: what this decision led to is unknown
    # The same of the other teams' agents, where a critic sees them too:
    others: Sequence[Tensor] = ()  # (T, N, obs)
    next_others: Sequence[Tensor] = ()  # (T, N, obs)
    others_alive: Sequence[Tensor] = ()  # (T, N) bool
    next_others_alive: Sequence[Tensor] = ()  # (T, N) bool


class Share(NamedTuple):
    """What an actor learns from: the B decisions that its agents took part in."""

    observations: Tensor  # (B, obs)
    actions: Tensor  # (B, act)
    log_probs: Tensor  # (B,) of the policy that acted
    MA: Tensor  # (B,) M·Â


class Critique(NamedTuple):
    """What a critic makes of the B valid decisions of a batch."""

    seen: Tensor  # (B, all that it sees)
    predictions: Tensor  # (B,) in normalised units, as all that the critic says
    values: Tensor  # (B,) the same in units of reward
    advantages: Tensor  # (B,)
    returns: Tensor  # (B,)


def views(batch: Batch, agents: Sequence[int], everybody: bool) -> tuple[Tensor, Tensor]:
    """What a critic of these agents sees before and after each decision, (T, N, all their observations).

    It sees zeros for who is out of the game. `everybody`: the other teams' agents come after its own.
    """
    now = [(batch.observations[i], batch.alive[i]) for i in agents]
    then = [(batch.next_observations[i], batch.next_alive[i]) for i in agents]
    if everybody:
        now += zip(batch.others, batch.others_alive, strict=True)
        then += zip(batch.next_others, batch.next_others_alive, strict=True)
    return _joint(now), _joint(then)


def _joint(seen: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
    return torch.cat([o.where(alive[..., None], 0.0) for o, alive in seen], -1)
