"""Training data of a learner: a team's experience, and the parts of it that an actor and a critic learn from."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class CriticView(NamedTuple):
    """Experience of one team as a critic sees it, where its input is more than its own team's observations."""

    seen: Tensor  # (T, N, inputs), zeros where they mean nothing
    next_seen: Tensor  # (T, N, inputs)
    rewards: Tensor  # (T, N)
    terminated: Tensor  # (T, N) bool
    void: Tensor  # (T, N) bool


class Batch(NamedTuple):
    """Experience of a team over T decisions in N worlds. Sequences hold one entry per agent."""

    observations: Sequence[Tensor]  # (T, N, obs)
    next_observations: Sequence[Tensor]  # (T, N, obs)
    actions: Sequence[Tensor]  # (T, N, act)
    log_probs: Sequence[Tensor]  # (T, N)
    alive: Sequence[Tensor]  # (T, N) bool: the agent took part in this decision
    next_alive: Sequence[Tensor]  # (T, N) bool: the same in the state that followed
    rewards: Tensor  # (T, N)
    terminated: Tensor  # (T, N) bool
    truncated: Tensor  # (T, N) bool
    void: Tensor  # (T, N) bool: the result of this decision is unknown
    # The same for the other teams' agents, where the critic observes them:
    others: Sequence[Tensor] = ()  # (T, N, obs)
    next_others: Sequence[Tensor] = ()  # (T, N, obs)
    others_alive: Sequence[Tensor] = ()  # (T, N) bool
    next_others_alive: Sequence[Tensor] = ()  # (T, N) bool
    # For critics whose input is not observations: the view of the own team, then those of other teams.
    critic_views: Sequence[CriticView] = ()
    # For recurrent networks:
    first: Sequence[Tensor] = ()  # one tensor, (T, N) bool: an episode began with this decision
    memories: Sequence[Tensor] = ()  # (T / chunk, N, units or more) hidden state of each actor before each chunk
    critic_memories: Sequence[Tensor] = ()  # (N, units) hidden state of each critic at first; empty: new worlds
    # Environment steps of the iteration, of which these decisions may be a part: one tensor () int; empty: just these.
    steps: Sequence[Tensor] = ()


class Normalised(NamedTuple):
    """Normalised observations, computed once for all passes over a batch, during which the statistics stay fixed."""

    values: Tensor  # (..., obs)


class Sequences(NamedTuple):
    """Input of a recurrent network: B sequences of L observations, and the hidden state before them."""

    observations: Tensor | Normalised  # (B, L, obs)
    first: Tensor  # (B, L) bool: an episode begins here
    memory: Tensor  # (B, units) hidden state before the sequence


# Minibatches are made of rows. B = T·N decisions, or for recurrent networks B = T / chunk · N chunks of consecutive
# decisions, whose values are (B, chunk).


class ActorBatch(NamedTuple):
    """Training data of an actor: B rows of each of its agents, with zeros where `valid` is False."""

    observations: Normalised | Sequences  # (B, obs)
    actions: Tensor  # (B, act)
    log_probs: Tensor  # (B,) under the policy that acted
    MA: Tensor  # (B,) M·Â
    valid: Tensor  # (B,) bool: the agent took part and the result is known
    magnet: Sequence[Tensor] = ()  # if it has one: mean and standard deviation (B, act) of its magnet's Gaussian


class CriticBatch(NamedTuple):
    """Training data of a critic: B rows of a batch for each of its views, the own team's first."""

    seen: Normalised | Sequences  # (B, inputs)
    predictions: Tensor  # (B,) in normalised units, as the network outputs them
    values: Tensor  # (B,) predictions in units of reward
    advantages: Tensor  # (T·N,) of the own team
    returns: Tensor  # (B,)
    valid: Tensor  # (B,) bool: not void
    last: Sequence[Tensor] = ()  # one tensor if recurrent, (N, units): hidden state after the last decision


def zero_absent(values: Sequence[Tensor], present: Sequence[Tensor]) -> list[Tensor]:
    """Return values of agents (T, N, ...) with zeros where an agent is not `present` (T, N)."""
    return [
        x.masked_fill(~(a[..., None] if x.dim() > a.dim() else a), 0.0) for x, a in zip(values, present, strict=True)
    ]


def clean(batch: Batch) -> Batch:
    """Return the batch with zeros in void decisions and for agents that were out of the game.

    Thus no meaningless number enters any arithmetic: 0 times NaN is NaN, and so is its gradient. In a void decision all
    agents count as out of the game.
    """
    valid = ~batch.void
    present, next_present, others, others_next = (
        [a & valid for a in alive]
        for alive in (batch.alive, batch.next_alive, batch.others_alive, batch.next_others_alive)
    )
    return Batch(
        zero_absent(batch.observations, present),
        zero_absent(batch.next_observations, next_present),
        zero_absent(batch.actions, present),
        zero_absent(batch.log_probs, present),
        present,
        next_present,
        batch.rewards.masked_fill(batch.void, 0.0),
        batch.terminated,
        batch.truncated,
        batch.void,
        zero_absent(batch.others, others),
        zero_absent(batch.next_others, others_next),
        others,
        others_next,
        [_clean_view(side) for side in batch.critic_views],
        batch.first,
        batch.memories,
        batch.critic_memories,
        batch.steps,
    )


def _clean_view(side: CriticView) -> CriticView:
    def zero_absent(x: Tensor) -> Tensor:
        return x.masked_fill(side.void[..., None] if x.dim() > side.void.dim() else side.void, 0.0)

    return side._replace(
        seen=zero_absent(side.seen), next_seen=zero_absent(side.next_seen), rewards=zero_absent(side.rewards)
    )


def rows(values: Tensor, chunk: int | None) -> Tensor:
    """Return values of decisions (T, N, ...) as rows: (T·N, ...), or as chunks (T / chunk · N, chunk, ...)."""
    if chunk is None:
        return values.flatten(0, 1)
    return values.unflatten(0, (-1, chunk)).transpose(1, 2).flatten(0, 1)


def num_rows(batch: Batch, chunk: int | None) -> int:
    """Return the number of rows that `rows` makes of each tensor of a batch."""
    return batch.void.numel() // (chunk or 1)


def critic_views(batch: Batch, agents: Sequence[int], all_teams: bool) -> Sequence[CriticView]:
    """Return the views of a clean batch that a critic of these agents learns from, the own team's first.

    `all_teams`: where the batch has no views of its own, the other teams' agents follow the critic's.
    """
    if batch.critic_views:
        return batch.critic_views
    return [CriticView(*critic_inputs(batch, agents, all_teams), batch.rewards, batch.terminated, batch.void)]


def critic_inputs(batch: Batch, agents: Sequence[int], all_teams: bool) -> tuple[Tensor, Tensor]:
    """Return the inputs of a critic of these agents before and after each decision of a clean batch.

    Both are (T, N, inputs). Agents that are out of the game have zeros. `all_teams`: the other teams' agents follow the
    critic's own.
    """
    others, next_others = (batch.others, batch.next_others) if all_teams else ((), ())
    now, then = (
        [*(seen[i] for i in agents), *more]
        for seen, more in ((batch.observations, others), (batch.next_observations, next_others))
    )
    return torch.cat(now, -1), torch.cat(then, -1)
