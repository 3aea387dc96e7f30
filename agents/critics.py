"""How a critic learns: advantages and returns by what it knows, then a clipped value loss under Huber."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import huber_loss  # e²/2 inside δ, δ(|e| − δ/2) outside

from agents.batch import Batch, Critique, Normalised, Sequences, Side, rows, rows_of, sides
from agents.graphs import Run
from agents.networks import Critic
from agents.optimise import Adam, Tally, fused, minibatches, networks, parts, step
from agents.parallel import ALONE, Together
from agents.returns import ValueNorm, advantages
from agents.settings import HappoConfig


class CriticLearner:
    """A critic that learns, with its value normaliser, and the agents of the team whose observations it sees.

    `number` is its place among the critics of its team.
    """

    def __init__(
        self, network: Critic, agents: Sequence[int], config: HappoConfig, number: int = 0, together: Together = ALONE
    ):  # fmt: skip
        self.network, self.agents, self.config, self.together = network, tuple(agents), config, together
        self.number = number
        device = network.value.bias.device
        self.value_norm = ValueNorm().to(device)
        self.rate = torch.tensor(config.critic_lr, device=device)  # what Adam steps by
        self.optimizer = Adam(network, self.rate)
        self.tally = Tally(("value_loss", "critic_grad_norm"), device)
        self.fit = Tally(("explained_variance",), device)
        self.value_loss = fused(value_loss, config.compiled)
        self.loss = fused(self._loss, config.compiled and together.size == 1)  # messages are no part of kernels
        self.step = fused(self._step, config.compiled)
        # A recurrent one loops over time, and every step of the loop would be compiled by itself.
        self.criticise = fused(self._criticise, config.compiled and config.sequence is None)

    @torch.no_grad()
    def _criticise(self, batch: Batch) -> Critique:
        """Values, advantages and returns of a clean batch by the critic as it is before the update."""
        own, *more = (self._of_side(batch, side) for side in self._sides(batch))
        if not more:
            return own  # the only one that may remember anything
        # Taken apart by hand, as torch 2.11 cannot compile pytree's walk.
        seen, *figures, _ = zip(own, *more, strict=True)
        old, values, _, R, valid = map(torch.cat, figures)
        return Critique(Normalised(torch.cat([each.numbers for each in seen])), old, values, own.advantages, R, valid)

    def _sides(self, batch: Batch) -> Sequence[Side]:
        return sides(batch, self.agents, self.config.critic_input == "all")

    def seen(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """(B, n) What it saw in the decisions of a clean batch, side by side, and (B,) bool: not void."""
        shown = self._sides(batch)
        return torch.cat([s.seen.flatten(0, 1) for s in shown]), ~torch.cat([s.void.flatten() for s in shown])

    @torch.no_grad()
    def values(self, batch: Batch) -> Tensor:
        """(T, N) What it holds the states to be worth in which a clean batch's decisions were made, as rewards are."""
        side = self._sides(batch)[0]
        known = self.network(side.seen) if self.config.sequence is None else self._along(batch, side)[0]
        return self._denormalise(known)

    def _of_side(self, batch: Batch, side: Side) -> Critique:
        c = self.config
        shown = self.network.trunk.normalised(side.seen)
        if c.sequence is None:
            predictions, following, states = self.network(shown), self.network(side.next_seen), None
        else:
            predictions, following, states = self._along(batch, side)
        values, next_values = self._denormalise(predictions), self._denormalise(following)
        ends = side.terminated, batch.truncated, side.void
        A = advantages(side.rewards, values, next_values, *ends, c.gamma, c.lam)
        found = shown.numbers, predictions, values, A, A + values, ~side.void
        seen, old, known, gained, R, valid = (rows(x, c.sequence) for x in found)
        critique = Critique(Normalised(seen), old, known, gained, R, valid)
        if states is None:
            return critique
        before = torch.cat([batch.recalled[self.number][None], states[c.chunk - 1 : -1 : c.chunk]])
        chunks = Sequences(Normalised(seen), rows(batch.first[0], c.chunk), before.flatten(0, 1))
        return critique._replace(seen=chunks, last=[states[-1].clone()])

    def _along(self, batch: Batch, side: Side) -> tuple[Tensor, Tensor, Tensor]:
        """Predictions (T, N) of what a recurrent critic sees and of what followed; what it remembers (T, N, units)."""
        now, then, first = (x.transpose(0, 1) for x in (side.seen, side.next_seen, batch.first[0]))
        found = self.network.along(Sequences(now, first, batch.recalled[self.number]), then)
        predictions, following, states = (x.transpose(0, 1) for x in found)
        return predictions, following, states

    def rows_of(self, batch: Batch) -> int:
        """How many rows it makes of a batch."""
        return max(1, len(batch.sides)) * rows_of(batch, self.config.sequence)

    def update(self, critique: Critique, decay: float, orders: Sequence[Tensor], run: Run) -> None:
        """Learn from returns that the normaliser has just seen, once for each order of the rows.

        `decay` is what is left of the step size.
        """
        self.rate.fill_(self.config.critic_lr * decay)
        for order in orders:
            run(self.learn, critique, order)
        run(self.explain, critique)

    def learn(self, critique: Critique, order: Tensor) -> None:
        """One pass over the rows in this order."""
        c = self.config
        held = critique.seen, critique.predictions, critique.returns, critique.valid
        for minibatch in minibatches(held, order, c.minibatches):
            loss, taught = self.loss(*minibatch)
            *gradient, loss = self.together.sum(*self.optimizer.slope(loss), loss.detach())
            self.step(gradient, taught, loss)

    def _loss(self, seen: Normalised | Sequences, old: Tensor, R: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """The loss of a minibatch, whose returns the normaliser sees; and whether any decision counts, () 1 or 0."""
        part, taught = parts(valid, self.together)
        if self.config.value_norm:
            self.value_norm.update(R, part, taught, self.together)
        return self.value_loss(self.network, seen, old, self._normalise(R), part, self.config), taught

    def _step(self, gradient: Sequence[Tensor], taught: Tensor, loss: Tensor) -> None:
        """A step of Adam down the gradient, and the figures of the minibatch that it is from."""
        norm = step(self.optimizer, gradient, self.config.max_grad_norm, taught)
        self.tally.note(taught, value_loss=loss, critic_grad_norm=norm)

    @torch.no_grad()
    def explain(self, critique: Critique) -> None:
        """Note the share of the returns' variance that was known before."""
        part, taught = parts(critique.valid, self.together)

        def mean(x: Tensor) -> Tensor:
            return self.together.sum((x * part).sum())[0]

        def variance(x: Tensor) -> Tensor:
            return mean((x - mean(x)) ** 2)

        spread = variance(critique.returns).clamp(min=1e-8)
        self.fit.note(taught, explained_variance=1 - variance(critique.returns - critique.values) / spread)

    def _normalise(self, returns: Tensor) -> Tensor:
        return self.value_norm.normalise(returns) if self.config.value_norm else returns

    def _denormalise(self, values: Tensor) -> Tensor:
        return self.value_norm.denormalise(values) if self.config.value_norm else values


def value_loss(
    network: Critic, seen: Normalised | Sequences, old: Tensor, target: Tensor, part: Tensor, c: HappoConfig
) -> Tensor:
    """The larger of the Huber losses of the value and of the value held within `clip` of what it was.

    `part` (B,) is what each decision is worth in the mean.
    """
    with networks(c.precision, old.device):
        value = network(seen)
    clipped = old + (value - old).clamp(-c.clip, c.clip)
    losses = (huber_loss(v, target, reduction="none", delta=c.huber_delta) for v in (value, clipped))
    return (torch.max(*losses) * part).sum()
