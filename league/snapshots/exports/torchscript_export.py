"""A frozen policy's network as a TorchScript file, with the inputs and outputs of its ONNX file (`onnx_export`).

`forward(observations, noise)` returns the actions; of a policy that remembers `forward(observations, noise, memory)`
returns the actions and the next memory, and the attribute `memory_size` is the number of its units. A policy over
skills also has the attribute `noise_size`.
"""

import io
import warnings
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from agents.policy.skill_arrays import PREFIX, skill_of, strategy_of
from agents.settings import SQUASH_EDGE, VARIANCE_FLOOR
from league.snapshots.exports.networks import memory_units, noise_size


def torchscript_bytes(arrays: Mapping[str, np.ndarray], agent: Mapping[str, Any]) -> bytes:
    """Return the TorchScript file of one agent's network; the arguments are those of `onnx_bytes`."""
    kind = _OverSkills if "over" in agent else _Recurrent if agent.get("recurrent") else _Plain
    module = kind(arrays, agent).eval().requires_grad_(False)  # a memory would keep the graph of a whole episode
    data = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # torch advises torch.export; robots still load TorchScript
        torch.jit.save(torch.jit.script(module), data)
    return data.getvalue()


def _activated(x: Tensor, activation: str) -> Tensor:
    """Apply an activation by its name."""
    if activation == "tanh":
        return torch.tanh(x)
    if activation == "relu":
        return torch.relu(x)
    return nn.functional.elu(x)


class _Encoder(nn.Module):
    """Mean and maximum of one set of entities (`agents.policy.entities`)."""

    index: Tensor  # (entities, numbers)

    def __init__(self, arrays: Mapping[str, np.ndarray], number: int, activation: str):
        super().__init__()
        name = f"trunk.entities.{number}"
        self.activation = activation
        self.register_buffer("index", torch.tensor(arrays[f"{name}.index"], dtype=torch.int64))
        weights = [arrays[f"{name}.layers.{i}.weight"] for i in range(2)]
        self.layers = nn.ModuleList(nn.Linear(weight.shape[1], weight.shape[0]) for weight in weights)
        self.layers.load_state_dict({
            key: torch.tensor(arrays[f"{name}.layers.{key}"]) for key in self.layers.state_dict()
        })  # fmt: skip

    def forward(self, observations: Tensor, x: Tensor) -> Tensor:
        """Return the features (n, 2 width) of raw and of normalised observations (n, obs)."""
        there = (observations[:, self.index] != 0).any(-1, keepdim=True)
        rows = x[:, self.index]
        for layer in self.layers:
            rows = _activated(layer(rows), self.activation)
        mean = (rows * there).sum(1) / there.sum(1).clamp(min=1)
        most = rows.masked_fill(~there, -1e30).amax(1)
        return torch.cat([mean, most.masked_fill(~there.any(1), 0.0)], -1)


class _Policy(nn.Module):
    """The parts of a policy without its memory."""

    mean: Tensor  # (obs,) of observations
    deviation: Tensor  # (obs,)
    own: Tensor  # places of the numbers that belong to no entity

    def __init__(self, arrays: Mapping[str, np.ndarray], agent: Mapping[str, Any]):
        super().__init__()
        sets: list[list[int]] = agent.get("entities", [])
        own = arrays.get("trunk.own", np.arange(agent["observation"]))
        widths, normed, last = [len(own), *agent["hidden"]], agent["layer_norm"], agent["hidden"][-1:]
        widths[0] += 2 * sum(width for *_, width in sets)
        self.sets = len(sets)
        self.register_buffer("own", torch.tensor(own, dtype=torch.int64))
        self.encoders = nn.ModuleList(_Encoder(arrays, i, agent["activation"]) for i in range(len(sets)))
        self.activation: str = agent["activation"]
        self.clip = float(arrays["trunk.observation_clip"])
        self.squash = float(agent["squash"] or 0.0)
        self.edge = SQUASH_EDGE
        self.register_buffer("mean", torch.tensor(arrays["trunk.observation_mean"]))
        floor = np.float32(VARIANCE_FLOOR)
        self.register_buffer("deviation", torch.tensor(np.sqrt(np.maximum(arrays["trunk.observation_var"], floor))))
        norms = [nn.LayerNorm(w) if normed else nn.Identity() for w in widths]
        self.first_norm = norms[0]
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        self.norms = nn.ModuleList(norms[1:])
        width = agent.get("recurrent") or (last[0] if last else agent["observation"])
        self.action = nn.Linear(width, agent["action"])
        self.logit = nn.Linear(width, agent["action"])
        self.std_scale = float(arrays["std_scale"])
        weights = {"action": "mean", "logit": "deviation", "first_norm": "trunk.norm.0"}
        weights |= {f"hidden.{i}": f"trunk.hidden.{i}" for i in range(len(self.hidden))}
        weights |= {f"norms.{i}": f"trunk.norm.{i + 1}" for i in range(len(self.norms))}
        with torch.no_grad():
            for name, source in weights.items():
                for part, parameter in self.get_submodule(name).named_parameters():
                    if f"{source}.{part}" in arrays:
                        parameter.copy_(torch.tensor(arrays[f"{source}.{part}"]))
            if "std_logit" in arrays:  # a deviation that does not depend on observations
                self.logit.weight.zero_()
                self.logit.bias.copy_(torch.tensor(arrays["std_logit"]))

    def features(self, observations: Tensor) -> Tensor:
        """Return the output of the hidden layers."""
        x = ((observations - self.mean) / self.deviation).clamp(-self.clip, self.clip)
        if self.sets > 0:
            parts = [x[:, self.own]]
            for encoder in self.encoders:
                parts.append(encoder(observations, x))
            x = torch.cat(parts, -1)
        x = self.first_norm(x)
        for layer, norm in zip(self.hidden, self.norms):  # noqa: B905  (TorchScript has no strict)
            x = layer(x)
            x = norm(_activated(x, self.activation))
        return x

    def actions(self, x: Tensor, noise: Tensor) -> Tensor:
        """Return the actions for the last layer's input."""
        drawn = self.action(x) + torch.sigmoid(self.logit(x)) * self.std_scale * noise
        if self.squash > 0.0:
            return self.squash * torch.tanh(drawn / self.squash).clamp(-self.edge, self.edge)
        return drawn


class _Plain(_Policy):
    """A policy without memory."""

    def forward(self, observations: Tensor, noise: Tensor) -> Tensor:
        """Return the actions (n, act)."""
        return self.actions(self.features(observations), noise)


class _Recurrent(_Policy):
    """A policy with a GRU, whose gates torch orders as `agents.policy.networks.GRU` does."""

    def __init__(self, arrays: Mapping[str, np.ndarray], agent: Mapping[str, Any]):
        super().__init__(arrays, agent)
        self.memory_size: int = agent["recurrent"]
        last = [agent["observation"], *agent["hidden"]][-1]
        self.cell = nn.GRUCell(last, self.memory_size)
        self.out_norm = nn.LayerNorm(self.memory_size) if agent["layer_norm"] else nn.Identity()
        self.cell.load_state_dict({name: torch.tensor(arrays[f"gru.{name}"]) for name in self.cell.state_dict()})
        self.out_norm.load_state_dict(
            {name: torch.tensor(arrays[f"gru.norm.{name}"]) for name in self.out_norm.state_dict()}
        )

    def forward(self, observations: Tensor, noise: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the actions (n, act) and the next memory (n, units)."""
        after = self.cell(self.features(observations), memory)
        return self.actions(self.out_norm(after), noise), after


class _Skill(nn.Module):
    """A skill, and what it sees of an observation and a command."""

    source: Tensor  # (n,) places in the observation
    target: Tensor  # (n,) places in the command
    fill: Tensor  # (n,)

    def __init__(self, arrays: Mapping[str, np.ndarray], agent: Mapping[str, Any]):
        super().__init__()
        self.policy = _Plain(arrays, agent)
        self.size: int = agent["action"]
        for name in ("source", "target"):
            self.register_buffer(name, torch.tensor(arrays[name], dtype=torch.int64))
        self.register_buffer("fill", torch.tensor(arrays["fill"]))

    def forward(self, observations: Tensor, command: Tensor) -> Tensor:
        """Return the mean actions (n, act), given both with a column of zeros at their ends."""
        x = observations[:, self.source] + self.fill + command[:, self.target]
        return self.policy(x, torch.zeros(x.shape[0], self.size, dtype=x.dtype, device=x.device))


class _OverSkills(nn.Module):
    """A policy over skills; see `agents.policy.skills`."""

    def __init__(self, arrays: Mapping[str, np.ndarray], agent: Mapping[str, Any]):
        super().__init__()
        over = agent["over"]
        self.memory_size: int = memory_units(agent)
        self.noise_size: int = noise_size(agent)
        self.strategy = _Plain(strategy_of(arrays), over["strategy"])
        self.skills = nn.ModuleList(_Skill(skill_of(arrays, i), skill) for i, skill in enumerate(over["skills"]))
        self.every, self.blend = float(over["every"]), bool(over["blend"])
        self.reach = float(arrays[f"{PREFIX}reach"])
        self.choices: int = over["choices"]
        self.command: int = over["command"]

    def forward(self, observations: Tensor, noise: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the actions (n, act) and the next memory (n, 1 + choices)."""
        left, held = memory[:, :1], memory[:, 1:]
        due = left < 1.0
        choice = torch.where(due, self.strategy(observations, noise[:, : self.choices]), held)
        after = torch.cat([left.masked_fill(due, self.every) - 1.0, choice], -1)
        nothing = torch.zeros_like(left)
        command = self.reach * choice[:, : self.command].clamp(-1.0, 1.0)
        seen, commanded = torch.cat([observations, nothing], -1), torch.cat([command, nothing], -1)
        scores = choice[:, self.command :]
        weights = torch.softmax(scores, -1)
        if not self.blend and scores.shape[1] > 0:
            weights = torch.nn.functional.one_hot(scores.argmax(-1), scores.shape[1]).to(scores.dtype)
        actions = choice
        for i, skill in enumerate(self.skills):
            own = skill(seen, commanded)
            if len(self.skills) > 1:
                share = weights[:, i : i + 1] * own
                actions = share if i == 0 else actions + share
            else:
                actions = own
        return actions, after
