"""HATRPO's step (Kuba et al., 2022): along the natural gradient, as far as a mean KL divergence allows (TRPO's own)."""

from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from torch import Tensor
from torch.distributions import Normal, kl_divergence

from agents.actors import FIGURES, ActorLearner
from agents.batch import Batch, Share
from agents.graphs import Run
from agents.networks import Actor
from agents.optimise import Tally, parts
from agents.parallel import ALONE, Together
from agents.settings import HappoConfig


class TrustRegionLearner(ActorLearner):
    """An actor that takes one step per batch: no Adam, no passes, no minibatches, no entropy bonus."""

    def __init__(self, network: Actor, agents: Sequence[int], config: HappoConfig, together: Together = ALONE):
        super().__init__(network, agents, config, together)
        self.optimizer = None
        self.tally = Tally((*FIGURES, "step_length"), network.std_scale.device)

    def rows_of(self, batch: Batch) -> int:
        """None that would need an order."""
        return 0

    def update(self, share: Share, decay: float, orders: Sequence[Tensor], run: Run) -> None:
        """Step by √(2δ / s·Hs) · s, s = H⁻¹ ∇L, shortened until it brings what it promised and KL stays below δ.

        L is the mean of ratio · M·Â, H the Hessian of KL(π_before ‖ π) with its damping. Where no try is good enough
        the policy stays as it is. How often it tries hangs on numbers that it reads, so no graph replays it: `decay`,
        `orders` and `run` are for other learners.
        """
        part, taught = parts(share.valid, self.together)
        if not taught:
            return
        c, parameters = self.config.trust_region, list(self.network.parameters())
        before = _detached(self.network.gaussian(share.observations))

        def total(mine: Tensor) -> Tensor:
            return self.together.sum(mine)[0]

        def gain() -> Tensor:  # of this rank's rows, as the divergence
            return (self._ratio(share) * share.MA * part).sum()

        def divergence() -> Tensor:
            return kl_divergence(before, self.network.gaussian(share.observations)).sum(-1).mul(part).sum()

        def hessian(vector: Tensor) -> Tensor:
            slope = _flat(torch.autograd.grad(divergence(), parameters, create_graph=True))
            return total(_flat(torch.autograd.grad(slope @ vector, parameters))) + c.damping * vector

        start, at_start = _flat(parameters).detach().clone(), gain()
        gradient = total(_flat(torch.autograd.grad(at_start, parameters)).detach())
        at_start = total(at_start)
        direction = conjugate_gradient(hessian, gradient, c.conjugate_steps)
        curvature = (direction @ hessian(direction)).clamp(min=1e-12)  # 0 where there is nothing to gain
        longest = torch.sqrt(2 * c.kl / curvature) * direction
        moved = torch.zeros(())
        with torch.no_grad():
            for attempt in range(c.tries):
                length = c.backtrack**attempt
                _place(parameters, start + length * longest)
                gained, moved = total(gain()) - at_start, total(divergence())
                if moved <= c.kl and gained > 0 and gained >= c.accept * length * (gradient @ longest):
                    break
            else:
                length, moved = 0.0, torch.zeros_like(moved)
                _place(parameters, start)
            ratio = total((self._ratio(share) * part).sum())
            entropy = total((self.network(share.observations).entropy().sum(-1) * part).sum())
        self.tally.note(
            taught, policy_loss=-at_start, entropy=entropy, ratio=ratio, kl=moved, actor_grad_norm=gradient.norm(),
            step_length=torch.as_tensor(length, device=moved.device),
        )  # fmt: skip

    def _ratio(self, share: Share) -> Tensor:
        """(B,) Of the densities now and of the policy that acted."""
        log_ratio = self.network(share.observations).log_prob(share.actions).sum(-1) - share.log_probs
        return torch.exp(log_ratio.masked_fill(~share.valid, 0.0))


def conjugate_gradient(product: Callable[[Tensor], Tensor], b: Tensor, iterations: int) -> Tensor:
    """X with A x ≈ b for a positive definite A, of which `product` gives A v. Ends early where b is met."""
    x, rest, along = torch.zeros_like(b), b.clone(), b.clone()
    square = rest @ rest
    for _ in range(iterations):
        if square < 1e-10:
            break
        image = product(along)
        step = square / (along @ image)
        x, rest = x + step * along, rest - step * image
        square, before = rest @ rest, square
        along = rest + square / before * along
    return x


def _flat(tensors: Sequence[Tensor]) -> Tensor:
    return torch.cat([t.reshape(-1) for t in tensors])


def _place(parameters: Sequence[Tensor], flat: Tensor) -> None:
    """Write a flat vector over the parameters."""
    ends = torch.tensor([0, *(p.numel() for p in parameters)]).cumsum(0).tolist()
    for parameter, (begin, end) in zip(parameters, pairwise(ends), strict=True):
        parameter.copy_(flat[begin:end].reshape(parameter.shape))


def _detached(gaussian: Normal) -> Normal:
    return Normal(gaussian.mean.detach(), gaussian.stddev.detach(), validate_args=False)
