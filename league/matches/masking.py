"""Masks of observations: a policy that sees its opponent as it was at the start of the episode, and never after.

Gleave et al. 2020, "Adversarial policies": a victim that is blind to its opponent in this way loses far less to an
attacker that wins by how it looks, and more to one that wins by what it does.
"""

from collections.abc import Sequence

import numpy as np

from arenas.arena import Arena
from league.config.schema import ConfigError


def opponent_numbers(arena: Arena, agent: str) -> np.ndarray:
    """Return (obs,) bool: the numbers of the agent's observation that are about the other team.

    Raises ConfigError, one line, if the arena does not say which they are.
    """
    parts = arena.observation_parts(agent)
    found = np.concatenate([np.full(part.size, part.opponent) for part in parts]) if parts else np.zeros(0, bool)
    if not found.any():
        raise ConfigError(
            (), f"--mask-opponent: arena {arena.name} does not say which numbers of {agent}'s observation are the"
            " opponent's: mark them in its observation_parts, Part(..., opponent=True)",
        )  # fmt: skip
    return found


def mask_opponents(arena: Arena, teams: Sequence[int], each: int) -> dict[str, np.ndarray]:
    """Return masks by agent name, (groups × each, obs) bool, for groups of `each` worlds.

    In the i-th group the policy of team `teams[i]` is masked.
    """
    masked = np.repeat(teams, each)
    return {
        agent.name: (masked == i)[:, None] & opponent_numbers(arena, agent.name)
        for i, team in enumerate(arena.teams)
        if i in teams
        for agent in team.agents
    }
