from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace

import jax
import numpy as np
import pytest
import torch

import arenas
from agents.batch import Batch, Sequences
from agents.devices import cuda_graphs
from agents.learner.happo import HappoLearner
from agents.policy.networks import Actor, SquashedGaussian
from agents.rollout.rollout import make_rollout
from agents.settings import Architecture
from arenas.arena import Arena
from arenas.games.sumo import SumoRules
from tests.agents.kernels import record

on_a_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


def scrambled_actor(seed: int, architecture: Architecture, observations: int = 20, actions: int = 2) -> Actor:
    """An actor whose every number counts: no zero bias, no unit scale, observation statistics of their own."""
    actor = Actor(observations, actions, architecture, initial_std=0.8)
    rng = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for tensor in actor.parameters():
            tensor += 0.3 * torch.randn(tensor.shape, generator=rng)
        actor.trunk.observation_mean += torch.randn(observations, generator=rng)
        actor.trunk.observation_var += torch.rand(observations, generator=rng)
        actor.trunk.observation_var[0] = 0.0  # as after a feature that never moved
        actor.trunk.observation_clip.fill_(2.0)
    return actor


def make_batch(learner: HappoLearner, seed: int, T: int = 8, N: int = 6, void: float = 0.0) -> Batch:
    """Random experience whose actions come from the learner's actors; stale by up to 30 % in density.

    Recurrent actors remember it as they should; what was before the first decision they remember too.
    """
    if learner.config.sequence is not None:
        return remembered_batch(learner, seed, T, N, void)
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=rng)

    observations = [normal(T, N, actor.trunk.observation_mean.numel()) for actor in learner.actors]
    following = [normal(*o.shape) for o in observations]
    with torch.no_grad():
        policies = [actor(o) for actor, o in zip(learner.actors, observations, strict=True)]
        gaussians = [actor.gaussian(o) for actor, o in zip(learner.actors, observations, strict=True)]
        actions = [p.mean + p.stddev * normal(*p.mean.shape) for p in gaussians]
        actions = [
            p.limit * torch.tanh(a / p.limit) if isinstance(p, SquashedGaussian) else a
            for p, a in zip(policies, actions, strict=True)
        ]
        log_probs = [
            p.log_prob(a).sum(-1) + 0.3 * (2 * torch.rand((T, N), generator=rng) - 1)
            for p, a in zip(policies, actions, strict=True)
        ]
    ends = torch.rand((T, N), generator=rng)
    kinds = (ends < 0.1, (ends > 0.1) & (ends < 0.2), ends > 1 - void)  # terminated, truncated, void
    alive = [torch.ones((T, N), dtype=torch.bool) for _ in learner.actors]
    return Batch(observations, following, actions, log_probs, alive, alive, normal(T, N) + 2.0, *kinds)


def remembered_batch(learner: HappoLearner, seed: int, T: int, N: int, void: float) -> Batch:
    """The same of recurrent actors, one decision after the other."""
    rng, chunk, units = (
        torch.Generator().manual_seed(seed),
        learner.config.chunk_length,
        learner.config.architecture.recurrent,
    )

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=rng)

    ends = torch.rand((T, N), generator=rng)
    kinds = (ends < 0.1, (ends > 0.1) & (ends < 0.2), ends > 1 - void)
    over = (kinds[0] | kinds[1] | kinds[2])[:-1]
    first = torch.cat([torch.arange(N)[None] % 2 == 0, over])
    observations = [normal(T, N, actor.trunk.observation_mean.numel()) for actor in learner.actors]
    following = [normal(*o.shape) for o in observations]
    actions, log_probs, memories = ([[] for _ in observations] for _ in range(3))
    with torch.no_grad():
        for i, actor in enumerate(learner.actors):
            memory = 0.5 * normal(N, units)
            for t in range(T):
                if t % chunk == 0:
                    memories[i].append(memory)
                now = Sequences(observations[i][t][:, None], first[t][:, None], memory)
                policy, gaussian = actor(now), actor.gaussian(now)
                action = gaussian.mean + gaussian.stddev * normal(*gaussian.mean.shape)
                if isinstance(policy, SquashedGaussian):
                    action = policy.limit * torch.tanh(action / policy.limit)
                actions[i].append(action[:, 0])
                stale = 0.3 * (2 * torch.rand(N, generator=rng) - 1)
                log_probs[i].append(policy.log_prob(action).sum(-1)[:, 0] + stale)
                memory = actor.states(now)[:, 0]
    actions, log_probs, memories = ([torch.stack(x) for x in each] for each in (actions, log_probs, memories))
    alive = [torch.ones((T, N), dtype=torch.bool) for _ in learner.actors]
    batch = Batch(observations, following, actions, log_probs, alive, alive, normal(T, N) + 2.0, *kinds)
    critic_memories = [0.5 * normal(N, units) for _ in learner.critic_learners]
    return batch._replace(first=[first], memories=memories, critic_memories=critic_memories)


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> Iterator[None]:
    """Torch on one thread: on a shared machine, threads that spin while they wait keep others from their work."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def scramble() -> Callable[..., Actor]:
    return scrambled_actor


@pytest.fixture(scope="session")
def experience() -> Callable[..., Batch]:
    return make_batch


@pytest.fixture(scope="session")
def short_sumo() -> Arena:
    """1v1 on the C engine with episodes of 20 decisions at most, whose ring shrinks at once."""
    rules = SumoRules(ring=(1.2, 1.8), episode=2.0, shrink_after=0.2)
    return replace(arenas.settings("sumo-1v1"), rules=rules).build(engine="c", threads=2)


@pytest.fixture(scope="session")
def short_rollout(short_sumo) -> jax.stages.Wrapped:
    """45 decisions of it: tests that seat the same shapes share one compilation."""
    return make_rollout(short_sumo, 45)


@pytest.fixture
def same() -> Callable[[object, object], bool]:
    """Whether two trees of arrays agree bit for bit."""

    def check_ranks_agree(a: object, b: object) -> bool:
        equal = jax.tree.map(lambda x, y: bool(np.array_equal(x, y)), a, b)
        return all(jax.tree.leaves(equal))

    return check_ranks_agree


@pytest.fixture(params=["recorder", pytest.param("cuda", marks=[pytest.mark.gpu, on_a_gpu])])
def device(request, monkeypatch) -> str:
    """The device where learners replay: on a GPU by graphs, else by the recorder of kernels.py."""
    if request.param == "recorder":
        monkeypatch.setattr(cuda_graphs, "new_stream", lambda: "no stream")
        monkeypatch.setattr(cuda_graphs, "new_pool", lambda: "no pool")
        monkeypatch.setattr(cuda_graphs, "on", nullcontext)
        monkeypatch.setattr(cuda_graphs, "wait_for", lambda stream: None)
        monkeypatch.setattr(cuda_graphs, "record", record)
    return "cuda" if request.param == "cuda" else "cpu"
