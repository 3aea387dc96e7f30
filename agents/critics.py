"""How a critic learns: advantages and returns by what it knows, then a clipped value loss under Huber."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import huber_loss  # e²/2 inside δ, δ(|e| − δ/2) outside

from agents.batch import Batch, Critique, sides
from agents.graphs import Run
from agents.networks import Critic
from agents.optimise import Tally, adam, minibatches, networks, orders, parts, slope, step
from agents.parallel import ALONE, Together
from agents.returns import ValueNorm, advantages
from agents.settings import HappoConfig


class CriticLearner:
    """A critic that learns, with its value normaliser, and the agents of the team whose observations it sees."""

    def __init__(self, network: Critic, agents: Sequence[int], config: HappoConfig, together: Together = ALONE):
        self.network, self.agents, self.config, self.together = network, tuple(agents), config, together
        device = network.value.bias.device
        self.value_norm = ValueNorm().to(device)
        self.rate = torch.tensor(config.critic_lr, device=device)  # what Adam steps by
        self.optimizer = adam(network, self.rate)
        self.tally = Tally(("value_loss", "critic_grad_norm"), device)
        self.fit = Tally(("explained_variance",), device)

    @torch.no_grad()
    def criticise(self, batch: Batch) -> Critique:
        """Values, advantages and returns of a clean batch by the critic as it is before the update."""
        c = self.config
        each = []
        for side in sides(batch, self.agents, c.critic_input == "all"):
            predictions = self.network(side.seen)
            values, next_values = self._denormalise(predictions), self._denormalise(self.network(side.next_seen))
            ends = side.terminated, batch.truncated, side.void
            A = advantages(side.rewards, values, next_values, *ends, c.gamma, c.lam)
            found = side.seen, predictions, values, A, A + values, ~side.void
            each.append(Critique(*(x.flatten(0, 1) for x in found)))
        if len(each) == 1:
            return each[0]
        return Critique(*map(torch.cat, zip(*each, strict=True)))._replace(advantages=each[0].advantages)

    def update(self, critique: Critique, decay: float, dice: torch.Generator, run: Run) -> None:
        """Learn from returns that the normaliser has just seen; `decay` is what is left of the step size."""
        self.rate.fill_(self.config.critic_lr * decay)
        for order in orders(len(critique.valid), self.config.epochs, dice):
            run(self.learn, critique, order)
        run(self.explain, critique)

    def learn(self, critique: Critique, order: Tensor) -> None:
        """One pass over the rows in this order."""
        c, rows = self.config, (critique.seen, critique.predictions, critique.returns, critique.valid)
        for seen, old, R, valid in minibatches(rows, order, c.minibatches):
            part, taught = parts(valid, self.together)
            if c.value_norm:
                self.value_norm.update(R, part, taught, self.together)
            loss = value_loss(self.network, seen, old, self._normalise(R), part, c)
            *gradient, loss = self.together.sum(*slope(self.network, loss), loss)
            norm = step(self.optimizer, self.network, gradient, c.max_grad_norm, taught)
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


def value_loss(network: Critic, seen: Tensor, old: Tensor, target: Tensor, part: Tensor, c: HappoConfig) -> Tensor:
    """The larger of the Huber losses of the value and of the value held within `clip` of what it was.

    `part` (B,) is what each row is worth in the mean.
    """
    with networks(c.precision, seen.device):
        value = network(seen)
    clipped = old + (value - old).clamp(-c.clip, c.clip)
    losses = (huber_loss(v, target, reduction="none", delta=c.huber_delta) for v in (value, clipped))
    return (torch.max(*losses) * part).sum()
