"""How a critic learns: advantages and returns by what it knows, then a clipped value loss under Huber."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from agents.batch import Batch, Critique, views
from agents.networks import Critic
from agents.optimise import Figures, adam, minibatches, note, step
from agents.returns import ValueNorm, advantages
from agents.settings import HappoConfig


class CriticLearner:
    """A critic that learns, with its value normaliser, and the agents of the team whose observations it sees."""

    def __init__(self, network: Critic, agents: Sequence[int], config: HappoConfig):
        self.network, self.agents, self.config = network, tuple(agents), config
        self.value_norm = ValueNorm().to(network.value.bias.device)
        self.optimizer = adam(network, config.critic_lr)

    @torch.no_grad()
    def criticise(self, batch: Batch, valid: Tensor) -> Critique:
        """Values, advantages and returns by the critic as it is before the update."""
        c = self.config
        seen, seen_next = views(batch, self.agents, c.critic_input == "all")
        predictions = self.network(seen)
        values = self._denormalise(predictions)
        next_values = self._denormalise(self.network(seen_next))
        A = advantages(
            batch.rewards, values, next_values, batch.terminated, batch.truncated, batch.void, c.gamma, c.lam
        )[valid]
        return Critique(seen[valid], predictions[valid], values[valid], A, A + values[valid])

    def update(self, critique: Critique, decay: float, rng: torch.Generator, figures: Figures) -> None:
        """Learn from returns that the normaliser has just seen; `decay` is what is left of the step size."""
        c, (seen, old, values, _, returns) = self.config, critique
        for _ in range(c.epochs):
            for rows in minibatches(len(seen), c.minibatches, rng, seen.device):
                if c.value_norm:
                    self.value_norm.update(returns[rows])
                loss = value_loss(self.network, seen[rows], old[rows], self._normalise(returns[rows]), c)
                norm = step(self.optimizer, self.network, loss, c.max_grad_norm, c.critic_lr * decay)
                note(figures, value_loss=loss, critic_grad_norm=norm)
        spread = returns.var(correction=0).clamp(min=1e-8)
        note(figures, explained_variance=1 - (returns - values).var(correction=0) / spread)

    def _normalise(self, returns: Tensor) -> Tensor:
        return self.value_norm.normalise(returns) if self.config.value_norm else returns

    def _denormalise(self, values: Tensor) -> Tensor:
        return self.value_norm.denormalise(values) if self.config.value_norm else values


def value_loss(network: Critic, seen: Tensor, old: Tensor, target: Tensor, c: HappoConfig) -> Tensor:
    """The larger of the Huber losses of the value and of the value held within `clip` of what it was."""
    value = network(seen)
    clipped = old + (value - old).clamp(-c.clip, c.clip)
    return torch.max(_huber(target - value, c.huber_delta), _huber(target - clipped, c.huber_delta)).mean()


def _huber(error: Tensor, delta: float) -> Tensor:
    """e²/2 inside δ, δ(|e| − δ/2) outside."""
    return nn.functional.huber_loss(error, torch.zeros_like(error), reduction="none", delta=delta)
