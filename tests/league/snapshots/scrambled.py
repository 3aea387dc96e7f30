"""Networks of which every number counts, for tests of exports."""

import numpy as np
import torch

from agents.policy.networks import Actor


def scrambled_arrays(actor: Actor) -> dict[str, np.ndarray]:
    """The arrays of an actor after all its parameters and statistics have been moved at random."""
    with torch.no_grad():
        for weights in actor.parameters():
            weights += 0.4 * torch.randn(weights.shape)
        actor.trunk.observation_mean.normal_()
        actor.trunk.observation_var.uniform_(0.0, 2.0)
        actor.trunk.observation_clip.fill_(1.5)
    return {name: tensor.numpy() for name, tensor in actor.state_dict().items()}
