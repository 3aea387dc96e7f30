"""Actor and critic in torch. `agents/policy.py` acts in JAX with the very names that their state dicts have.

Trunk and heads are HARL's (Zhong et al., 2024): optional LayerNorm on the input, then Linear → activation → optional
LayerNorm for each hidden layer; orthogonal weights, zero biases, a small last layer. The standard deviation does not
depend on the state: σ = sigmoid(λ / x) · y with λ = x at the start; HARL's x = 1, y = 0.5 give σ = 0.366. Here x = 1
and y follows from the wanted first σ, so that σ stays within (0, y).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn
from torch.distributions import Normal

Activation = Literal["tanh", "relu", "elu"]
ACTIVATIONS: tuple[Activation, ...] = ("tanh", "relu", "elu")
_GAIN = {"tanh": 5 / 3, "relu": 2**0.5, "elu": 1.0}  # torch.nn.init.calculate_gain; elu has none there
_APPLY = {"tanh": torch.tanh, "relu": torch.relu, "elu": nn.functional.elu}
LAST_LAYER_GAIN = 0.01


@dataclass(frozen=True)
class Architecture:
    """The shape of a network, shared by a league's actors and critics."""

    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers."""
    activation: Activation = "tanh"
    """Non-linearity after each hidden layer."""
    layer_norm: bool = False
    """LayerNorm on the input and after each hidden layer, as HARL has it."""

    def __post_init__(self) -> None:
        """Refuse widths below 1."""
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"hidden: {list(self.hidden)} must be at least one width, each 1 or more")


class Trunk(nn.Module):
    """From observations (..., n) to features (..., hidden[-1])."""

    observation_mean: Tensor  # (n,)
    observation_var: Tensor  # (n,)

    def __init__(self, size: int, architecture: Architecture):
        super().__init__()
        widths = (size, *architecture.hidden)
        self._apply_activation = _APPLY[architecture.activation]
        layers = [nn.Linear(a, b) for a, b in pairwise(widths)]
        self.hidden = nn.ModuleList(layers)
        self.norm = nn.ModuleList(nn.LayerNorm(w) for w in widths if architecture.layer_norm)
        self.register_buffer("observation_mean", torch.zeros(size))
        self.register_buffer("observation_var", torch.ones(size))
        for layer in layers:
            nn.init.orthogonal_(layer.weight, _GAIN[architecture.activation])
            nn.init.zeros_(layer.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Features of observations."""
        x = (x - self.observation_mean) / torch.sqrt(self.observation_var + 1e-8)
        x = self.norm[0](x) if self.norm else x
        for i, layer in enumerate(self.hidden):
            x = self._apply_activation(layer(x))
            x = self.norm[i + 1](x) if self.norm else x
        return x


class Actor(nn.Module):
    """A diagonal Gaussian over actions, neither squashed nor clipped; the robot clips what it is told."""

    std_scale: Tensor  # () y
    activation: Tensor  # () int, an index into ACTIVATIONS: this is how the policy in JAX learns of it

    def __init__(self, observation_size: int, action_size: int, architecture: Architecture, initial_std: float):
        super().__init__()
        self.trunk = Trunk(observation_size, architecture)
        self.mean = nn.Linear(architecture.hidden[-1], action_size)
        self.std_logit = nn.Parameter(torch.ones(action_size))
        self.register_buffer("std_scale", torch.tensor(initial_std / torch.sigmoid(torch.tensor(1.0)).item()))
        self.register_buffer("activation", torch.tensor(ACTIVATIONS.index(architecture.activation), dtype=torch.int32))
        nn.init.orthogonal_(self.mean.weight, LAST_LAYER_GAIN)
        nn.init.zeros_(self.mean.bias)

    def forward(self, observations: Tensor) -> Normal:
        """The distribution of actions (..., action_size) given observations (..., observation_size)."""
        std = torch.sigmoid(self.std_logit) * self.std_scale
        mean = self.mean(self.trunk(observations))
        return Normal(mean, std.expand_as(mean), validate_args=False)


class Critic(nn.Module):
    """The team's value from the concatenated observations of its own agents, in normalised units (see ValueNorm)."""

    def __init__(self, observation_sizes: Sequence[int], architecture: Architecture):
        super().__init__()
        self.trunk = Trunk(sum(observation_sizes), architecture)
        self.value = nn.Linear(architecture.hidden[-1], 1)
        nn.init.orthogonal_(self.value.weight, 1.0)
        nn.init.zeros_(self.value.bias)

    def forward(self, team_observations: Tensor) -> Tensor:
        """Values (...) of team observations (..., sum of sizes)."""
        return self.value(self.trunk(team_observations)).squeeze(-1)
