"""What each method and setting of the learner computes, against formulas written here a second time."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from agents.batch import Batch
from agents.errors import Diverged
from agents.learner.happo import HappoLearner
from agents.settings import HappoConfig
from league.config.build import build
from league.config.experiment import Config
from league.config.schema import ConfigError
from tests.agents.paper import worst_gap
from tests.agents.trios import FULL, PLAIN, new_learner


def standardised_advantages(A: Tensor) -> Tensor:
    return (A - A.mean()) / (A.std(correction=0) + 1e-5)


def ppo(actor: torch.nn.Module, actor_batch: tuple[Tensor, ...], A: Tensor, c: HappoConfig) -> None:
    """PPO on the whole batch with an Adam of its own."""
    obs, actions, old = actor_batch
    optimizer = torch.optim.Adam(actor.parameters(), c.lr, eps=1e-5)
    for _ in range(c.epochs):
        policy = actor(obs)
        r = (policy.log_prob(actions).sum(-1) - old).exp()
        gain = torch.minimum(r * A, torch.clamp(r, 1 - c.clip, 1 + c.clip) * A).mean()
        optimizer.zero_grad()
        (-gain - c.entropy_coef * policy.entropy().sum(-1).mean()).backward()
        torch.nn.utils.clip_grad_norm_(actor.parameters(), c.max_grad_norm)
        optimizer.step()


def lived(batch: Batch, i: int) -> tuple[Tensor, Tensor, Tensor]:
    return batch.observations[i].flatten(0, 1), batch.actions[i].flatten(0, 1), batch.log_probs[i].flatten(0, 1)


def density(actor: torch.nn.Module, actor_batch: tuple[Tensor, ...]) -> Tensor:
    with torch.no_grad():
        return actor(actor_batch[0]).log_prob(actor_batch[1]).sum(-1)


# Methods --------------------------------------------------------------------------------------------------------------


def test_in_mappo_every_agent_learns_from_the_same_advantage(experience):
    learner = new_learner(replace(PLAIN, method="mappo"))
    batch = experience(learner, seed=2)
    expected = [copy.deepcopy(a) for a in learner.actors]
    with torch.no_grad():
        A = (batch.rewards - learner.critic_learners[0].network(torch.cat(list(batch.observations), -1))).flatten()
    for i, actor in enumerate(expected):
        ppo(actor, lived(batch, i), standardised_advantages(A), PLAIN)
    learner.learn(batch)
    assert max(map(worst_gap, expected, learner.actors)) < 1e-6

    happo = new_learner(PLAIN)
    happo.learn(batch)
    assert worst_gap(happo.actors[0], learner.actors[0]) == 0.0  # M is 1 for the first
    assert worst_gap(happo.actors[1], learner.actors[1]) > 1e-4


def test_in_ippo_every_agent_has_its_own_critic_and_its_own_advantage(experience):
    learner = new_learner(replace(PLAIN, method="ippo"))
    batch = experience(learner, seed=2)
    out = torch.zeros_like(batch.alive[1])
    out[:3] = True
    batch = batch._replace(alive=[batch.alive[0], ~out, batch.alive[2]])
    expected = [copy.deepcopy(a) for a in learner.actors]
    critics = [copy.deepcopy(c.network) for c in learner.critic_learners]
    for i, (actor, critic) in enumerate(zip(expected, critics, strict=True)):
        here = batch.alive[i].flatten()
        with torch.no_grad():
            A = (batch.rewards - critic(batch.observations[i])).flatten()[here]
        ppo(actor, tuple(x[here] for x in lived(batch, i)), standardised_advantages(A), PLAIN)
    learner.learn(batch)
    assert max(map(worst_gap, expected, learner.actors)) < 1e-6
    assert [len(c.network.trunk.observation_mean) for c in learner.critic_learners] == [4, 4, 3]
    assert min(worst_gap(old, new.network) for old, new in zip(critics, learner.critic_learners, strict=True)) > 1e-3


@pytest.mark.parametrize("method", ["happo", "mappo", "ippo"])
def test_alone_every_method_is_ppo(method, experience, same):
    one = {"observation_sizes": [4], "action_sizes": [2], "seed": 5}
    ours, plain = (HappoLearner(**one, config=replace(FULL, method=m)) for m in (method, "happo"))
    for seed in range(2):
        batch = experience(plain, seed=seed, void=0.1)
        assert ours.learn(batch) == plain.learn(batch)
    assert same(ours.save(), plain.save())


# What bounds a step ---------------------------------------------------------------------------------------------------


def test_passes_end_when_the_policy_has_moved_far_enough(experience):
    wild = replace(PLAIN, lr=0.05, epochs=6)
    counts = {}
    for stop in (None, 1e-9, 0.05, 1e9):
        learner = new_learner(replace(wild, target_kl=stop))
        batch = experience(learner, seed=3)
        learner.learn(batch)
        counts[stop] = int(learner.save()["adam.actor.0.mean.bias.step"])
        assert learner.save()["adam.critic.value.bias.step"] == 6
    assert counts[None] == counts[1e9] == 6
    assert counts[1e-9] == 1
    assert counts[0.05] == 3


@pytest.mark.parametrize(("target", "factor"), [(1e-6, 1 / 1.5), (1e3, 1.5), (0.04, 1.0)])
def test_the_step_size_follows_the_divergence(target, factor, experience):
    """A batch stale by up to 30 % has a divergence of 0.015: half and twice of the last target lie around it."""
    config = replace(PLAIN, lr=2e-3, epochs=1)
    learner = new_learner(replace(config, desired_kl=target if target != 0.04 else 0.015))
    same_steps = new_learner(replace(config, lr=2e-3 * factor))
    batch = experience(learner, seed=3)
    figures = learner.learn(batch)
    same_steps.learn(batch)
    assert figures["lr"] == pytest.approx(2e-3 * factor, rel=1e-5)
    assert 0.0075 < figures["kl"] < 0.03
    assert max(map(worst_gap, learner.actors, same_steps.actors)) < 1e-7


def test_the_adaptive_step_size_stays_within_bounds(experience):
    for target, bound in ((1e-9, 1e-5), (1e9, 1e-2)):
        learner = new_learner(replace(PLAIN, lr=1e-3, desired_kl=target, epochs=30))
        learner.learn(experience(learner, seed=3))
        assert [a.lr.item() for a in learner.actor_learners] == [bound] * 3


def test_step_sizes_fall_to_nothing_over_the_steps_learnt_from(experience, same):
    learner = new_learner(replace(FULL, lr_decay_steps=4 * 48, normalise_observations=False))  # which moves weights too
    batches = [experience(learner, seed=s) for s in range(6)]
    told = [learner.learn(batch)["lr"] for batch in batches[:4]]
    assert told == pytest.approx([0.02, 0.015, 0.01, 0.005])
    before = learner.save()
    assert learner.learn(batches[4])["lr"] == 0.0
    weights = [k for k in before if k.startswith(("actor.", "critic.")) and "observation_" not in k]
    assert same([before[k] for k in weights], [learner.save()[k] for k in weights])

    part = new_learner(replace(FULL, lr_decay_steps=4 * 48))  # from a part of the worlds, the steps of all count
    assert [part.learn(batch._replace(steps=(torch.tensor(96),)))["lr"] for batch in batches[:2]] == pytest.approx(
        [0.02, 0.01]
    )

    half = new_learner(replace(FULL, lr_decay_steps=2 * 48))
    constant = new_learner(replace(FULL, lr=0.01, critic_lr=0.025))
    half.steps += 48
    half.learn(batches[5])
    constant.learn(batches[5])
    mine, theirs = half.save(), constant.save()
    assert same({k: mine[k] for k in theirs}, theirs)


# Precision ------------------------------------------------------------------------------------------------------------


def test_half_the_digits_learn_nearly_the_same(experience):
    full, half = (new_learner(replace(FULL, precision=p)) for p in ("float32", "bf16"))
    fresh = new_learner(FULL)
    for seed in range(2):
        batch = experience(full, seed=seed, void=0.1)
        told = [each.learn(batch) for each in (full, half)]
    assert told[1] == pytest.approx(told[0], rel=0.15, abs=0.05)
    for ours, exact, start in zip(half.actors, full.actors, fresh.actors, strict=True):
        assert 0 < worst_gap(ours, exact) < 0.3 * worst_gap(start, exact)
    assert {array.dtype for name, array in half.save().items() if ".weight" in name} == {np.dtype(np.float32)}


def test_tf32_is_for_the_update_alone(experience, same, monkeypatch):
    matmul, seen = torch.backends.cuda.matmul, []
    before = matmul.fp32_precision
    exact, coarse = (new_learner(replace(FULL, precision=p)) for p in ("float32", "tf32"))
    batch = experience(exact, seed=1)
    for learner in (exact, coarse):
        learn = learner.critic_learners[0].learn
        monkeypatch.setattr(
            learner.critic_learners[0], "learn", lambda *x, learn=learn: (seen.append(matmul.fp32_precision), learn(*x))
        )
        learner.learn(batch)
        assert matmul.fp32_precision == before
    assert seen == [before] * FULL.epochs + ["tf32"] * FULL.epochs
    assert same(exact.save(), coarse.save())  # a CPU knows no such thing
    batch.rewards.fill_(float("nan"))
    with pytest.raises(Diverged):
        coarse.learn(batch)
    assert matmul.fp32_precision == before


# Who shares what ------------------------------------------------------------------------------------------------------


def test_equal_robots_share_an_actor_and_learn_it_from_all_that_they_did(experience):
    learner = new_learner(replace(PLAIN, share_actors=True))
    batch = experience(learner, seed=2)
    assert learner.actors[0] is learner.actors[1]
    pair, single = copy.deepcopy(learner.actors[0]), copy.deepcopy(learner.actors[2])
    with torch.no_grad():
        A = (batch.rewards - learner.critic_learners[0].network(torch.cat(list(batch.observations), -1))).flatten()
    A = standardised_advantages(A)
    both = tuple(torch.cat(x) for x in zip(lived(batch, 0), lived(batch, 1), strict=True))
    before = density(pair, both)
    ppo(pair, both, torch.cat([A, A]), PLAIN)
    first, second = (density(pair, both) - before).exp().chunk(2)
    ppo(single, lived(batch, 2), first * second * A, PLAIN)  # M is the product of both agents' ratios
    learner.learn(batch)
    assert worst_gap(pair, learner.actors[0]) < 1e-6
    assert worst_gap(single, learner.actors[2]) < 1e-6
    policies = learner.export()
    assert len(policies) == 3
    assert all(torch.equal(policies[0][k], policies[1][k]) for k in policies[0])


def test_who_is_equal_is_told_by_kind_and_sizes():
    config = replace(PLAIN, share_actors=True)
    assert new_learner(config).actor_owners == [0, 0, 2]
    assert new_learner(config, kinds=["ant", "rover", "rover"]).actor_owners == [0, 1, 2]
    assert new_learner(PLAIN).actor_owners == [0, 1, 2]


def test_shared_statistics_are_those_of_all_that_share(experience):
    learner = new_learner(replace(FULL, share_actors=True))
    batch = experience(learner, seed=5)
    learner.learn(batch)
    seen = torch.cat([batch.observations[0], batch.observations[1]]).flatten(0, 1)
    torch.testing.assert_close(learner.actors[1].trunk.observation_mean, seen.mean(0), atol=1e-5, rtol=1e-5)
    assert [set(n.tolist()) for n in learner.observed] == [{96}, {48}, {48}]


# Settings -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("learner", "says"),
    [
        ({"precision": "float16"}, "learner.precision"),
        ({"method": "a2c"}, "learner.method"),
        ({"method": "ippo", "critic_input": "all"}, "ippo's critics see what their own agents see"),
        ({"method": "ippo", "critic_input": "privileged"}, "ippo's critics see what their own agents see"),
        ({"method": "ippo", "critic_input": "same"}, "ippo's critics see what their own agents see"),
        ({"method": "hatrpo", "target_kl": 0.01}, "learner.target_kl"),
        ({"method": "hatrpo", "desired_kl": 0.01}, "learner.desired_kl"),
        ({"desired_kl": 0.01, "lr_decay_steps": 10}, "not both"),
        ({"target_kl": 0.0}, "must be above 0"),
        ({"lr_decay_steps": -1}, "must be at least 0"),
        ({"trust_region": {"backtrack_coeff": 1.0}}, "learner.trust_region.backtrack_coeff"),
        ({"architecture": {"squash": 0.0}}, "learner.architecture.squash"),
        ({"critic_input": "everything"}, "learner.critic_input"),
    ],
)
def test_settings_that_cannot_be_are_refused_in_one_line(learner, says):
    with pytest.raises(ConfigError) as caught:
        build(Config, {"learner": learner})
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
