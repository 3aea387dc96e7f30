"""The gradients that learners follow, against finite differences in double precision; the trust region's own parts."""

import copy
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from agents.batch import ActorBatch, Sequences
from agents.devices.cuda_graphs import EagerRunner
from agents.learner.actor_learner import surrogate_loss
from agents.learner.critic_learner import value_loss
from agents.learner.happo import HappoLearner
from agents.learner.metric_means import read_means
from agents.learner.minibatches import mean_weights
from agents.learner.trust_region import conjugate_gradient
from agents.policy.networks import Actor, Critic
from agents.settings import Architecture, HappoConfig, TrustRegion

CONFIG = HappoConfig(Architecture((5,)), entropy_coef=0.1, clip=0.2, huber_delta=0.7)
EVERY, EQUALLY = torch.ones(40, dtype=torch.bool), torch.full((40,), 1 / 40).double()  # rows that count, and how much
ARCHITECTURES = {
    "plain": Architecture((5,)),
    "elu, layer norm": Architecture((5, 4), "elu", layer_norm=True),
    "squashed": Architecture((5,), squash=1.5),
    "state_std": Architecture((5,), state_std=True),
    "both": Architecture((5,), squash=0.8, state_std=True),
}
RECURRENT = {
    "plain": Architecture((5,), recurrent=4),
    "layer norm": Architecture((5, 4), "elu", layer_norm=True, recurrent=3),
    "both": Architecture((5,), squash=0.8, state_std=True, recurrent=4),
}


def assert_gradient(network: torch.nn.Module, loss: Callable[[], Tensor]) -> None:
    """Every component of the gradient agrees with a central difference."""
    gradients = torch.autograd.grad(loss(), list(network.parameters()))
    largest = 0.0
    with torch.no_grad():
        for parameter, gradient in zip(network.parameters(), gradients, strict=True):
            for k in range(parameter.numel()):
                flat, kept = parameter.view(-1), parameter.view(-1)[k].item()
                sides = []
                for step in (1e-6, -1e-6):
                    flat[k] = kept + step
                    sides.append(float(loss()))
                flat[k] = kept
                slope = (sides[0] - sides[1]) / 2e-6
                assert float(gradient.view(-1)[k]) == pytest.approx(slope, abs=1e-7, rel=1e-5)
                largest = max(largest, abs(slope))
    assert largest > 1e-3


@pytest.mark.parametrize("architecture", ARCHITECTURES.values(), ids=ARCHITECTURES)
def test_an_actor_follows_the_slope_of_its_loss(architecture, scramble):
    actor: Actor = scramble(0, architecture, observations=6).double()
    rng = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=rng, dtype=torch.float64)

    obs = normal(40, 6)
    with torch.no_grad():
        gaussian = actor.gaussian(obs)
        actions = gaussian.mean + gaussian.stddev * normal(40, 2)
        if architecture.squash:
            actions = architecture.squash * torch.tanh(actions / architecture.squash)
        old = actor(obs).log_prob(actions).sum(-1) + 0.3 * normal(40)
    actor_batch = ActorBatch(obs, actions, old, normal(40), EVERY)
    with torch.no_grad():
        ratio = (actor(obs).log_prob(actions).sum(-1) - old).exp()
    assert 0.2 < float(((ratio - 1).abs() > 0.2).double().mean()) < 0.8  # clipped and not
    assert_gradient(actor, lambda: surrogate_loss(actor, actor_batch, EQUALLY, CONFIG)[0])


def test_a_critic_follows_the_slope_of_its_loss():
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        critic = Critic([4, 2], Architecture((5,), "elu")).double()
        seen, target = torch.randn(40, 6).double(), 1.5 * torch.randn(40).double()
    old = critic(seen).detach() + 0.3 * torch.linspace(-1, 1, 40).double()
    assert_gradient(critic, lambda: value_loss(critic, seen, old, target, EQUALLY, CONFIG))


@pytest.mark.parametrize("architecture", RECURRENT.values(), ids=RECURRENT)
def test_recurrent_networks_follow_the_slope_of_their_losses_through_chunks(architecture, scramble):
    """Ten chunks of four decisions, in which episodes end and some decisions do not count."""
    actor: Actor = scramble(0, architecture, observations=6).double()
    rng = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=rng, dtype=torch.float64)

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        critic = Critic([6], architecture).double()
    obs, actions = normal(10, 4, 6), 0.6 * torch.tanh(normal(10, 4, 2))
    seen = Sequences(obs, torch.rand((10, 4), generator=rng) < 0.2, normal(10, architecture.recurrent))
    valid = torch.rand((10, 4), generator=rng) < 0.8
    with torch.no_grad():
        old = actor(seen).log_prob(actions).sum(-1) + 0.2 * normal(10, 4)
        value = critic(seen) + 0.3 * normal(10, 4)
    actor_batch = ActorBatch(seen, actions, old, normal(10, 4).masked_fill(~valid, 0.0), valid)
    weights, target = mean_weights(valid)[0].double(), 1.5 * normal(10, 4)
    assert_gradient(actor, lambda: surrogate_loss(actor, actor_batch, weights, CONFIG)[0])
    assert_gradient(critic, lambda: value_loss(critic, seen, value, target, weights, CONFIG))


@pytest.mark.parametrize("architecture", ARCHITECTURES.values(), ids=ARCHITECTURES)
def test_rows_that_do_not_count_have_no_part_in_a_gradient(architecture, scramble):
    """They are not there, as far as losses, figures and gradients go; even where a density overflows."""
    actor: Actor = scramble(0, architecture, observations=6)
    rng = torch.Generator().manual_seed(1)
    actor_batch = ActorBatch(
        *(torch.randn(shape, generator=rng) for shape in ((40, 6), (40, 2), 40, 40)), torch.arange(40) % 3 > 0
    )
    kept = ActorBatch(*(x[actor_batch.valid] for x in actor_batch[:5]))
    actor_batch.log_probs[~actor_batch.valid] = -300.0
    found = {}
    for rows in (actor_batch, kept):
        loss, figures = surrogate_loss(actor, rows, mean_weights(rows.valid)[0], CONFIG)
        found[len(rows.valid)] = [loss, *figures.values(), *torch.autograd.grad(loss, list(actor.parameters()))]
    assert sum(float(g.abs().sum()) for g in found[26][4:]) > 0.1
    torch.testing.assert_close(found[40], found[26], rtol=1e-5, atol=1e-6)


def test_a_value_that_does_not_count_has_no_part_in_a_gradient():
    critic, rng = Critic([6], Architecture((5,))), torch.Generator().manual_seed(1)
    rows = [torch.randn(shape, generator=rng) for shape in ((40, 6), 40, 40)]
    valid = torch.arange(40) % 3 > 0
    losses = [
        value_loss(critic, *rows, mean_weights(valid)[0], CONFIG),
        value_loss(critic, *(x[valid] for x in rows), torch.full((26,), 1 / 26), CONFIG),
    ]
    weighted, kept = (torch.autograd.grad(loss, list(critic.parameters())) for loss in losses)
    assert sum(float(g.abs().sum()) for g in kept) > 0.1
    torch.testing.assert_close(weighted, kept, rtol=1e-5, atol=1e-6)


# The trust region -----------------------------------------------------------------------------------------------------


def test_conjugate_gradients_solve_linear_systems():
    rng = torch.Generator().manual_seed(0)
    root, b = torch.randn(12, 12, generator=rng).double(), torch.randn(12, generator=rng).double()
    A = root @ root.T + torch.eye(12).double()
    torch.testing.assert_close(
        conjugate_gradient(lambda v: A @ v, b, 40), torch.linalg.solve(A, b), rtol=1e-5, atol=1e-5
    )
    assert torch.equal(conjugate_gradient(lambda v: A @ v, torch.zeros_like(b), 5), torch.zeros_like(b))


def hatrpo(**changes) -> HappoLearner:
    config = replace(CONFIG, method="hatrpo", gamma=0.0, fixed_order=True, value_norm=False, **changes)
    return HappoLearner([4, 3], [2, 1], config, seed=0)


def test_a_step_goes_along_the_natural_gradient_as_far_as_the_divergence_allows(experience):
    """A linear policy of fixed deviation: KL's Hessian is Σ x xᵀ / σ², known without any second derivative."""
    learner = hatrpo(trust_region=TrustRegion(damping=0.0, kl_threshold=1e-4, conjugate_steps=200))
    batch = experience(learner, seed=2, T=16, N=16)
    actor = learner.actors[0]
    for parameter in (*actor.trunk.parameters(), actor.std_logit):
        parameter.requires_grad_(False)
    actor.double()
    obs, actions, old = (x[0].flatten(0, 1).double() for x in (batch.observations, batch.actions, batch.log_probs))
    MA = torch.linspace(-1, 1, len(obs)).double()
    with torch.no_grad():
        features = torch.cat([actor.trunk(obs), torch.ones(len(obs), 1).double()], -1)
        policy = actor(obs)
        r = (policy.log_prob(actions).sum(-1) - old).exp() * MA
        score = (actions - policy.mean) / policy.stddev**2  # ∇ log π with respect to the mean
    before = [p.detach().clone() for p in (actor.mean.weight, actor.mean.bias)]
    learner.actor_learners[0].network.parameters = lambda: iter([actor.mean.weight, actor.mean.bias])
    every = torch.ones(len(obs), dtype=torch.bool)
    learner.actor_learners[0].update(ActorBatch(obs, actions, old, MA, every), 1.0, [], EagerRunner())
    figures = read_means([learner.actor_learners[0].metric_sums])
    step = torch.cat([(actor.mean.weight - before[0]).detach(), (actor.mean.bias - before[1]).detach()[:, None]], 1)
    expected = []
    for d in range(2):
        H = features.T @ features / len(obs) / float(policy.stddev[0, d]) ** 2
        g = (features * (r * score[:, d])[:, None]).mean(0)
        expected.append((torch.linalg.solve(H, g), g))
    length = round(figures["step_length"], 6)
    assert length in (1.0, 0.8)  # the longest step has a divergence of exactly what is allowed, but for rounding
    scale = float(np.sqrt(2 * 1e-4 / sum(float(s @ g) for s, g in expected)))
    for d, (s, _) in enumerate(expected):
        torch.testing.assert_close(step[d], length * scale * s, rtol=1e-6, atol=1e-12)
    assert figures["kl"] == pytest.approx(1e-4 * length**2, rel=1e-6)


def test_no_step_leaves_the_region_and_every_step_gains(experience):
    learner = hatrpo()
    for seed in range(4):
        batch = experience(learner, seed=seed, T=16, N=16)
        old_actors = copy.deepcopy(learner.actors)
        figures = learner.learn(batch)
        with torch.no_grad():
            before, after = (
                [a.gaussian(o) for a, o in zip(actors, batch.observations, strict=True)]
                for actors in (old_actors, learner.actors)
            )
        assert 0 < figures["kl"] <= 0.01
        assert 0 < figures["step_length"] <= 1
        for old, new in zip(before, after, strict=True):
            assert 0 < float(torch.distributions.kl_divergence(old, new).sum(-1).mean()) <= 0.01 + 1e-6


def test_a_policy_stays_where_no_try_is_good_enough(experience):
    region = TrustRegion(line_search_steps=1, accept_ratio=0.99, kl_threshold=0.05)
    stayed = []
    for seed in range(8):
        learner = HappoLearner([4], [2], replace(CONFIG, method="hatrpo", trust_region=region), seed)
        before = [p.detach().clone() for p in learner.actors[0].parameters()]
        figures = learner.learn(experience(learner, seed=seed))
        same = all(torch.equal(a, b) for a, b in zip(before, learner.actors[0].parameters(), strict=True))
        assert figures["step_length"] == (0.0 if same else 1.0)
        assert (figures["kl"] == 0.0) == same
        stayed.append(same)
    assert {*stayed} == {True, False}


def test_a_step_out_of_the_region_is_shortened_however_much_it_gains(experience):
    """With the longest step the divergence would be 0.72 and 0.76."""
    region = TrustRegion(accept_ratio=0.1, kl_threshold=0.5)
    for seed in (1, 4):
        learner = HappoLearner([4], [2], replace(CONFIG, method="hatrpo", trust_region=region), seed)
        figures = learner.learn(experience(learner, seed=seed))
        assert figures["step_length"] == pytest.approx(0.8)
        assert 0.3 < figures["kl"] <= 0.5


def test_the_second_agent_climbs_on_what_the_first_has_made_of_the_advantage(experience):
    batch = experience(hatrpo(), seed=2, T=16, N=16)
    both, alone = hatrpo(), hatrpo()
    both.learn(batch)
    alone.learn(batch._replace(alive=[torch.zeros_like(batch.alive[0]), batch.alive[1]]))
    gap = max(
        float((a - b).detach().abs().max())
        for a, b in zip(both.actors[1].parameters(), alone.actors[1].parameters(), strict=True)
    )
    assert gap > 1e-4
