"""Files of entries, as a stranger would have them."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from agents.policy.networks import Actor
from agents.settings import Architecture
from arenas.rosters import roster_agents
from league.snapshots.policy_file import Policy
from storage.blobs import arrays


def network(
    path: Path, roster: str, seed: int = 0, broken: bool = False, means: Sequence[float] | None = None
) -> str:  # fmt: skip
    """Write an untrained policy of a roster in the form of `league export`; a broken one has a weight that is nan.

    With `means` each agent draws its actions about these numbers, whatever it sees.
    """
    torch.manual_seed(seed)
    found: dict[str, np.ndarray] = {}
    for i, agent in enumerate(roster_agents(roster)):
        _, sees, acts = agent.rsplit(":", 2)
        actor = Actor(int(sees), int(acts), Architecture((8,)), 0.8)
        found |= {f"{i}/{name}": tensor.numpy() for name, tensor in actor.state_dict().items()}
        if means is not None:
            found[f"{i}/mean.weight"] = np.zeros_like(found[f"{i}/mean.weight"])
            found[f"{i}/mean.bias"] = np.array(means, np.float32)
    if broken:
        found["0/mean.bias"] = np.full_like(found["0/mean.bias"], np.nan)
    about = {
        "format": 1, "league": "strangers", "name": "blue@1", "roster": roster, "settings": "", "arena": None,
        "digest": hashlib.sha256(arrays.to_bytes(found)).hexdigest(), "iteration": 1, "steps": 64, "seconds": 1.0,
    }  # fmt: skip
    path.write_bytes(Policy(found, about).to_bytes())
    return str(path)
