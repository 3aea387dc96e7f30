"""HATRPO's step (Kuba et al., 2022): along the natural gradient, as far as a mean KL divergence allows (TRPO)."""

from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from torch import Tensor
from torch.distributions import Normal, kl_divergence

from agents.batch import ActorBatch, Batch
from agents.devices.cuda_graphs import Runner
from agents.devices.distributed import SINGLE_PROCESS, Communicator
from agents.learner.actor_learner import METRICS, ActorLearner
from agents.learner.metric_means import MetricSums
from agents.learner.minibatches import mean_weights
from agents.policy.networks import Actor
from agents.settings import HappoConfig


class TrustRegionLearner(ActorLearner):
    """An actor that takes one step per batch, without Adam, passes, minibatches or entropy bonus."""

    def __init__(self, network: Actor, agents: Sequence[int], config: HappoConfig, comm: Communicator = SINGLE_PROCESS):
        super().__init__(network, agents, config, comm)
        self.optimizer = None
        self.metric_sums = MetricSums((*METRICS, "step_length"), network.std_scale.device)

    def num_rows(self, batch: Batch) -> int:
        """Return 0: no rows need an order."""
        return 0

    def update(self, actor_batch: ActorBatch, lr_factor: float, orders: Sequence[Tensor], run: Runner) -> None:
        """Step by √(2δ / s·Hs) · s, s = H⁻¹ ∇L, shortened by a backtracking line search.

        A step is accepted if it brings enough of the predicted gain and KL stays below δ. L is the mean of ratio · M·Â,
        H the Hessian of KL(π_before ‖ π) with damping. If no try is accepted the policy stays. The number of tries
        depends on numbers read from the device, so no graph can replay this: `lr_factor`, `orders` and `run` are
        unused.
        """
        weights, any_valid = mean_weights(actor_batch.valid, self.comm)
        if not any_valid:
            return
        c, parameters = self.config.trust_region, list(self.network.parameters())
        before = _detached(self.network.gaussian(actor_batch.observations))

        def total(value: Tensor) -> Tensor:
            return self.comm.sum(value)[0]

        def gain() -> Tensor:  # of this rank's rows, as the divergence
            return (self._ratio(actor_batch) * actor_batch.MA * weights).sum()

        def divergence() -> Tensor:
            return kl_divergence(before, self.network.gaussian(actor_batch.observations)).sum(-1).mul(weights).sum()

        def hessian(vector: Tensor) -> Tensor:
            slope = _flat(torch.autograd.grad(divergence(), parameters, create_graph=True))
            return total(_flat(torch.autograd.grad(slope @ vector, parameters))) + c.damping * vector

        start, at_start = _flat(parameters).detach().clone(), gain()
        gradient = total(_flat(torch.autograd.grad(at_start, parameters)).detach())
        at_start = total(at_start)
        direction = conjugate_gradient(hessian, gradient, c.conjugate_steps)
        curvature = (direction @ hessian(direction)).clamp(min=1e-12)  # 0 where there is nothing to gain
        longest = torch.sqrt(2 * c.kl_threshold / curvature) * direction
        moved = torch.zeros(())
        with torch.no_grad():
            for attempt in range(c.line_search_steps):
                length = c.backtrack_coeff**attempt
                _assign(parameters, start + length * longest)
                gained, moved = total(gain()) - at_start, total(divergence())
                if moved <= c.kl_threshold and gained > 0 and gained >= c.accept_ratio * length * (gradient @ longest):
                    break
            else:
                length, moved = 0.0, torch.zeros_like(moved)
                _assign(parameters, start)
            ratio = total((self._ratio(actor_batch) * weights).sum())
            entropy = total((self.network(actor_batch.observations).entropy().sum(-1) * weights).sum())
        self.metric_sums.add(
            any_valid, policy_loss=-at_start, entropy=entropy, ratio=ratio, kl=moved, actor_grad_norm=gradient.norm(),
            step_length=torch.as_tensor(length, device=moved.device),
        )  # fmt: skip

    def _ratio(self, actor_batch: ActorBatch) -> Tensor:
        """Return ratios (B,) of the current densities to those of the policy that acted."""
        log_ratio = self.network(actor_batch.observations).log_prob(actor_batch.actions).sum(-1) - actor_batch.log_probs
        return torch.exp(log_ratio.masked_fill(~actor_batch.valid, 0.0))


def conjugate_gradient(product: Callable[[Tensor], Tensor], b: Tensor, iterations: int) -> Tensor:
    """Return x with A x ≈ b for a positive definite A, where `product` computes A v. Stops early once b is met."""
    x, residual, search = torch.zeros_like(b), b.clone(), b.clone()
    square = residual @ residual
    for _ in range(iterations):
        if square < 1e-10:
            break
        image = product(search)
        step = square / (search @ image)
        x, residual = x + step * search, residual - step * image
        square, before = residual @ residual, square
        search = residual + square / before * search
    return x


def _flat(tensors: Sequence[Tensor]) -> Tensor:
    return torch.cat([t.reshape(-1) for t in tensors])


def _assign(parameters: Sequence[Tensor], flat: Tensor) -> None:
    """Write a flat vector into the parameters."""
    ends = torch.tensor([0, *(p.numel() for p in parameters)]).cumsum(0).tolist()
    for parameter, (begin, end) in zip(parameters, pairwise(ends), strict=True):
        parameter.copy_(flat[begin:end].reshape(parameter.shape))


def _detached(gaussian: Normal) -> Normal:
    return Normal(gaussian.mean.detach(), gaussian.stddev.detach(), validate_args=False)
