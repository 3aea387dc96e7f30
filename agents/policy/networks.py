"""Actor and critic in torch. `agents/policy/jax_policy.py` acts in JAX with the names of their state dicts.

Trunk and heads are HARL's (Zhong et al., 2024): optional LayerNorm on the input, then Linear → activation → optional
LayerNorm for each hidden layer; orthogonal weights, zero biases, a small last layer. The standard deviation does not
depend on the state: σ = sigmoid(λ / x) · y with λ = x at the start; HARL's x = 1, y = 0.5 give σ = 0.366. Here x = 1
and y follows from the desired initial σ, so that σ stays within (0, y). With `state_std`, λ is the output of a second
last layer whose biases start at x.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Normal

from agents.batch import Normalised, Sequences
from agents.policy.entities import EntityEncoder
from agents.policy.entity_places import Index, own_numbers
from agents.policy.tanh import tanh
from agents.settings import ACTIVATIONS, SQUASH_EDGE, VARIANCE_FLOOR, Architecture

_GAIN = {"tanh": 5 / 3, "relu": 2**0.5, "elu": 1.0}  # torch.nn.init.calculate_gain; it knows no elu
_APPLY = {"tanh": tanh, "relu": torch.relu, "elu": nn.functional.elu}
LAST_LAYER_GAIN = 0.01
QUADRATURE_NODES = 16  # for the entropy of a squashed policy
LOG_ROOT = 0.5 * math.log(2 * math.pi)
NO_CLIP = torch.finfo(torch.float32).max


class Trunk(nn.Module):
    """Hidden layers, from observations (..., n) to features (..., hidden[-1])."""

    observation_mean: Tensor  # (n,)
    observation_var: Tensor  # (n,)
    observation_clip: Tensor  # () clip limit of normalised observations

    own: Tensor  # (m,) int32: places of the numbers that belong to no entity; missing without entities

    def __init__(self, size: int, architecture: Architecture, entities: Sequence[Index] = ()):
        super().__init__()
        sets, encoded = (entities if architecture.entities else ()), size
        activation, gain = _APPLY[architecture.activation], _GAIN[architecture.activation]
        self.entities = nn.ModuleList(EntityEncoder(each, architecture.entities, activation, gain) for each in sets)
        if sets:
            own = own_numbers(size, sets)
            self.register_buffer("own", torch.tensor(own, dtype=torch.int32))
            encoded = len(own) + 2 * architecture.entities * len(sets)
        widths = (encoded, *architecture.hidden)
        self._apply_activation = activation
        layers = [nn.Linear(a, b) for a, b in pairwise(widths)]
        self.hidden = nn.ModuleList(layers)
        self.norm = nn.ModuleList(nn.LayerNorm(w) for w in widths if architecture.layer_norm)
        self.register_buffer("observation_mean", torch.zeros(size))
        self.register_buffer("observation_var", torch.ones(size))
        self.register_buffer("observation_clip", torch.tensor(NO_CLIP))
        for layer in layers:
            nn.init.orthogonal_(layer.weight, _GAIN[architecture.activation])
            nn.init.zeros_(layer.bias)

    def normalised(self, x: Tensor) -> Normalised:
        """Normalise observations by the statistics of all observations so far, and clip them."""
        values = (x - self.observation_mean) / self._deviation(self.observation_var)
        values = values.clamp(-self.observation_clip, self.observation_clip)
        for encoder in self._encoders():
            values = encoder.without_absent(x, values)
        return Normalised(values)

    def forward(self, x: Tensor | Normalised) -> Tensor:
        """Return features of observations."""
        seen = (x if isinstance(x, Normalised) else self.normalised(x)).values
        if self.entities:
            seen = torch.cat([seen[..., self.own], *(encoder(seen) for encoder in self._encoders())], -1)
        features: Tensor = self.norm[0](seen) if self.norm else seen
        for i, layer in enumerate(self.hidden):
            features = self._apply_activation(layer(features))
            features = self.norm[i + 1](features) if self.norm else features
        return features

    @torch.no_grad()
    def renormalise(self, mean: Tensor, var: Tensor, known: Tensor) -> None:
        """Replace the statistics (n,) and keep the network's outputs for inputs that were `known` (n,) bool.

        W (x − m) / σ + b = W' (x − m') / σ' + b' where W' = W σ' / σ and b' = b + W (m' − m) / σ: the counterpart, in
        front of a network, of PopArt (van Hasselt et al., 2016) behind one. Otherwise each batch would change the
        policy, strongly so when it continues in another arena. Behind a LayerNorm of the input no weights can
        compensate. Nor can they where inputs are clipped: an input that has hardly varied so far is clipped as soon as
        it varies, and its weights, which had next to no effect, would then have a hundred times as much. Such weights
        stay unchanged. All entities of a set have the statistics of the set.
        """
        for encoder in self._encoders():
            mean, var = encoder.pooled(mean, var)
        before, now = self._deviation(self.observation_var), self._deviation(var)
        new = ~known | (self.observation_var < VARIANCE_FLOOR)
        moved = ((mean - self.observation_mean) / before).masked_fill(new, 0.0)
        scale = (now / before).masked_fill(new, 1.0)
        firsts = [(encoder.layers[0], encoder.index[0]) for encoder in self._encoders()]
        if not self.norm:
            firsts.append((self.hidden[0], self.own if self.entities else torch.arange(len(mean), device=mean.device)))
        for layer, places in firsts:
            assert isinstance(layer, nn.Linear)
            of_inputs = layer.weight[:, : len(places)]  # a view; features of entities follow
            layer.bias.add_(of_inputs @ moved[places])
            of_inputs.mul_(scale[places])
        self.observation_mean.copy_(mean)
        self.observation_var.copy_(var)

    def _encoders(self) -> list[EntityEncoder]:
        return [encoder for encoder in self.entities if isinstance(encoder, EntityEncoder)]

    @staticmethod
    def _deviation(var: Tensor) -> Tensor:
        return torch.sqrt(var.clamp(min=VARIANCE_FLOOR))


class GRU(nn.Module):
    """Gated recurrent unit (Cho et al., 2014) over sequences, with torch.nn.GRUCell's formulas and names.

    r, z = sigmoid(W x + b + U h + c);  n = tanh(W x + b + r·(U h + c));  h ← (1 − z)·n + z·h

    Weights are orthogonal and biases zero, as in HARL.
    """

    def __init__(self, size: int, units: int, layer_norm: bool):
        super().__init__()
        self.weight_ih = nn.Parameter(torch.empty(3 * units, size))
        self.weight_hh = nn.Parameter(torch.empty(3 * units, units))
        self.bias_ih = nn.Parameter(torch.zeros(3 * units))
        self.bias_hh = nn.Parameter(torch.zeros(3 * units))
        self.norm = nn.LayerNorm(units) if layer_norm else None
        nn.init.orthogonal_(self.weight_ih)
        nn.init.orthogonal_(self.weight_hh)

    def forward(self, x: Tensor, first: Tensor, memory: Tensor) -> Tensor:
        """Return hidden states (B, L, units) after each of L inputs (B, L, size), given the state before (B, units).

        The state restarts from zeros where an episode begins, `first` (B, L) bool.
        """
        units, states = memory.shape[-1], []
        inputs = nn.functional.linear(x, self.weight_ih, self.bias_ih)
        for new, begins in zip(inputs.unbind(1), first.unbind(1), strict=True):
            memory = memory.masked_fill(begins[:, None], 0.0)
            own = nn.functional.linear(memory, self.weight_hh, self.bias_hh)
            r, z = torch.sigmoid(new[:, : 2 * units] + own[:, : 2 * units]).chunk(2, -1)
            n = tanh(new[:, 2 * units :] + r * own[:, 2 * units :])
            memory = n + z * (memory - n)
            states.append(memory)
        return torch.stack(states, 1)

    def output(self, states: Tensor) -> Tensor:
        """Return the last layer's input for hidden states (..., units)."""
        return states if self.norm is None else self.norm(states)


class Network(nn.Module):
    """Trunk and, if the architecture is recurrent, a GRU after it. A recurrent network takes `Sequences`."""

    def __init__(self, size: int, architecture: Architecture, entities: Sequence[Index] = ()):
        super().__init__()
        self.trunk = Trunk(size, architecture, entities)
        self.width = architecture.recurrent or architecture.hidden[-1]  # input size of the last layer
        recurrent, layer_norm = architecture.recurrent, architecture.layer_norm
        self.gru = GRU(architecture.hidden[-1], recurrent, layer_norm) if recurrent else None

    @property
    def dtype(self) -> torch.dtype:
        """Data type of outputs; autocast may compute in a smaller one."""
        return self.trunk.observation_mean.dtype

    def states(self, seen: Sequences) -> Tensor:
        """Return a recurrent network's hidden states (B, L, units) after each observation."""
        assert self.gru is not None
        return self.gru(self.trunk(seen.observations), seen.first, seen.memory)

    def features(self, seen: Tensor | Normalised | Sequences) -> Tensor:
        """Return the last layer's input (..., width). Raises TypeError if a recurrent network gets no `Sequences`."""
        if self.gru is None:
            return self.trunk(seen)
        if not isinstance(seen, Sequences):
            raise TypeError("a recurrent network sees sequences, and was given single observations")
        return self.gru.output(self.states(seen))


class Gaussian(Normal):
    """torch's Normal with fewer kernels in its density and the density's gradient."""

    def __init__(self, mean: Tensor, std: Tensor):
        super().__init__(mean, std, validate_args=False)
        self._log_std = self.scale.log()

    def log_prob(self, value: Tensor) -> Tensor:
        """Return log N(a; μ, σ) = −z² / 2 − log σ − log(2π) / 2, where z = (a − μ) / σ."""
        return -0.5 * ((value - self.loc) / self.scale).square() - (self._log_std + LOG_ROOT)

    def entropy(self) -> Tensor:
        """Return ½ + log(2π) / 2 + log σ."""
        return self._log_std + (0.5 + LOG_ROOT)


class Actor(Network):
    """Diagonal Gaussian over actions, squashed if the architecture says so; otherwise the robot clips its commands.

    The names of its parameters and buffers tell the policy in JAX which kind it is: `squash`, `gru`, and `deviation`
    instead of `std_logit`.
    """

    std_scale: Tensor  # () y
    activation: Tensor  # () int, index into ACTIVATIONS, for the policy in JAX
    squash: Tensor  # () limit of squashed actions
    nodes: Tensor  # (QUADRATURE_NODES,) of a standard normal variable, for the entropy of squashed actions
    weights: Tensor  # (NODES,) and how much each counts

    def __init__(
        self, observation_size: int, action_size: int, architecture: Architecture, initial_std: float,
        entities: Sequence[Index] = (),
    ):  # fmt: skip
        super().__init__(observation_size, architecture, entities)
        self.mean = nn.Linear(self.width, action_size)
        if architecture.state_std:
            self.deviation = nn.Linear(self.width, action_size)
        else:
            self.std_logit = nn.Parameter(torch.ones(action_size))
        self.register_buffer("std_scale", torch.tensor(initial_std / torch.sigmoid(torch.tensor(1.0)).item()))
        self.register_buffer("activation", torch.tensor(ACTIVATIONS.index(architecture.activation), dtype=torch.int32))
        if architecture.squash is not None:
            self.register_buffer("squash", torch.tensor(float(architecture.squash)))
            nodes, weights = np.polynomial.hermite_e.hermegauss(QUADRATURE_NODES)
            self.register_buffer("nodes", torch.tensor(nodes).float(), persistent=False)
            self.register_buffer("weights", torch.tensor(weights / weights.sum()).float(), persistent=False)
        nn.init.orthogonal_(self.mean.weight, LAST_LAYER_GAIN)
        nn.init.zeros_(self.mean.bias)
        if architecture.state_std:
            nn.init.orthogonal_(self.deviation.weight, LAST_LAYER_GAIN)
            nn.init.ones_(self.deviation.bias)
        self._squashed, self._state_std = architecture.squash is not None, architecture.state_std

    def gaussian(self, observations: Tensor | Normalised | Sequences) -> Gaussian:
        """Return the Gaussian (..., action_size) before squashing, given observations (..., observation_size)."""
        features = self.features(observations)
        mean = self.mean(features).to(self.dtype)
        logit = self.deviation(features).to(self.dtype) if self._state_std else self.std_logit
        std = torch.sigmoid(logit) * self.std_scale
        return Gaussian(mean, std.expand_as(mean))

    def forward(self, observations: Tensor | Normalised | Sequences) -> "Gaussian | SquashedGaussian":
        """Return the distribution of actions (..., action_size) given observations (..., observation_size)."""
        gaussian = self.gaussian(observations)
        return SquashedGaussian(gaussian, self.squash, self.nodes, self.weights) if self._squashed else gaussian


class SquashedGaussian:
    """Distribution of c·tanh(u / c) for a diagonal Gaussian u and a limit c: about u near 0, and always within ±c."""

    def __init__(self, gaussian: Gaussian, limit: Tensor, nodes: Tensor, weights: Tensor):
        self.gaussian, self.limit, self._nodes, self._weights = gaussian, limit, nodes, weights

    def log_prob(self, actions: Tensor) -> Tensor:
        """Return log densities (..., action_size) of actions: that of u, minus log(1 − (a / c)²).

        Actions at the limit, where no density exists, count as slightly smaller (SQUASH_EDGE).
        """
        share = (actions * self.limit.reciprocal()).clamp(-SQUASH_EDGE, SQUASH_EDGE)  # rounds alike in JAX
        outer, inner = torch.log1p(share), torch.log1p(-share)
        u = 0.5 * self.limit * (outer - inner)  # c·atanh(a / c)
        return self.gaussian.log_prob(u) - outer - inner

    def entropy(self) -> Tensor:
        """Return the entropy (..., action_size): that of u, plus the mean of log da/du, by Gauss-Hermite quadrature.

        log(1 − tanh² x) = 2 (log 2 − x − softplus(−2x)), which loses no digits far from 0.
        """
        x = (self.gaussian.mean[..., None] + self.gaussian.stddev[..., None] * self._nodes) / self.limit
        slope = 2 * (math.log(2) - x - nn.functional.softplus(-2 * x))
        return self.gaussian.entropy() + (slope * self._weights).sum(-1)


class Critic(Network):
    """A team's value function, in normalised units (see ValueNorm), of inputs such as its agents' observations."""

    def __init__(self, sizes: Sequence[int], architecture: Architecture, entities: Sequence[Index] = ()):
        super().__init__(sum(sizes), architecture, entities)
        self.value = nn.Linear(self.width, 1)
        nn.init.orthogonal_(self.value.weight, 1.0)
        nn.init.zeros_(self.value.bias)

    def forward(self, seen: Tensor | Normalised | Sequences) -> Tensor:
        """Return values (...) of inputs (..., sum of sizes)."""
        return self._value(self.features(seen))

    def evaluate_sequence(self, seen: Sequences, following: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return a recurrent critic's values (B, L) of its inputs and of the inputs that follow each of them.

        Also returns its hidden states (B, L, units). `following` (B, L, n) belongs to the same episode, even where that
        ends.
        """
        assert self.gru is not None
        states = self.states(seen)
        alone = following.flatten(0, 1)[:, None]
        then = self.states(Sequences(alone, seen.first.new_zeros(alone.shape[:2]), states.flatten(0, 1)))
        return self._value(self.gru.output(states)), self._value(self.gru.output(then.view_as(states))), states

    def _value(self, features: Tensor) -> Tensor:
        return self.value(features).squeeze(-1).to(self.dtype)
