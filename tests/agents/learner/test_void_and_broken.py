"""Void decisions and who is out of the game teach nothing, and numbers that are broken are refused by name."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from agents.errors import Diverged
from agents.learner.happo import HappoLearner
from tests.agents.paper import FULL, PLAIN, critic_of, log_density, new_learner, ppo, worst_gap


def test_what_a_void_decision_holds_changes_nothing(experience, same):
    states = []
    for garbage in (None, 1e3, math.nan):
        learner = new_learner(2, FULL)
        batch = experience(learner, seed=4, void=0.2)
        assert 3 < int(batch.void.sum()) < 20
        if garbage is not None:
            for tensor in (*batch.next_observations, *batch.actions, *batch.log_probs, batch.rewards):
                tensor[batch.void] = garbage
            for tensor in batch.observations:
                tensor[batch.void] *= garbage
        learner.learn(batch)
        states.append(learner.save())
    assert same(states[0], states[1])
    assert same(states[0], states[2])
    assert all(np.isfinite(array).all() for array in states[0].values())


def living(batch, seed: int):
    """The batch with agents that are out in a third of the decisions, all of them in some."""
    rng = torch.Generator().manual_seed(seed)
    here = [torch.rand(batch.rewards.shape, generator=rng) < 0.67 for _ in range(2 * len(batch.alive))]
    return batch._replace(alive=here[: len(batch.alive)], next_alive=here[len(batch.alive) :])


def test_the_numbers_of_who_is_out_of_the_game_change_nothing(experience, same):
    states = []
    for garbage in (None, 1e3, math.nan):
        learner = new_learner(3, FULL)
        batch = living(experience(learner, seed=4, void=0.1), seed=5)
        if garbage is not None:
            for i, alive in enumerate(batch.alive):
                for tensor in (batch.observations[i], batch.actions[i], batch.log_probs[i]):
                    tensor[~alive] = garbage
                batch.next_observations[i][~batch.next_alive[i]] = garbage
        learner.learn(batch)
        states.append(learner.save())
    assert same(states[0], states[1])
    assert same(states[0], states[2])
    assert all(np.isfinite(array).all() for array in states[0].values())


def test_agents_learn_from_what_they_lived_through(experience):
    learner = new_learner(3)
    batch = living(experience(learner, seed=2), seed=7)
    alive = [a.flatten() for a in batch.alive]
    somebody = torch.stack(alive).any(0)
    assert 0 < int((~somebody).sum()) < 10
    team = torch.cat([o * a[..., None] for o, a in zip(batch.observations, batch.alive, strict=True)], -1)
    with torch.no_grad():
        A = (batch.rewards - critic_of(learner)(team)).flatten()
    A = (A - A[somebody].mean()) / (A[somebody].std(correction=0) + 1e-5)
    expected, M = [copy.deepcopy(a) for a in learner.actors], torch.ones_like(A)
    for i, actor in enumerate(expected):
        obs, actions, old = (x[i].flatten(0, 1)[alive[i]] for x in (batch.observations, batch.actions, batch.log_probs))
        before = log_density(actor, obs, actions)[0].detach()
        ppo(actor, obs, actions, old, (M * A)[alive[i]], PLAIN)
        M[alive[i]] *= (log_density(actor, obs, actions)[0].detach() - before).exp()
    learner.learn(batch)
    for one, other in zip(expected, learner.actors, strict=True):
        assert worst_gap(one, other) < 1e-6


def test_who_was_out_all_the_time_stays_as_it_was(experience):
    learner = new_learner(2, FULL)
    batch = experience(learner, seed=4)
    before = [copy.deepcopy(actor) for actor in learner.actors]
    learner.learn(batch._replace(alive=[batch.alive[0], torch.zeros_like(batch.alive[1])]))
    assert worst_gap(before[0], learner.actors[0]) > 1e-3
    assert worst_gap(before[1], learner.actors[1]) == 0.0
    assert [set(n.tolist()) for n in learner.observed] == [{48}, {0}, {48}]


def test_nothing_but_void_decisions_is_no_update(experience, same):
    learner = new_learner(2, FULL)
    before = learner.save()
    batch = experience(learner, seed=4)
    assert learner.learn(batch._replace(void=torch.ones_like(batch.void))) == {}
    assert same(before, learner.save())


def test_a_minibatch_in_which_nothing_counts_changes_nothing(experience):
    """With one known decision, two of three minibatches are empty: the third does what the whole batch would."""
    learner, whole = (new_learner(2, replace(FULL, minibatches=m, fixed_order=True)) for m in (3, 1))
    batch = experience(learner, seed=4)
    only = torch.ones_like(batch.void)
    only[3, 2] = False
    figures = [each.learn(batch._replace(void=only)) for each in (learner, whole)]
    assert figures[0] == pytest.approx(figures[1], rel=1e-5)
    states = [each.save() for each in (learner, whole)]
    for name in states[0].keys() - {"rng"}:
        np.testing.assert_allclose(states[0][name], states[1][name], rtol=1e-6, atol=1e-7, err_msg=name)
    steps = {array.item() for name, array in states[0].items() if name.endswith(".step")}
    assert steps == {FULL.epochs}
    assert states[0]["value_norm.weight"] == pytest.approx(2e-5, rel=1e-4)
    assert max(worst_gap(a, b) for a, b in zip(learner.actors, new_learner(2, FULL).actors, strict=True)) > 1e-3


def with_garbage(batch, field: str, garbage: float, agent: int = 1):
    """The batch with one number of a valid decision spoilt."""
    tensors = getattr(batch, field)
    at = tuple(torch.nonzero(~batch.void)[7])
    (tensors if field == "rewards" else tensors[agent])[at] = garbage
    return batch


@pytest.mark.parametrize("update", [HappoLearner.learn, HappoLearner.update_critic_only])
@pytest.mark.parametrize(
    ("field", "garbage", "named"),
    [
        ("rewards", math.nan, "not finite: rewards"),
        ("actions", math.nan, "agent 1's actions"),
        ("actions", math.inf, "agent 1's actions"),
        ("log_probs", -math.inf, "agent 1's log densities"),
    ],
)
def test_what_no_update_can_learn_from_is_refused_before_anything_changes(
    field, garbage, named, update, experience, same
):
    learner = new_learner(2, FULL)
    before = learner.save()
    with pytest.raises(Diverged, match=named):
        update(learner, with_garbage(experience(learner, seed=4, void=0.2), field, garbage))
    assert same(before, learner.save())


def test_a_broken_policy_is_noticed_though_it_makes_every_world_void(experience):
    learner = new_learner(2, FULL)
    batch = experience(learner, seed=4)
    with torch.no_grad():
        learner.actors[1].mean.weight[0, 0] = math.nan
    for update in (learner.learn, learner.update_critic_only):
        with pytest.raises(Diverged, match=r"actor\.1\.mean\.weight"):
            update(batch._replace(void=torch.ones_like(batch.void)))


def test_losses_and_gradients_that_overflow_are_named(experience):
    learner = new_learner(2)
    batch = experience(learner, seed=4)
    batch.log_probs[0].sub_(200.0)  # ratios of e²⁰⁰
    with pytest.raises(Diverged, match=r"not finite: policy_loss, entropy, ratio and 2 more"):
        learner.learn(batch)
    batch.rewards.mul_(1e25)
    with pytest.raises(Diverged, match="not finite: value_loss, critic_grad_norm"):
        new_learner(2, replace(PLAIN, huber_delta=1e30)).update_critic_only(batch)


def test_weights_that_overflow_are_noticed_in_the_update_that_made_them_so(experience):
    learner = new_learner(2, replace(PLAIN, critic_lr=1e30, epochs=1))
    (critic,) = learner.critic_learners
    critic.optimizer.tensors()["value.bias.exp_avg"].fill_(1e15)
    with pytest.raises(Diverged, match=r"not finite: critic\.value\.bias$"):
        learner.learn(experience(learner, seed=4))
