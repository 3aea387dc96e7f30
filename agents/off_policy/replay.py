"""Replay buffer of a team: a ring of decisions on the learner's device, and random draws of those that count.

A decision is one row of numbers, in which `Layout` tells what is where. One gather then fetches all that a gradient
step needs. Nothing waits for the device: where the ring is written follows from the shapes of batches.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from agents.batch import Batch

NOBODY = -1  # tag of decisions whose opponents the learner was not told


class Decisions(NamedTuple):
    """B decisions of a team of n agents; sequences hold one entry per agent."""

    observations: Sequence[Tensor]  # (B, obs), zeros where the agent was out of the game
    next_observations: Sequence[Tensor]  # (B, obs) in the state in which it bootstraps
    more: Tensor  # (B, more) what the critic observes beside its team's observations
    next_more: Tensor  # (B, more)
    actions: Tensor  # (B, sum of act), one agent's after the other's
    alive: Tensor  # (B, n) 1 where the agent took part, else 0
    next_alive: Tensor  # (B, n)
    rewards: Tensor  # (B,) discounted sum up to the state in which it bootstraps
    discounts: Tensor  # (B,) of that state's value: γ to the number of decisions up to there; 0 if the game is over


class Layout:
    """Places of the numbers of a decision in its row."""

    def __init__(self, observation_sizes: Sequence[int], action_sizes: Sequence[int], more: int):
        self.observation_sizes, self.more = tuple(observation_sizes), more
        n = len(self.observation_sizes)
        self._sizes = [*self.observation_sizes, *self.observation_sizes, more, more, sum(action_sizes), n, n, 1, 1]
        self.width = sum(self._sizes)

    def rows(self, batch: Batch, gamma: float, steps: int = 1) -> Tensor:
        """Return the decisions of a clean batch as rows (T·N, width), those of one step after the other.

        Returns have up to so many `steps`.
        """
        returns = multi_step_returns(batch, gamma, steps)
        more, next_more = _more(batch, sum(self.observation_sizes))
        alive, next_alive = (torch.stack(list(each), -1).float() for each in (batch.alive, batch.next_alive))
        following = [
            _at(x, returns.last) if steps > 1 else x for x in (*batch.next_observations, *next_more, next_alive)
        ]
        n, ends = len(self.observation_sizes), torch.stack([returns.rewards, returns.discounts], -1)
        parts = [*batch.observations, *following[:n], *more, *following[n:-1], *batch.actions]
        return torch.cat([*parts, alive, following[-1], ends], -1).flatten(0, 1)

    def decisions(self, rows: Tensor) -> Decisions:
        """Return rows (B, width) as decisions; all are views."""
        parts, n = rows.split(self._sizes, -1), len(self.observation_sizes)
        *middle, rewards, discounts = parts[2 * n :]
        more, next_more, actions, alive, next_alive = middle
        return Decisions(
            parts[:n], parts[n : 2 * n], more, next_more, actions, alive, next_alive, rewards[:, 0], discounts[:, 0]
        )


class Returns(NamedTuple):
    """Returns over some decisions of a batch, from each of them on."""

    rewards: Tensor  # (T, N) discounted sum
    discounts: Tensor  # (T, N) of the value of the state that followed; 0 where the game was over
    last: Tensor  # (T, N) int64: the last decision whose reward counts


def multi_step_returns(batch: Batch, gamma: float, steps: int) -> Returns:
    """Return the returns over up to `steps` decisions of the same policy (Sutton, 1988), as far as the batch goes.

    They end with the episode, and before a void decision, whose state is the last one that is known.
    """
    T, over = len(batch.rewards), batch.terminated | batch.truncated | batch.void
    at = torch.arange(T, device=over.device)[:, None]
    rewards, last = batch.rewards.clone(), at.expand(over.shape).clone()
    open_ = ~over
    for step in range(1, min(steps, T)):
        here = (at + step).clamp(max=T - 1).expand(over.shape)
        open_ = open_ & (at + step < T) & ~batch.void.gather(0, here)
        rewards += gamma**step * batch.rewards.gather(0, here) * open_
        last += open_
        open_ = open_ & ~over.gather(0, here)
    discounts = gamma ** (last - at + 1) * ~batch.terminated.gather(0, last)
    return Returns(rewards, discounts, last)


def _at(values: Tensor, decisions: Tensor) -> Tensor:
    """Return the values (T, N, ...) of other `decisions` (T, N) of the same worlds."""
    return values.gather(0, decisions[..., None].expand(values.shape))


def more_size(batch: Batch) -> int:
    """Return how many numbers the critic of a batch observes beside its own team's observations."""
    return sum(each.shape[-1] for each in _more(batch, sum(x.shape[-1] for x in batch.observations))[0])


def _more(batch: Batch, own: int) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
    """Return what the critic observes before and after decisions, (T, N, ...) each, beside `own` numbers of its team.

    They are the observations of other teams, or the arena's full state.
    """
    if batch.critic_views:
        view = batch.critic_views[0]
        return [view.seen[..., own:]], [view.next_seen[..., own:]]
    return batch.others, batch.next_others


def valid_rows(batch: Batch) -> Tensor:
    """Return (T·N,) bool: the result of the decision is known, and an agent took part in it."""
    return (~batch.void & torch.stack(list(batch.alive)).any(0)).flatten()


class Replay:
    """A ring of `capacity` decisions: the oldest one is replaced."""

    def __init__(self, capacity: int, width: int, device: torch.device):
        self.rows = torch.zeros(capacity, width, device=device)
        self.valid = torch.zeros(capacity, dtype=torch.bool, device=device)
        self.tags = torch.full((capacity,), NOBODY, dtype=torch.int64, device=device)  # against whom it was played
        self.counts = torch.zeros(capacity, dtype=torch.int64, device=device)  # valid rows up to each
        self.at = 0  # place of the next row
        self.written = 0  # rows since it was empty, at most the capacity
        self.usable = 0  # the same without those that were dropped

    @property
    def capacity(self) -> int:
        """The number of rows."""
        return len(self.rows)

    def append(self, rows: Tensor, valid: Tensor, tags: Tensor) -> None:
        """Write rows (B, width), the newest last; of more than fit, the last ones."""
        rows, valid, tags = (x[-self.capacity :] for x in (rows, valid, tags))
        count = len(rows)
        first = min(count, self.capacity - self.at)  # up to the end of the ring; the others begin it anew
        for ring, new in ((self.rows, rows), (self.valid, valid), (self.tags, tags)):
            ring[self.at : self.at + first].copy_(new[:first])
            ring[: count - first].copy_(new[first:])
        self.at = (self.at + count) % self.capacity
        self.written, self.usable = (min(x + count, self.capacity) for x in (self.written, self.usable))
        self._count()

    def keep(self, tags: Sequence[int]) -> None:
        """Drop all rows but those with these tags."""
        if self.written:
            kept = torch.tensor(tags, dtype=torch.int64, device=self.tags.device)
            self.valid &= torch.isin(self.tags, kept)
            self._count()
            self.usable = int(self.counts[-1])

    def clear(self) -> None:
        """Empty it."""
        self.valid.zero_()
        self.at = self.written = self.usable = 0
        self._count()

    def _count(self) -> None:
        torch.cumsum(self.valid, 0, out=self.counts)

    def draw(self, count: int, rng: torch.Generator) -> Tensor:
        """Return the places (count,) of random valid rows, each as likely as any other, with replacement.

        Without any valid row the places mean nothing, and `any_valid` says so.
        """
        total = self.counts[-1]
        share = torch.rand(count, generator=rng, dtype=torch.float64, device=rng.device)
        which = (share * total).long().clamp(max=total - 1)
        return torch.searchsorted(self.counts, which + 1).clamp(max=self.capacity - 1)

    @property
    def any_valid(self) -> Tensor:
        """() 1 if there is any valid row, else 0."""
        return (self.counts[-1] > 0).float()

    def saved(self) -> dict[str, Tensor]:
        """Return the rows that were written, in their places, and all else that `load` needs."""
        there, state = slice(self.written), torch.tensor([self.at, self.usable, self.capacity])
        return {"rows": self.rows[there], "valid": self.valid[there], "tags": self.tags[there], "state": state}

    def load(self, rows: Tensor, valid: Tensor, tags: Tensor, state: Tensor) -> None:
        """Hold what `saved` gave; of a larger ring the newest rows."""
        at, usable, capacity = map(int, state)
        same, held = capacity == self.capacity, (rows, valid, tags)
        if not same and len(rows) == capacity:
            held = [x.roll(-at, 0) for x in held]  # the oldest row first
        self.clear()
        self.append(*held)
        self.at = at if same else self.at
        self.usable = min(usable, self.capacity)
