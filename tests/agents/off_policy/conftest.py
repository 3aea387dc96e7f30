from collections.abc import Callable

import pytest
import torch

from agents.batch import Batch, clean
from agents.off_policy.sac import SacLearner
from agents.settings import Architecture, HappoConfig, ReplaySettings, SacSettings
from arenas.state import AgentSpec

AGENTS = [AgentSpec("blue/0", "car", 3, 2), AgentSpec("blue/1", "dog", 4, 1)]
CPU = torch.device("cpu")


def config(replay: ReplaySettings = ReplaySettings(2000, 64), gamma: float = 0.9, **own) -> HappoConfig:  # noqa: B008
    """Settings of small networks that learn from the second small batch on."""
    sac = SacSettings(**{"replay": replay, "batch": 32, "critic_hidden": (16, 16), "bins": 21, **own})
    return HappoConfig(Architecture((8,), squash=1.5), class_="sac", gamma=gamma, sac=sac)


def learner(settings: HappoConfig | None = None, seed: int = 1, agents=AGENTS, critic_size: int = 0) -> SacLearner:
    return SacLearner(agents, settings or config(), seed, CPU, critic_size)


def experience(seed: int, T: int = 8, N: int = 6, agents=AGENTS, void: float = 0.1, dead: float = 0.1) -> Batch:
    """A clean batch of random decisions, some of them void, terminated or truncated, some agents out of the game."""
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=rng)

    def chance(p: float) -> torch.Tensor:
        return torch.rand(T, N, generator=rng) < p

    seen, then = ([normal(T, N, a.observation_size) for a in agents] for _ in range(2))
    actions = [1.4 * torch.tanh(normal(T, N, a.action_size)) for a in agents]
    alive, next_alive = ([~chance(dead) for _ in agents] for _ in range(2))
    zeros = [torch.zeros(T, N) for _ in agents]
    return clean(
        Batch(seen, then, actions, zeros, alive, next_alive, normal(T, N), chance(0.1), chance(0.1), chance(void))
    )


@pytest.fixture(name="learner")
def learner_fixture() -> Callable[..., SacLearner]:
    return learner
