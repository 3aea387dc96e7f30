"""Learning of a critic: advantages and returns from its values, then a clipped Huber loss."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import huber_loss  # e²/2 inside δ, δ(|e| − δ/2) outside

from agents.batch import Batch, CriticBatch, CriticView, Normalised, Sequences, critic_views, num_rows, rows
from agents.devices.cuda_graphs import Runner
from agents.devices.distributed import SINGLE_PROCESS, Communicator
from agents.learner.advantages import ValueNorm, advantages
from agents.learner.metric_means import MetricSums
from agents.learner.minibatches import mean_weights, minibatches
from agents.learner.optimizer import Adam, autocast_networks, maybe_compiled, step
from agents.policy.networks import Critic
from agents.settings import HappoConfig


class CriticLearner:
    """A critic with its optimizer and value normaliser, and the agents of the team whose observations it receives.

    `number` is its position among the critics of its team.
    """

    def __init__(
        self,
        network: Critic,
        agents: Sequence[int],
        config: HappoConfig,
        number: int = 0,
        comm: Communicator = SINGLE_PROCESS,
    ):
        self.network, self.agents, self.config, self.comm = network, tuple(agents), config, comm
        self.number = number
        device = network.value.bias.device
        self.value_norm = ValueNorm().to(device)
        self.optimizer = Adam(network, torch.tensor(config.critic_lr, device=device))
        self.metric_sums = MetricSums(("value_loss", "critic_grad_norm"), device)
        self.fit_sums = MetricSums(("explained_variance",), device)
        self.value_loss = maybe_compiled(value_loss, config.compiled)
        self.loss = maybe_compiled(self._loss, config.compiled and comm.size == 1)  # no messages inside kernels
        self.step = maybe_compiled(self._step, config.compiled)
        # A recurrent critic loops over time, and each step of the loop would be compiled separately.
        self.evaluate = maybe_compiled(self._evaluate, config.compiled and config.sequence is None)

    @torch.no_grad()
    def _evaluate(self, batch: Batch) -> CriticBatch:
        """Return values, advantages and returns of a clean batch by the critic before the update."""
        own, *more = (self._evaluate_view(batch, view) for view in self._views(batch))
        if not more:
            return own  # the only view that may be recurrent
        # Unpacked by hand, because torch 2.11 cannot compile pytree's traversal.
        seen, *figures, _ = zip(own, *more, strict=True)
        old, values, _, R, valid = map(torch.cat, figures)
        return CriticBatch(Normalised(torch.cat([each.values for each in seen])), old, values, own.advantages, R, valid)

    def _views(self, batch: Batch) -> Sequence[CriticView]:
        """Return the views of a clean batch that this critic learns from."""
        return critic_views(batch, self.agents, self.config.critic_input == "all")

    def seen(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return its inputs (B, n) in a clean batch, views one after the other, and (B,) bool: not void."""
        inputs = self._views(batch)
        return torch.cat([s.seen.flatten(0, 1) for s in inputs]), ~torch.cat([s.void.flatten() for s in inputs])

    @torch.no_grad()
    def values(self, batch: Batch) -> Tensor:
        """Return its values (T, N) of the states of a clean batch, in units of reward."""
        side = self._views(batch)[0]
        known = self.network(side.seen) if self.config.sequence is None else self._evaluate_sequence(batch, side)[0]
        return self._denormalise(known)

    def _evaluate_view(self, batch: Batch, view: CriticView) -> CriticBatch:
        """Return values, advantages and returns of one view, by the critic's network and value normaliser."""
        c = self.config
        inputs = self.network.trunk.normalised(view.seen)
        if c.sequence is None:
            predictions, following, states = self.network(inputs), self.network(view.next_seen), None
        else:
            predictions, following, states = self._evaluate_sequence(batch, view)
        values, next_values = self._denormalise(predictions), self._denormalise(following)
        ends = view.terminated, batch.truncated, view.void
        A = advantages(view.rewards, values, next_values, *ends, c.discount, c.gae_lambda)
        found = inputs.values, predictions, values, A, A + values, ~view.void
        seen, old, known, gained, R, valid = (rows(x, c.sequence) for x in found)
        critic_batch = CriticBatch(Normalised(seen), old, known, gained, R, valid)
        if states is None:
            return critic_batch
        before = torch.cat([batch.critic_memories[self.number][None], states[c.chunk_length - 1 : -1 : c.chunk_length]])
        chunks = Sequences(Normalised(seen), rows(batch.first[0], c.chunk_length), before.flatten(0, 1))
        return critic_batch._replace(seen=chunks, last=[states[-1].clone()])

    def _evaluate_sequence(self, batch: Batch, view: CriticView) -> tuple[Tensor, Tensor, Tensor]:
        """Return a recurrent critic's values (T, N) of inputs and next inputs, and its hidden states (T, N, units)."""
        now, then, first = (x.transpose(0, 1) for x in (view.seen, view.next_seen, batch.first[0]))
        found = self.network.evaluate_sequence(Sequences(now, first, batch.critic_memories[self.number]), then)
        predictions, following, states = (x.transpose(0, 1) for x in found)
        return predictions, following, states

    def num_rows(self, batch: Batch) -> int:
        """Return the number of rows that it makes of a batch."""
        return max(1, len(batch.critic_views)) * num_rows(batch, self.config.sequence)

    def update(self, critic_batch: CriticBatch, lr_factor: float, orders: Sequence[Tensor], run: Runner) -> None:
        """Learn once for each order of the rows, from returns that the normaliser has just included.

        `lr_factor` scales the learning rate.
        """
        self.optimizer.lr.fill_(self.config.critic_lr * lr_factor)
        for order in orders:
            run(self.learn, critic_batch, order)
        run(self.add_explained_variance, critic_batch)

    def learn(self, critic_batch: CriticBatch, order: Tensor) -> None:
        """Make one pass over the rows in this order."""
        c = self.config
        held = critic_batch.seen, critic_batch.predictions, critic_batch.returns, critic_batch.valid
        for minibatch in minibatches(held, order, c.minibatches):
            loss, any_valid = self.loss(*minibatch)
            *gradient, loss = self.comm.sum(*self.optimizer.gradient(loss), loss.detach())
            self.step(gradient, any_valid, loss)

    def _loss(self, seen: Normalised | Sequences, old: Tensor, R: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Return the loss of a minibatch, whose returns the normaliser includes, and () 1, or 0 if no row is valid."""
        weights, any_valid = mean_weights(valid, self.comm)
        if self.config.value_norm:
            self.value_norm.update(R, weights, any_valid, self.comm)
        return self.value_loss(self.network, seen, old, self._normalise(R), weights, self.config), any_valid

    def _step(self, gradient: Sequence[Tensor], any_valid: Tensor, loss: Tensor) -> None:
        """Take a step of Adam down the gradient, and add the minibatch's metrics."""
        norm = step(self.optimizer, gradient, self.config.max_grad_norm, any_valid)
        self.metric_sums.add(any_valid, value_loss=loss, critic_grad_norm=norm)

    @torch.no_grad()
    def add_explained_variance(self, critic_batch: CriticBatch) -> None:
        """Add the share of the returns' variance that the values before the update explained."""
        weights, any_valid = mean_weights(critic_batch.valid, self.comm)

        def mean(x: Tensor) -> Tensor:
            return self.comm.sum((x * weights).sum())[0]

        def variance(x: Tensor) -> Tensor:
            return mean((x - mean(x)) ** 2)

        total = variance(critic_batch.returns).clamp(min=1e-8)
        self.fit_sums.add(
            any_valid, explained_variance=1 - variance(critic_batch.returns - critic_batch.values) / total
        )

    def _normalise(self, returns: Tensor) -> Tensor:
        """Return returns in the critic's units."""
        return self.value_norm.normalise(returns) if self.config.value_norm else returns

    def _denormalise(self, values: Tensor) -> Tensor:
        """Return values in units of reward."""
        return self.value_norm.denormalise(values) if self.config.value_norm else values


def value_loss(
    network: Critic, seen: Normalised | Sequences, old: Tensor, target: Tensor, weights: Tensor, c: HappoConfig
) -> Tensor:
    """Return the larger of the Huber losses of the value and of the value clipped to within `clip` of the old one.

    `weights` (B,) are the decisions' weights in the mean. See Schulman et al. (2017) for the clipping.
    """
    with autocast_networks(c.precision, old.device):
        value = network(seen)
    clipped = old + (value - old).clamp(-c.clip, c.clip)
    losses = (huber_loss(v, target, reduction="none", delta=c.huber_delta) for v in (value, clipped))
    return (torch.max(*losses) * weights).sum()
