"""The twin critic of a team, what its outputs mean, and the scale of rewards.

Values are learnt by classification (Farebrother et al., 2024, "Stop regressing"): a critic outputs logits of `bins`
numbers within ±`LIMIT`, its value is their mean, and the target is the histogram of a Gaussian around the target value
(HL-Gauss), which all its bins learn by cross-entropy.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import layer_norm, silu

from agents.settings import OBSERVATION_CLIP, VARIANCE_FLOOR

TWINS = 2
LIMIT = 5.0  # of values, in units of the scaled reward
SMOOTHING = 0.75  # deviation of a target's Gaussian, in bins


class TwinCritic(nn.Module):
    """Two critics of observations and actions in one stack: Linear, LayerNorm, SiLU for each hidden layer.

    A new critic's value is 0 everywhere.
    """

    def __init__(self, inputs: int, hidden: Sequence[int], bins: int):
        super().__init__()
        widths = (inputs, *hidden)
        self.weights, self.biases, self.gains, self.shifts = (nn.ParameterList() for _ in range(4))
        for a, b in pairwise(widths):
            self.weights.append(torch.stack([_initial(a, b) for _ in range(TWINS)]))
            self.biases.append(torch.zeros(TWINS, 1, b))
            self.gains.append(torch.ones(TWINS, 1, b))
            self.shifts.append(torch.zeros(TWINS, 1, b))
        self.last = nn.Parameter(torch.zeros(TWINS, widths[-1], bins))
        self.last_bias = nn.Parameter(torch.zeros(TWINS, 1, bins))

    def forward(self, seen: Tensor, actions: Tensor) -> Tensor:
        """Return both critics' logits (2, B, bins) of normalised observations (B, n) and actions (B, m) within ±1."""
        x = torch.cat([seen, actions], -1).expand(TWINS, -1, -1)
        for layer in zip(self.weights, self.biases, self.gains, self.shifts, strict=True):
            weight, bias, gain, shift = layer
            x = torch.baddbmm(bias, x, weight)
            x = silu(layer_norm(x, x.shape[-1:]) * gain + shift)
        return torch.baddbmm(self.last_bias, x, self.last).to(self.last.dtype)


def _initial(inputs: int, outputs: int) -> Tensor:
    """Return a random orthogonal matrix (inputs, outputs), scaled for SiLU as for ReLU."""
    return nn.init.orthogonal_(torch.empty(inputs, outputs), math.sqrt(2))


class Bins(nn.Module):
    """Numbers within ±`LIMIT` that logits stand for."""

    centres: Tensor  # (bins,)
    edges: Tensor  # (bins + 1,)

    def __init__(self, count: int):
        super().__init__()
        self.width = 2 * LIMIT / (count - 1)
        centres = torch.linspace(-LIMIT, LIMIT, count)
        self.register_buffer("centres", centres, persistent=False)
        edges = torch.cat([centres - self.width / 2, centres[-1:] + self.width / 2])
        self.register_buffer("edges", edges, persistent=False)

    def values(self, logits: Tensor) -> Tensor:
        """Return the mean (...) of the numbers by the probabilities of logits (..., bins)."""
        return logits.softmax(-1) @ self.centres

    def histogram(self, values: Tensor) -> Tensor:
        """Return probabilities (..., bins) of a Gaussian around values (...), cut off at the outermost edges."""
        near = values.clamp(-LIMIT, LIMIT)[..., None]
        below = torch.erf((self.edges - near) / (math.sqrt(2) * SMOOTHING * self.width))
        return below.diff(dim=-1) / (below[..., -1:] - below[..., :1])

    def losses(self, logits: Tensor, targets: Tensor) -> Tensor:
        """Return cross-entropies (2, B) of both critics' logits (2, B, bins) with the histograms of targets (B,)."""
        return -(self.histogram(targets) * logits.log_softmax(-1)).sum(-1)


class InputNorm(nn.Module):
    """Running mean and variance of a critic's observations, as actors have their own."""

    mean: Tensor  # (n,)
    var: Tensor  # (n,)
    count: Tensor  # ()

    def __init__(self, size: int):
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("var", torch.ones(size))
        self.register_buffer("count", torch.zeros(()))

    def forward(self, x: Tensor) -> Tensor:
        """Return observations (..., n) in units of their deviation, within ±10."""
        deviation = torch.sqrt(self.var.clamp(min=VARIANCE_FLOOR))
        return ((x - self.mean) / deviation).clamp(-OBSERVATION_CLIP, OBSERVATION_CLIP)


@torch.no_grad()
def merge_statistics(mean: Tensor, var: Tensor, count: Tensor, rows: Tensor, weights: Tensor) -> None:
    """Merge rows (B, n) of weight 1 or 0, `weights` (B,), into running statistics (Chan et al., 1979), in place."""
    n = weights.sum()
    share, each = n / (count + n).clamp(min=1), (weights / n.clamp(min=1))[:, None]
    own = (rows * each).sum(0)
    gap, own_var = own - mean, ((rows - own) ** 2 * each).sum(0)
    var.add_(share * (own_var - var) + share * (1 - share) * gap**2)
    mean.add_(share * gap)
    count.add_(n)


class RewardScale(nn.Module):
    """Unit of rewards, so that discounted returns have a deviation near 1 and stay within ±`LIMIT`.

    It is the larger one of the root mean square of the returns so far, and of the largest of them divided by the limit
    (as Lee et al., 2025, SimbaV2, scale rewards). The returns are running sums, G ← r + γ G.
    """

    square: Tensor  # () mean of G²
    most: Tensor  # () largest |G|
    count: Tensor  # ()

    def __init__(self):
        super().__init__()
        for name in ("square", "most", "count"):
            self.register_buffer(name, torch.zeros(()))
        self.returns = torch.zeros(0)  # (N,) of the worlds, at the end of the newest batch

    @torch.no_grad()
    def note(self, rewards: Tensor, over: Tensor, gamma: float) -> None:
        """Note rewards (T, N) of a batch whose worlds continue; `over` (T, N) bool: an episode ended with it."""
        if self.returns.shape != rewards.shape[1:]:
            self.returns = torch.zeros_like(rewards[0])
        G, found, goes_on = self.returns, torch.empty_like(rewards), ~over
        for t in range(len(rewards)):
            found[t] = rewards[t] + gamma * G
            G = found[t] * goes_on[t]
        self.returns.copy_(G)
        n = float(rewards.numel())
        self.count.add_(n)
        self.square.add_((found.square().mean() - self.square) * n / self.count)
        self.most.copy_(torch.maximum(self.most, found.abs().max()))

    @property
    def unit(self) -> Tensor:
        """() The unit, 1 before the first reward that is not 0."""
        unit = torch.maximum(self.square.sqrt(), self.most / LIMIT)
        return unit + (unit == 0)
