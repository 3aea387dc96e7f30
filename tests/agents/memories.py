"""Learners that remember, and what torch's own cell would remember in their place."""

import torch
from torch import Tensor

from agents.learner.happo import HappoLearner
from agents.policy.networks import GRU
from agents.settings import HappoConfig


def scrambled(config: HappoConfig, seed: int = 0, sizes: tuple[list[int], list[int]] = ([2], [1])) -> HappoLearner:
    """A learner whose every weight counts, so that what it remembers shows."""
    learner, rng = HappoLearner(*sizes, config, seed), torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for each in (*learner.actor_learners, *learner.critic_learners):
            for weights in each.network.parameters():
                weights += 0.4 * torch.randn(weights.shape, generator=rng)
    return learner


def cell_of(gru: GRU) -> torch.nn.GRUCell:
    """Torch's own cell with the same weights under the same names."""
    cell = torch.nn.GRUCell(gru.weight_ih.shape[1], gru.weight_hh.shape[1])
    cell.load_state_dict({name: w for name, w in gru.state_dict().items() if not name.startswith("norm")})
    return cell.to(gru.weight_ih.dtype)


def evaluate_sequence(cell: torch.nn.GRUCell, x: Tensor, first: Tensor, memory: Tensor) -> Tensor:
    """What the cell remembers (B, L, units) over sequences, each episode from nothing."""
    states = []
    for t in range(x.shape[1]):
        memory = torch.where(first[:, t, None], torch.zeros_like(memory), memory)
        memory = cell(x[:, t], memory)
        states.append(memory)
    return torch.stack(states, 1)
