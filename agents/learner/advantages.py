"""Advantage estimation and value normalisation, in torch. T time, N worlds."""

import torch
from torch import Tensor, nn

from agents.devices.distributed import SINGLE_PROCESS, Communicator


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
    """Return generalised advantage estimates (T, N) (Schulman et al., 2016, eq. 16).

    `values` are V(s_t), `next_values` V(s_{t+1}) of the true next state, before any new episode began. A `terminated`
    state has no future, and nothing flows back across the end of an episode, whatever ended it. So a time limit
    bootstraps with the value of its true last observation, and a termination does not. The result of a `void` decision
    is unknown: its own advantage is 0, and decisions before it bootstrap with V of the state in which it was taken.
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

    Before the first return it gives mean 0 and deviation 1: the critic's units are then those of the reward, as without
    a normaliser. HARL gives a deviation of 0.1 there, unintentionally: its floor for the variance meets sums that are
    still 0. This affects only the values of the very first batch, because the critic learns from returns normalised
    with themselves included.
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
    def update(self, returns: Tensor, weights: Tensor, seen: Tensor, comm: Communicator = SINGLE_PROCESS) -> None:
        """Update the statistics with returns (B,), weighted (B,) in their mean, unless `seen` () is 0 instead of 1."""
        weight = (1 - self.beta) * seen
        mean, square = comm.sum((returns * weights).sum(), (returns**2 * weights).sum())
        self.mean_sum.lerp_(mean, weight)  # β · sum + (1 − β) · mean
        self.square_sum.lerp_(square, weight)
        self.weight.lerp_(torch.ones_like(weight), weight)

    def statistics(self) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation (), in units of reward; 0 and 1 before the first update."""
        weight = self.weight.clamp(min=1e-12)  # comparing with 0 would make the GPU wait
        mean = self.mean_sum / weight
        std = torch.sqrt((self.square_sum / weight - mean**2).clamp(min=0.01))
        return mean, std.masked_fill(self.weight == 0, 1.0)

    def normalise(self, returns: Tensor) -> Tensor:
        """Return returns in the critic's units."""
        mean, std = self.statistics()
        return (returns - mean) / std

    def denormalise(self, values: Tensor) -> Tensor:
        """Return the critic's values in units of reward."""
        mean, std = self.statistics()
        return values * std + mean
