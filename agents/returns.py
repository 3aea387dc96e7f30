"""Advantages and value normalisation, in torch. T time, N worlds."""

import torch
from torch import Tensor, nn

from agents.parallel import ALONE, Together


def advantages(
    rewards: Tensor,
    values: Tensor,
    next_values: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    void: Tensor,
    gamma: float,
    lam: float,
) -> Tensor:
    """Generalised advantage estimation (Schulman et al., 2016, eq. 16), (T, N).

    `values` are V(s_t), `next_values` V(s_{t+1}) of the state that really followed, before any new episode began. A
    `terminated` state has no future; an episode that ended, for whatever reason, hands nothing back to the one before
    it. So a time limit is bootstrapped with the value of its true last observation, and a real end is not. What a
    `void` decision led to is unknown: its own advantage is 0, and those before it bootstrap with V where it was taken.
    """
    # δ_t = r_t + γ V(s_{t+1}) − V(s_t);  A_t = δ_t + γ λ A_{t+1}
    delta = (rewards + gamma * next_values * ~terminated - values).masked_fill(void, 0.0)
    carried = torch.full_like(delta, gamma * lam).masked_fill(terminated | truncated | void, 0.0)
    advantage, out = torch.zeros_like(rewards[0]), torch.empty_like(delta)
    for t in reversed(range(len(rewards))):
        advantage = torch.addcmul(delta[t], carried[t], advantage, out=out[t])
    return out


class ValueNorm(nn.Module):
    """Running mean and variance of returns with a bias correction, as HARL's: β = 0.99999, variance at least 0.01.

    Before it has seen a return it says mean 0 and deviation 1: the critic's units are then those of the reward, as they
    are without a normaliser. HARL says 0.1 there, not by choice: its floor for the variance meets sums that are still
    0. It matters to the values of the very first batch alone, for the critic learns from normalised returns only after
    they were seen.
    """

    mean_sum: Tensor  # ()
    square_sum: Tensor  # ()
    weight: Tensor  # ()

    def __init__(self, beta: float = 0.99999):
        super().__init__()
        self.beta = beta
        self.register_buffer("mean_sum", torch.zeros(()))
        self.register_buffer("square_sum", torch.zeros(()))
        self.register_buffer("weight", torch.zeros(()))

    @torch.no_grad()
    def update(self, returns: Tensor, part: Tensor, seen: Tensor, together: Together = ALONE) -> None:
        """Take returns (B,) into account, each with its part (B,) in their mean, if any were `seen`: () 1 or 0."""
        weight = (1 - self.beta) * seen
        mean, square = together.sum((returns * part).sum(), (returns**2 * part).sum())
        self.mean_sum.lerp_(mean, weight)  # β · sum + (1 − β) · mean
        self.square_sum.lerp_(square, weight)
        self.weight.lerp_(torch.ones_like(weight), weight)

    def statistics(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation (), in units of reward; 0 and 1 before the first update."""
        weight = self.weight.clamp(min=1e-12)  # asking whether it is 0 would make the GPU wait
        mean = self.mean_sum / weight
        std = torch.sqrt((self.square_sum / weight - mean**2).clamp(min=0.01))
        return mean, std.masked_fill(self.weight == 0, 1.0)

    def normalise(self, returns: Tensor) -> Tensor:
        """Returns in the critic's units."""
        mean, std = self.statistics()
        return (returns - mean) / std

    def denormalise(self, values: Tensor) -> Tensor:
        """The critic's values in units of reward."""
        mean, std = self.statistics()
        return values * std + mean
