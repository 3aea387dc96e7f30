"""What a learner learns from: a team's experience, and what of it an actor and a critic look at."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class Side(NamedTuple):
    """What a critic that sees more than observations learns from: how the game went for one team."""

    seen: Tensor  # (T, N, all that it sees) with zeros where that means nothing
    next_seen: Tensor  # (T, N, all that it sees)
    rewards: Tensor  # (T, N)
    terminated: Tensor  # (T, N) bool
    void: Tensor  # (T, N) bool


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
    # Where the critic sees something else than observations: the game as it went for the team, then for other teams.
    sides: Sequence[Side] = ()
    # Where networks are recurrent:
    first: Sequence[Tensor] = ()  # one, (T, N) bool: with this decision an episode began
    memories: Sequence[Tensor] = ()  # (T / chunk, N, units or more) of each agent's actor, before each chunk
    recalled: Sequence[Tensor] = ()  # (N, units) of each critic, before the first decision; none: of fresh worlds


class Normalised(NamedTuple):
    """Observations as a network first makes them: once for all passes over a batch, in which its statistics rest."""

    numbers: Tensor  # (..., obs)


class Sequences(NamedTuple):
    """What a recurrent network sees: B sequences of L observations, and what of the past matters to them."""

    observations: Tensor | Normalised  # (B, L, obs)
    first: Tensor  # (B, L) bool: with it an episode begins
    memory: Tensor  # (B, units) that the network remembered before the sequence


# Rows, of which minibatches are made: B = T·N decisions, or where networks are recurrent B = T / chunk · N chunks of so
# many consecutive decisions, whose figures are (B, chunk).


class Share(NamedTuple):
    """What an actor learns from: B rows of each of its agents, with zeros where `valid` says no."""

    observations: Normalised | Sequences  # (B, obs)
    actions: Tensor  # (B, act)
    log_probs: Tensor  # (B,) of the policy that acted
    MA: Tensor  # (B,) M·Â
    valid: Tensor  # (B,) bool: the agent took part, and what came of it is known


class Critique(NamedTuple):
    """What a critic makes of the B rows of a batch, as often as it has sides; the team's own come first."""

    seen: Normalised | Sequences  # (B, all that it sees)
    predictions: Tensor  # (B,) in normalised units, as all that the critic says
    values: Tensor  # (B,) the same in units of reward
    advantages: Tensor  # (T·N,) of the team itself
    returns: Tensor  # (B,)
    valid: Tensor  # (B,) bool: not void
    last: Sequence[Tensor] = ()  # one where it is recurrent, (N, units): what it remembers after the last decision


def held(values: Sequence[Tensor], there: Sequence[Tensor]) -> list[Tensor]:
    """Values of agents (T, N, ...), with zeros where an agent is not `there` (T, N)."""
    return [x.masked_fill(~(a[..., None] if x.dim() > a.dim() else a), 0.0) for x, a in zip(values, there, strict=True)]


def clean(batch: Batch) -> Batch:
    """The batch with zeros for what void decisions hold, and agents that were out of the game.

    So no number that means nothing enters any arithmetic: 0 times NaN is NaN, and so is its gradient. Who took part in
    a decision that is void counts as out of it.
    """
    valid = ~batch.void
    there, there_next, others, others_next = (
        [a & valid for a in alive]
        for alive in (batch.alive, batch.next_alive, batch.others_alive, batch.next_others_alive)
    )
    return Batch(
        held(batch.observations, there),
        held(batch.next_observations, there_next),
        held(batch.actions, there),
        held(batch.log_probs, there),
        there,
        there_next,
        batch.rewards.masked_fill(batch.void, 0.0),
        batch.terminated,
        batch.truncated,
        batch.void,
        held(batch.others, others),
        held(batch.next_others, others_next),
        others,
        others_next,
        [_clean_side(side) for side in batch.sides],
        batch.first,
        batch.memories,
        batch.recalled,
    )


def _clean_side(side: Side) -> Side:
    def held(x: Tensor) -> Tensor:
        return x.masked_fill(side.void[..., None] if x.dim() > side.void.dim() else side.void, 0.0)

    return side._replace(seen=held(side.seen), next_seen=held(side.next_seen), rewards=held(side.rewards))


def rows(values: Tensor, chunk: int | None) -> Tensor:
    """What decisions hold, (T, N, ...), as rows: (T·N, ...), or in chunks (T / chunk · N, chunk, ...)."""
    if chunk is None:
        return values.flatten(0, 1)
    return values.unflatten(0, (-1, chunk)).transpose(1, 2).flatten(0, 1)


def rows_of(batch: Batch, chunk: int | None) -> int:
    """How many rows `rows` makes of what each decision of a batch holds."""
    return batch.void.numel() // (chunk or 1)


def sides(batch: Batch, agents: Sequence[int], everybody: bool) -> Sequence[Side]:
    """What a critic of these agents learns from in a clean batch: the team's own side first.

    `everybody`: where the batch names no sides, it sees the other teams' agents after its own.
    """
    if batch.sides:
        return batch.sides
    return [Side(*views(batch, agents, everybody), batch.rewards, batch.terminated, batch.void)]


def views(batch: Batch, agents: Sequence[int], everybody: bool) -> tuple[Tensor, Tensor]:
    """What a critic of these agents sees before and after each decision of a clean batch, (T, N, all that it sees).

    It sees zeros for who is out of the game. `everybody`: the other teams' agents come after its own.
    """
    others, next_others = (batch.others, batch.next_others) if everybody else ((), ())
    now, then = (
        [*(seen[i] for i in agents), *rest]
        for seen, rest in ((batch.observations, others), (batch.next_observations, next_others))
    )
    return torch.cat(now, -1), torch.cat(then, -1)
