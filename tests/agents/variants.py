"""Settings of a learner, and the batches that they need, for what must hold of every variant."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch.utils import _pytree as pytree

from agents.batch import Batch, CriticView
from agents.learner.happo import HappoLearner
from agents.settings import Architecture, HappoConfig

BASE = HappoConfig(
    Architecture((6,)), lr=0.01, critic_lr=0.02, epochs=3, minibatches=3, normalise_observations=True, max_grad_norm=0.5
)
RECURRENT = {"architecture": Architecture((6,), recurrent=5), "chunk_length": 4}
VARIANTS: dict[str, dict[str, Any]] = {
    "happo": {},
    "mappo": {"method": "mappo"},
    "ippo": {"method": "ippo"},
    "hatrpo": {"method": "hatrpo"},
    "shared": {"share_actors": True},
    "target_kl": {"target_kl": 0.02},
    "desired_kl": {"desired_kl": 0.01},
    "decay": {"lr_decay_steps": 400},
    "privileged": {"critic_input": "privileged"},
    "same": {"critic_input": "same"},
    "recurrent": RECURRENT,
    "recurrent ippo": RECURRENT | {"method": "ippo"},
    "recurrent hatrpo": RECURRENT | {"method": "hatrpo"},
    "recurrent privileged": RECURRENT | {"critic_input": "privileged"},
}
EVERY_UPDATE = VARIANTS | {  # also where networks and precisions make other kernels of it
    "squashed": {"architecture": Architecture((6,), squash=1.5, state_std=True)},
    "bf16": {"precision": "bf16"},
    "recurrent, shared": {
        "architecture": Architecture((6,), "elu", True, recurrent=5), "chunk_length": 2, "share_actors": True
    },
    "recurrent bf16": RECURRENT | {"precision": "bf16"},
    "paper": {"architecture": Architecture((6, 6), "relu", layer_norm=True), "minibatches": 1, "fixed_order": True},
}  # fmt: skip
AGENTS = [4, 4, 3], [2, 2, 1]  # numbers that each of them observes, and chooses
SIGHT = 7  # numbers that a critic sees which sees no observations
SIDES = {"privileged": 1, "same": 2}  # from which such a critic learns


def with_sides(batch: Batch, critic_views: int, size: int = SIGHT, seed: int = 12) -> Batch:
    """The batch with what a critic sees from the team's own side and others; those end and break elsewhere."""
    rng = torch.Generator().manual_seed(seed)
    shape = batch.rewards.shape

    def side(number: int) -> CriticView:
        seen, then = (torch.randn((*shape, size), generator=rng) for _ in range(2))
        if number == 0:
            return CriticView(seen, then, batch.rewards, batch.terminated, batch.void)
        ends, broken = (torch.rand(shape, generator=rng) < 0.1 for _ in range(2))
        return CriticView(seen, then, torch.randn(shape, generator=rng) - 1.0, ends, broken)

    return batch._replace(critic_views=[side(number) for number in range(critic_views)])


def experienced(experience: Callable[..., Batch], learner: HappoLearner, seed: int, N: int) -> Batch:
    """A batch with void decisions and agents that are out of the game."""
    agents = len(learner.actors)
    sizes = (each[-agents:] for each in AGENTS)
    cpu = HappoLearner(*sizes, replace(learner.config, cuda_graphs=False), 3, critic_size=SIGHT)
    batch, rng = experience(cpu, seed=seed, N=N, void=0.2), torch.Generator().manual_seed(seed)
    alive = [torch.rand(batch.rewards.shape, generator=rng) < 0.7 for _ in range(2 * agents)]
    batch = batch._replace(alive=alive[:agents], next_alive=alive[agents:])
    batch = with_sides(batch, SIDES.get(learner.config.critic_input, 0), seed=seed)
    return pytree.tree_map(lambda x: x.to(learner.device), batch)
