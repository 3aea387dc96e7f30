"""Magnets: the divergence from them, when they move, and where they come from."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.distributions import Normal, kl_divergence

from agents.batch import ActorBatch
from agents.learner.actor_learner import surrogate_loss
from agents.settings import Architecture, HappoConfig
from tests.agents.learner.test_gradients import EQUALLY, EVERY, assert_gradient
from tests.agents.trios import PLAIN, new_learner

MAGNET = replace(PLAIN, magnet_coef=0.1)


def weights(learner, of: str = "actor") -> dict[str, np.ndarray]:
    """The parameters of all actors, or of their magnets, by the same names."""
    start = "actor." if of == "actor" else "magnet.actor."
    return {
        name.removeprefix(start): value.copy()
        for name, value in learner.save().items()
        if name.startswith(start) and not name.endswith((".observed", ".age"))
    }


@pytest.mark.parametrize("architecture", [Architecture((5,)), Architecture((5,), squash=1.5, state_std=True)])
def test_the_loss_has_the_divergence_from_the_magnet(architecture, scramble):
    actor, magnet = (scramble(seed, architecture, observations=6).double() for seed in (0, 1))
    obs = torch.randn((40, 6), generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    with torch.no_grad():
        mine, yours = actor.gaussian(obs), magnet.gaussian(obs)
        actions = 0.5 * torch.ones(40, 2, dtype=torch.float64)
        old = actor(obs).log_prob(actions).sum(-1)
    plain = ActorBatch(obs, actions, old, torch.zeros(40, dtype=torch.float64), EVERY)
    pulled = plain._replace(magnet=[yours.mean, yours.stddev])
    config = HappoConfig(architecture, magnet_coef=0.3, entropy_coef=0.1)
    expected = kl_divergence(Normal(mine.mean, mine.stddev), Normal(yours.mean, yours.stddev)).sum(-1).mean()
    rise = surrogate_loss(actor, pulled, EQUALLY, config)[0] - surrogate_loss(actor, plain, EQUALLY, config)[0]
    assert float(expected) > 0.1
    assert rise.item() == pytest.approx(0.3 * float(expected))
    assert_gradient(actor, lambda: surrogate_loss(actor, pulled, EQUALLY, config)[0])


def test_a_magnet_stays_or_becomes_the_policy_after_its_updates(experience, same):
    still, moving = new_learner(MAGNET), new_learner(replace(MAGNET, magnet_updates=2))
    first = weights(still)
    for seed in range(1, 4):
        for learner in (still, moving):
            learner.learn(experience(learner, seed=seed))
        assert same(weights(still, "magnet"), first)
        if seed == 2:
            became = weights(moving)
            assert same(weights(moving, "magnet"), became)
    assert same(weights(moving, "magnet"), became)
    assert not same(weights(moving), became)


def test_a_strong_magnet_holds_the_policy_where_it_is(experience):
    def moved(coef: float) -> float:
        learner = new_learner(replace(PLAIN, magnet_coef=coef, epochs=20))
        batch, before = experience(learner, seed=1), new_learner(PLAIN).actors
        for _ in range(5):
            learner.learn(batch)
        with torch.no_grad():
            pairs = [
                (a.gaussian(o), b.gaussian(o))
                for a, b, o in zip(learner.actors, before, batch.observations, strict=True)
            ]
            return sum(float(kl_divergence(now, then).sum(-1).mean()) for now, then in pairs)

    free, held = moved(0.0), moved(10.0)
    assert held < free / 5


def test_a_policy_from_elsewhere_is_its_own_magnet(experience, same):
    other, learner = new_learner(PLAIN, seed=5), new_learner(MAGNET)
    other.learn(experience(other, seed=1))
    learner.learn(experience(learner, seed=2))
    learner.load(other.save())  # of a learner without a magnet
    assert same(weights(learner, "magnet"), weights(other))
    learner.learn(experience(learner, seed=3))
    assert same(weights(learner, "magnet"), weights(other))
    teacher = new_learner(MAGNET, seed=6)
    teacher.learn(experience(teacher, seed=4))
    learner.warm_start([(teacher.save(), i) for i in range(len(learner.actors))], None, from_other_arena=True)
    assert same(weights(learner, "magnet"), weights(learner))


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"magnet_updates": 3}, "magnet_updates: does nothing without a magnet"),
        ({"magnet_coef": 0.1, "method": "hatrpo"}, "magnet_coef: hatrpo has no magnet"),
        ({"magnet_coef": 0.1, "architecture": Architecture((5,), recurrent=4)}, "a recurrent network has no magnet"),
    ],
)
def test_settings_without_a_meaning_are_refused(given, says):
    with pytest.raises(ValueError, match=says):
        HappoConfig(**given)
