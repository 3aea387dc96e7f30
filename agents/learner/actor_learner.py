"""Learning of an actor: PPO's clipped surrogate on M·Â (Schulman et al., 2017), and limits of its steps.

With a magnet ρ the loss has α·KL(π‖ρ) besides: magnetic mirror descent (Sokota et al., 2023, "A unified approach to
reinforcement learning, quantal response equilibria, and two-player zero-sum games"), whose other divergence, from the
policy before the update, is bounded by PPO's clipping.
"""

import copy
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from agents.batch import ActorBatch, Batch, Sequences, num_rows, rows
from agents.devices.cuda_graphs import Runner
from agents.devices.distributed import SINGLE_PROCESS, Communicator
from agents.learner.metric_means import MetricSums
from agents.learner.minibatches import mean_weights, minibatches
from agents.learner.optimizer import Adam, autocast_networks, maybe_compiled, step
from agents.policy.networks import Actor, Gaussian, SquashedGaussian
from agents.settings import HappoConfig

MIN_LR, MAX_LR, LR_FACTOR = 1e-5, 1e-2, 1.5  # of the adaptive learning rate, as in rsl_rl
METRICS = ("policy_loss", "entropy", "ratio", "kl", "actor_grad_norm")


class ActorLearner:
    """An actor with its optimizer, and the agents of the team that act by it: one, or several equal ones."""

    def __init__(self, network: Actor, agents: Sequence[int], config: HappoConfig, comm: Communicator = SINGLE_PROCESS):
        self.network, self.agents, self.config, self.comm = network, tuple(agents), config, comm
        device = network.std_scale.device
        self.lr = torch.tensor(config.lr, dtype=torch.float64, device=device)  # state under `desired_kl`
        self.optimizer = Adam(network, torch.tensor(config.lr, device=device))
        self.metric_sums = MetricSums(METRICS, device)
        self.magnet = copy.deepcopy(network).requires_grad_(False) if config.magnet_coef else None
        self.magnet_age = torch.zeros((), dtype=torch.int64)  # updates since the policy became the magnet
        self.surrogate_loss = maybe_compiled(surrogate_loss, config.compiled)
        self.loss = maybe_compiled(self._loss, config.compiled and comm.size == 1)  # no messages inside kernels
        self.step = maybe_compiled(self._step, config.compiled)
        self.log_probs = maybe_compiled(self._log_probs, config.compiled)
        self.ratios = maybe_compiled(self._ratios, config.compiled)

    @torch.no_grad()
    def actor_batch(self, batch: Batch, M: Tensor, A_hat: Sequence[Tensor]) -> ActorBatch:
        """Return the agents' data in a clean batch, one agent after the other, each with its own M·Â."""
        chunk, units, found = self.config.sequence, self.config.architecture.recurrent, []
        for i in self.agents:
            actions, old, alive = (rows(x[i], chunk) for x in (batch.actions, batch.log_probs, batch.alive))
            obs = self.network.trunk.normalised(rows(batch.observations[i], chunk))
            if chunk is not None:
                obs = Sequences(obs, rows(batch.first[0], chunk), batch.memories[i][..., :units].flatten(0, 1))
            magnet = () if self.magnet is None else self._of_magnet(rows(batch.observations[i], chunk))
            found.append(ActorBatch(obs, actions, old, (M * A_hat[i]).masked_fill(~alive, 0.0), alive, magnet))
        return pytree.tree_map(lambda *each: torch.cat(each), *found)

    def _of_magnet(self, observations: Tensor) -> Sequence[Tensor]:
        """Return mean and standard deviation (B, act) of the magnet, which normalises by its own statistics."""
        assert self.magnet is not None
        gaussian = self.magnet.gaussian(observations)
        return [gaussian.mean, gaussian.stddev]

    @torch.no_grad()
    def move_magnet(self) -> None:
        """Count an update, and let the policy become the magnet where that is due."""
        self.magnet_age += 1
        if self.magnet is not None and self.magnet_age == self.config.magnet_updates:
            for mine, yours in zip(self.magnet.state_dict().values(), self.network.state_dict().values(), strict=True):
                mine.copy_(yours)
            self.magnet_age.zero_()

    def seen(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return the agents' observations (B, obs) in a clean batch, agent after agent, and (B,) bool: it took part."""
        terms = [(batch.observations[i].flatten(0, 1), batch.alive[i].flatten()) for i in self.agents]
        return torch.cat([obs for obs, _ in terms]), torch.cat([alive for _, alive in terms])

    @torch.no_grad()
    def _log_probs(self, actor_batch: ActorBatch) -> Tensor:
        """Return log densities (B,) of the actions under the current policy."""
        return self.network(actor_batch.observations).log_prob(actor_batch.actions).sum(-1)

    @torch.no_grad()
    def _ratios(self, actor_batch: ActorBatch, before: Tensor) -> Tensor:
        """Return probability ratios (B / agents,) since `before`, multiplied over agents; 1 where none took part."""
        ratio = torch.exp(self._log_probs(actor_batch) - before).masked_fill(~actor_batch.valid, 1.0)
        return torch.stack(ratio.chunk(len(self.agents))).prod(0)

    def num_rows(self, batch: Batch) -> int:
        """Return the number of rows in its actor batch of a batch."""
        return len(self.agents) * num_rows(batch, self.config.sequence)

    def update(self, actor_batch: ActorBatch, lr_factor: float, orders: Sequence[Tensor], run: Runner) -> None:
        """Take `minibatches` steps of Adam for each order of the rows.

        Stops after a pass in which the policy moved by more than `target_kl`. `lr_factor` scales the learning rate.
        """
        c = self.config
        self.optimizer.lr.copy_(self.lr * lr_factor)
        for order in orders:
            moved = run(self.learn, actor_batch, order)
            if c.target_kl is not None and moved.item() > c.target_kl:
                break
        self.move_magnet()

    def learn(self, actor_batch: ActorBatch, order: Tensor) -> Tensor:
        """Make one pass over the rows in this order; return the mean KL divergence () of its minibatches."""
        c, before = self.config, self.metric_sums.sums.clone()
        for minibatch in minibatches(actor_batch, order, c.minibatches):
            loss, found, any_valid = self.loss(minibatch)
            terms = (*self.optimizer.gradient(loss), loss.detach(), found["entropy"], found["rise"], found["kl"])
            *gradient, loss, entropy, rise, kl = self.comm.sum(*terms)
            if c.desired_kl is not None:  # outside compiled code: torch 2.13 drops writes to a float64 ()
                self._adapt(kl, c.desired_kl)
            self.step(gradient, any_valid, loss, entropy, rise, kl)
        return self.metric_sums.mean("kl", before)

    def _loss(self, actor_batch: ActorBatch) -> tuple[Tensor, dict[str, Tensor], Tensor]:
        """Return the loss of a minibatch, its metrics, and () 1, or 0 if no decision in it is valid."""
        weights, any_valid = mean_weights(actor_batch.valid, self.comm)
        return *self.surrogate_loss(self.network, actor_batch, weights, self.config), any_valid

    def _step(
        self, gradient: Sequence[Tensor], any_valid: Tensor, loss: Tensor, entropy: Tensor, rise: Tensor, kl: Tensor
    ) -> None:
        """Take a step of Adam down the gradient, and add the minibatch's metrics."""
        norm = step(self.optimizer, gradient, self.config.max_grad_norm, any_valid)
        self.metric_sums.add(any_valid, policy_loss=loss, entropy=entropy, ratio=1 + rise, kl=kl, actor_grad_norm=norm)

    def _adapt(self, kl: Tensor, target: float) -> None:
        """Lower the learning rate if the policy moved by more than twice the target, raise it below half of it."""
        smaller, larger = (self.lr / LR_FACTOR).clamp(min=MIN_LR), (self.lr * LR_FACTOR).clamp(max=MAX_LR)
        lr = torch.where((kl > 0) & (kl < target / 2), larger, self.lr)
        self.lr.copy_(torch.where(kl > 2 * target, smaller, lr))
        self.optimizer.lr.copy_(self.lr)


def surrogate_loss(
    network: Actor, actor_batch: ActorBatch, weights: Tensor, c: HappoConfig
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the clipped surrogate and entropy bonus as a loss, and metrics of the current policy.

    All are sums over decisions with `weights` (B, ...), the weight of each in a mean. `rise` is the mean ratio minus 1;
    where a decision has no weight its ratio counts as 1, whatever the policy gives there.
    """
    with autocast_networks(c.precision, actor_batch.MA.device):
        policy = network(actor_batch.observations)
    log_ratio = (policy.log_prob(actor_batch.actions).sum(-1) - actor_batch.log_probs).masked_fill(
        ~actor_batch.valid, 0.0
    )
    rise = torch.expm1(log_ratio)  # r − 1
    # min(r·MÂ, clip(r, 1 ± ε)·MÂ) = MÂ + min((r − 1)·MÂ, ε·|MÂ|), whose gradient takes half as many kernels
    surrogate = actor_batch.MA + (rise * actor_batch.MA).clamp(max=c.clip * actor_batch.MA.abs())
    entropy = (policy.entropy().sum(-1) * weights).sum()
    loss = -(surrogate * weights).sum() - c.entropy_coef * entropy
    if actor_batch.magnet:
        loss = loss + c.magnet_coef * (_divergence(policy, *actor_batch.magnet) * weights).sum()
    entropy, rise, log_ratio = entropy.detach(), rise.detach(), log_ratio.detach()
    kl = ((rise - log_ratio) * weights).sum()  # never negative, and of low variance (Schulman, 2020)
    return loss, {"entropy": entropy, "rise": (rise * weights).sum(), "kl": kl}


def _divergence(policy: Gaussian | SquashedGaussian, mean: Tensor, std: Tensor) -> Tensor:
    """Return KL(π‖ρ) (...) from a magnet's Gaussian (..., act). Squashing both alike does not change it."""
    gaussian = policy.gaussian if isinstance(policy, SquashedGaussian) else policy
    ratio = gaussian.stddev / std
    return (0.5 * (ratio.square() + ((gaussian.mean - mean) / std).square() - 1) - ratio.log()).sum(-1)
