"""Sets of entities in observations: a shared encoder of each set, then masked mean and maximum (Zaheer et al. 2017).

Deep Sets: an order of the entities has no effect, and absent ones, whose numbers are all zero, none either.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from agents.policy.entity_places import Index


class EntityEncoder(nn.Module):
    """Encoder of one set: from its numbers in an observation (..., n) to features (..., 2 width)."""

    index: Tensor  # (entities, numbers) int32

    def __init__(self, index: Index, width: int, activation: Callable[[Tensor], Tensor], gain: float):
        super().__init__()
        places = np.asarray(index, np.int32)
        self.register_buffer("index", torch.tensor(places))
        self._activation = activation
        layers = [nn.Linear(places.shape[1], width), nn.Linear(width, width)]
        self.layers = nn.ModuleList(layers)
        for layer in layers:
            nn.init.orthogonal_(layer.weight, gain)
            nn.init.zeros_(layer.bias)

    def without_absent(self, observations: Tensor, normalised: Tensor) -> Tensor:
        """Return normalised observations (..., n) in which absent entities are zeros, as they were before."""
        there = (observations[..., self.index] != 0).any(-1, keepdim=True).expand(*observations.shape[:-1], *self.shape)
        keep = torch.ones_like(normalised)
        keep[..., self.index.flatten()] = there.flatten(-2).to(keep.dtype)
        return normalised * keep

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of entities, and of numbers of each."""
        entities, numbers = self.index.shape
        return entities, numbers

    def forward(self, seen: Tensor) -> Tensor:
        """Return mean and maximum over the entities that are there, zeros if none is."""
        rows = seen[..., self.index]
        there = (rows != 0).any(-1, keepdim=True)
        for layer in self.layers:
            rows = self._activation(layer(rows))
        mean = (rows * there).sum(-2) / there.sum(-2).clamp(min=1)
        most = rows.masked_fill(~there, torch.finfo(rows.dtype).min).amax(-2)
        return torch.cat([mean, most.masked_fill(~there.any(-2), 0.0)], -1)

    def pooled(self, mean: Tensor, var: Tensor) -> tuple[Tensor, Tensor]:
        """Return statistics (n,) in which all entities of the set have those of the set."""
        each, spread = mean[self.index], var[self.index]
        one, own = each.mean(0), spread.mean(0) + each.var(0, unbiased=False)
        mean, var = mean.clone(), var.clone()
        mean[self.index], var[self.index] = one.expand_as(each), own.expand_as(each)
        return mean, var
