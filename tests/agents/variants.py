"""Settings of a learner, and the batches that they need, for what must hold of every variant."""

from typing import Any

import torch

from agents.batch import Batch, Side
from agents.settings import Architecture, HappoConfig

BASE = HappoConfig(
    Architecture((6,)), lr=0.01, critic_lr=0.02, epochs=3, minibatches=3, normalise_observations=True, max_grad_norm=0.5
)
RECURRENT = {"architecture": Architecture((6,), recurrent=5), "chunk": 4}
VARIANTS: dict[str, dict[str, Any]] = {
    "happo": {},
    "mappo": {"method": "mappo"},
    "ippo": {"method": "ippo"},
    "hatrpo": {"method": "hatrpo"},
    "shared": {"share_actors": True},
    "kl_stop": {"kl_stop": 0.02},
    "kl_step": {"kl_step": 0.01},
    "decay": {"decay_steps": 400},
    "privileged": {"critic_input": "privileged"},
    "same": {"critic_input": "same"},
    "recurrent": RECURRENT,
    "recurrent ippo": RECURRENT | {"method": "ippo"},
    "recurrent hatrpo": RECURRENT | {"method": "hatrpo"},
    "recurrent privileged": RECURRENT | {"critic_input": "privileged"},
}
SIGHT = 7  # numbers that a critic sees which sees no observations
SIDES = {"privileged": 1, "same": 2}  # from which such a critic learns


def with_sides(batch: Batch, sides: int, size: int = SIGHT, seed: int = 12) -> Batch:
    """The batch with what a critic sees from the team's own side and others; those end and break elsewhere."""
    rng = torch.Generator().manual_seed(seed)
    shape = batch.rewards.shape

    def side(number: int) -> Side:
        seen, then = (torch.randn((*shape, size), generator=rng) for _ in range(2))
        if number == 0:
            return Side(seen, then, batch.rewards, batch.terminated, batch.void)
        ends, broken = (torch.rand(shape, generator=rng) < 0.1 for _ in range(2))
        return Side(seen, then, torch.randn(shape, generator=rng) - 1.0, ends, broken)

    return batch._replace(sides=[side(number) for number in range(sides)])
