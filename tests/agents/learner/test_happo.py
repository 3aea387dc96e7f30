"""HAPPO against the paper's formulas, and what its checkpoints hold."""

import copy
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from agents.batch import clean
from agents.learner import minibatches
from agents.learner.minibatches import minibatch_orders, random_orders
from agents.settings import Architecture, HappoConfig
from storage.blobs import arrays
from tests.agents.paper import (
    FULL,
    PLAIN,
    adam_step,
    critic_of,
    log_density,
    new_learner,
    ppo,
    standardised_advantage,
    worst_gap,
)


def test_with_one_agent_happo_is_ppo(experience):
    learner = new_learner(1)
    batch = experience(learner, seed=1)
    actor = copy.deepcopy(learner.actors[0])
    flat = [x[0].flatten(0, 1) for x in (batch.observations, batch.actions, batch.log_probs)]
    clipped = ppo(actor, *flat, standardised_advantage(learner, batch), PLAIN)
    before = copy.deepcopy(learner.actors[0])
    learner.learn(batch)
    assert 0.1 < clipped < 0.9
    assert worst_gap(actor, learner.actors[0]) < 1e-6
    assert worst_gap(before, learner.actors[0]) > 1e-2


def test_each_agent_learns_from_the_advantage_times_the_ratios_of_those_before_it(experience):
    learner = new_learner(3)
    batch = experience(learner, seed=2)
    expected, without_M = ([copy.deepcopy(a) for a in learner.actors] for _ in range(2))
    A = standardised_advantage(learner, batch)
    M = torch.ones_like(A)
    spread = []
    for i, actor in enumerate(expected):
        obs, actions, old = (x[i].flatten(0, 1) for x in (batch.observations, batch.actions, batch.log_probs))
        before = log_density(actor, obs, actions)[0].detach()
        ppo(actor, obs, actions, old, M * A, PLAIN)
        ppo(without_M[i], obs, actions, old, A, PLAIN)
        M = M * (log_density(actor, obs, actions)[0].detach() - before).exp()
        spread.append(float(M.std()))
    learner.learn(batch)
    assert spread[0] > 0.05  # M is not 1 by the time it matters
    for i in range(3):
        assert worst_gap(expected[i], learner.actors[i]) < 1e-6
    assert worst_gap(without_M[1], learner.actors[1]) > 1e-4
    assert worst_gap(without_M[2], learner.actors[2]) > 1e-4


def test_the_team_moves_in_a_fresh_order_each_time_unless_it_is_fixed(experience):
    def first_movers(config: HappoConfig) -> set[int]:
        """Who moved first, in 12 updates: the agent whose update is what it would be alone, without M."""
        movers = set()
        for seed in range(12):
            learner = new_learner(2, config, seed)
            batch = experience(learner, seed=2)
            alone = [copy.deepcopy(a) for a in learner.actors]
            A = standardised_advantage(learner, batch)
            for i, actor in enumerate(alone):
                flat = [x[i].flatten(0, 1) for x in (batch.observations, batch.actions, batch.log_probs)]
                ppo(actor, *flat, A, config)
            learner.learn(batch)
            movers |= {i for i in range(2) if worst_gap(alone[i], learner.actors[i]) < 1e-6}
        return movers

    assert first_movers(PLAIN) == {0}
    assert first_movers(replace(PLAIN, fixed_order=False)) == {0, 1}


@pytest.mark.parametrize("value_norm", [False, True])
def test_the_value_loss_is_clipped_and_huber(value_norm, experience):
    config = replace(PLAIN, value_norm=value_norm, huber_delta=0.5, clip=0.05)
    learner = new_learner(2, config)
    batch = experience(learner, seed=3)
    critic = copy.deepcopy(critic_of(learner))
    team = torch.cat(list(batch.observations), -1).flatten(0, 1)
    R = batch.rewards.flatten()  # γ = 0
    target = (R - R.mean()) / R.std(correction=0) if value_norm else R
    old = critic(team).detach()
    optimizer = torch.optim.Adam(critic.parameters(), config.critic_lr, eps=1e-5)
    moved = linear = square = 0

    def huber(error: Tensor) -> Tensor:
        size = error.abs()
        return torch.where(size <= 0.5, size**2 / 2, 0.5 * (size - 0.25))

    for _ in range(config.epochs):
        value = critic(team)
        kept = torch.maximum(torch.minimum(value, old + 0.05), old - 0.05)
        adam_step(
            critic, optimizer, torch.maximum(huber(target - value), huber(target - kept)).mean(), config.max_grad_norm
        )
        moved = int((kept != value).sum())
        linear, square = int(((target - value).abs() > 0.5).sum()), int(((target - value).abs() < 0.5).sum())
    learner.learn(batch)
    assert min(moved, linear, square) > 0  # every branch of the formula was taken
    assert worst_gap(critic, critic_of(learner)) < 1e-5
    assert worst_gap(critic_of(new_learner(2)), critic_of(learner)) > 1e-2


def test_observation_statistics_are_those_of_all_that_was_seen(experience):
    learner = new_learner(2, FULL)
    batches = [experience(learner, seed=s, N=n) for s, n in ((5, 3), (6, 8))]
    batches[1].observations[0].mul_(3.0).add_(5.0)
    for batch in batches:
        learner.learn(batch)
    seen = [torch.cat([b.observations[i].flatten(0, 1) for b in batches]) for i in range(2)]
    trunks = [*(actor.trunk for actor in learner.actors), critic_of(learner).trunk]
    for trunk, obs in zip(trunks, [*seen, torch.cat(seen, -1)], strict=True):
        torch.testing.assert_close(trunk.observation_mean, obs.mean(0), atol=1e-4, rtol=1e-5)
        torch.testing.assert_close(trunk.observation_var, obs.var(0, correction=0), atol=1e-4, rtol=1e-4)


def test_what_actors_and_critics_say_stays_as_their_statistics_move(experience):
    """Else a policy that goes on where robots see other things is another one before it has learnt anything."""
    learner = new_learner(2, replace(FULL, lr=0.0, critic_lr=0.0))
    learner.learn(experience(learner, seed=5))
    first, then = experience(learner, seed=6), experience(learner, seed=6, N=40)
    then.observations[0].mul_(3.0).add_(5.0)
    networks = [learner.actors[0], critic_of(learner)]
    seen = [x.flatten(0, 1) / 4 for x in (first.observations[0], torch.cat(list(first.observations), -1))]  # unclipped

    def said() -> list[Tensor]:
        with torch.no_grad():
            actor, critic = networks
            return [actor(seen[0]).mean, critic(seen[1])]

    before, read_means = said(), [network.trunk.observation_mean.clone() for network in networks]
    learner.learn(then)
    assert all((m - n.trunk.observation_mean).abs().max() > 1 for m, n in zip(read_means, networks, strict=True))
    for was, now in zip(before, said(), strict=True):
        torch.testing.assert_close(now, was, atol=1e-5, rtol=1e-5)


def test_what_stood_still_and_moves_has_the_weights_that_it_had(experience):
    """Its deviation becomes a hundred times what it was; were its weights to follow, they would drown all others."""
    learner = new_learner(2, replace(FULL, lr=0.0, critic_lr=0.0))
    still, moving = (experience(learner, seed=s) for s in (5, 6))
    still.observations[0][..., 1] = 2.0
    learner.learn(still)
    weights = learner.actors[0].trunk.hidden[0].weight
    before = weights.detach().clone()
    learner.learn(moving)
    assert learner.actors[0].trunk.observation_var[1] > 0.1
    torch.testing.assert_close(weights[:, 1], before[:, 1], atol=0, rtol=0)
    assert (weights[:, 0] / before[:, 0] - 1).abs().max() > 1e-3  # while those of what moved follow


@pytest.mark.parametrize("method", ["happo", "ippo"])
def test_values_are_those_that_advantages_are_taken_from_in_units_of_reward(experience, same, method):
    learner = new_learner(2, replace(FULL, method=method, gamma=0.0))
    for seed in range(3):  # the normaliser learns that rewards are around 2
        learner.learn(experience(learner, seed=seed))
    batch = experience(learner, seed=4)
    before = learner.save()
    values = learner.values(batch)
    assert same(list(before.values()), list(learner.save().values()))
    seen = batch.observations if method == "ippo" else [torch.cat(list(batch.observations), -1)]
    for critic, found, obs in zip(learner.critic_learners, values, seen, strict=True):
        norm = critic.value_norm.state_dict()
        mean, square = (norm[name] / norm["weight"] for name in ("mean_sum", "square_sum"))
        expected = mean + torch.sqrt(square - mean**2) * critic.network(obs).detach()
        torch.testing.assert_close(found, expected)
        assert float((found - critic.network(obs).detach()).abs().min()) > 0.1
    A = batch.rewards - values[0]
    torch.testing.assert_close(A.flatten(), learner.critic_learners[0].evaluate(clean(batch)).advantages)


def test_a_resting_team_keeps_its_policy_while_its_critic_follows(experience, same):
    config = replace(FULL, minibatches=1, fixed_order=True)
    resting, playing = (new_learner(2, config) for _ in range(2))
    batch = experience(resting, seed=4, void=0.2)
    before = resting.save()
    figures = resting.update_critic_only(batch)
    assert figures.keys() == {"value_loss", "critic_grad_norm", "explained_variance"}
    assert figures["value_loss"] == pytest.approx(playing.learn(batch)["value_loss"], rel=1e-4)

    after = resting.save()
    policy = [name for name in after if "actor." in name or "observation_" in name]
    assert same([before[name] for name in policy], [after[name] for name in policy])
    assert worst_gap(critic_of(resting), critic_of(playing)) < 1e-5
    assert worst_gap(critic_of(new_learner(2, config)), critic_of(resting)) > 1e-2
    for name, seen in resting.critic_learners[0].value_norm.state_dict().items():
        assert seen != 0
        torch.testing.assert_close(seen, playing.critic_learners[0].value_norm.state_dict()[name])


def test_figures_are_those_of_the_textbooks(experience):
    still = replace(PLAIN, lr=1e-12, critic_lr=1e-12, epochs=1)
    learner = new_learner(1, still)
    batch = experience(learner, seed=4)
    figures = learner.learn(batch)
    obs, actions, old = (x[0].flatten(0, 1) for x in (batch.observations, batch.actions, batch.log_probs))
    log_probs, entropy = log_density(learner.actors[0], obs, actions)
    r = (log_probs - old).exp()
    values = critic_of(learner)(obs).detach()
    expected = {
        "ratio": r.mean(),
        "kl": (r - 1 - r.log()).mean(),
        "entropy": entropy,
        "explained_variance": 1 - (batch.rewards.flatten() - values).var() / batch.rewards.var(),
    }
    for name, value in expected.items():
        assert figures[name] == pytest.approx(value.item(), rel=1e-4), name
    first = [v for k, v in learner.save().items() if k.startswith("adam.actor.0.") and k.endswith(".exp_avg")]
    norm = math.sqrt(sum(float((m**2).sum()) for m in first)) / (
        1 - 0.9
    )  # of the gradient, which was scaled down by then
    assert norm == pytest.approx(PLAIN.max_grad_norm, rel=1e-3)
    assert figures["actor_grad_norm"] > 1.1 * PLAIN.max_grad_norm
    assert figures["critic_grad_norm"] > 1.1 * PLAIN.max_grad_norm


@pytest.mark.parametrize("updates", [0, 2])
def test_going_on_from_a_checkpoint_is_going_on(updates, experience, same):
    learner = new_learner(2, FULL)
    first = [experience(learner, seed=s) for s in range(updates)]
    for batch in first:
        learner.learn(batch)
    checkpoint = arrays.to_bytes(learner.save())
    then = experience(learner, seed=9)
    diagnostics = learner.learn(then)

    resumed = new_learner(2, FULL, seed=123)
    assert not same(resumed.save(), arrays.from_bytes(checkpoint))
    resumed.load(arrays.from_bytes(checkpoint))
    assert same(resumed.save(), arrays.from_bytes(checkpoint))
    assert resumed.learn(then) == diagnostics
    assert same(resumed.save(), learner.save())


def test_a_state_is_a_copy(experience):
    learner = new_learner(1, FULL)
    state = learner.save()
    before = {name: array.copy() for name, array in state.items()}
    learner.learn(experience(learner, seed=1))
    for name, array in state.items():
        np.testing.assert_array_equal(array, before[name], err_msg=name)


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (lambda s: s.pop("critic.value.weight"), r"critic\.value\.weight \(1 in all\)"),
        (lambda s: s.pop("rng"), r"rng \(1 in all\)"),
        (lambda s: s.update({"actor.1.activation": np.int32(2)}), r"actor\.1\.activation \(1 in all\)"),
        (lambda s: s["critic.value.weight"].fill(np.nan), r"not finite in critic\.value\.weight \(1 in all\)"),
        (
            lambda s: s.update(new_learner(2, replace(PLAIN, architecture=Architecture((6,)))).save()),
            "hidden.0.weight",
        ),
    ],
)
def test_a_checkpoint_that_does_not_fit_is_refused_whole(spoil, named, same):
    learner, state = new_learner(2, seed=1), new_learner(2, seed=2).save()
    before = learner.save()
    spoil(state)
    with pytest.raises(ValueError, match=named):
        learner.load(state)
    assert same(before, learner.save())


def test_learners_are_made_from_their_own_seed_alone(same):
    torch.manual_seed(1)
    following = torch.rand(3)
    torch.manual_seed(1)
    learner = new_learner(2, seed=7)
    assert torch.equal(torch.rand(3), following)
    assert same(learner.save(), new_learner(2, seed=7).save())
    assert not same(learner.save(), new_learner(2, seed=8).save())


def test_orders_that_a_gpu_sorts_are_orders_and_differ():
    rng = torch.Generator().manual_seed(1)
    drawn = random_orders(1000, 40, rng)
    assert drawn.dtype == torch.int64
    assert torch.equal(drawn.sort(1).values, torch.arange(1000).expand(40, -1))
    assert len({tuple(order.tolist()) for order in drawn}) == 40
    # Each row's mean place over 40 orders: 499.5, with a deviation of 1000 / sqrt(12 * 40) = 45.6.
    places = drawn.argsort(1).float().mean(0)
    assert places.mean() == pytest.approx(499.5)
    assert places.std() == pytest.approx(45.6, rel=0.1)
    assert torch.equal(drawn, random_orders(1000, 40, torch.Generator().manual_seed(1)))


@pytest.mark.parametrize("device", ["cpu", "cuda"])  # as if it were one: what is sorted there is drawn here
def test_each_learner_has_orders_of_its_own_rows(device, monkeypatch):
    rng = torch.Generator().manual_seed(1)
    if device == "cuda":
        monkeypatch.setattr(minibatches, "random_orders", lambda size, count, _: random_orders(size, count, rng))
        rng_there = SimpleNamespace(device=torch.device("cuda"))
    drawn = minibatch_orders([60, 40, 60, 0], 3, rng if device == "cpu" else rng_there)
    assert [[sorted(order.tolist()) for order in each] for each in drawn] == [
        [list(range(size))] * 3 for size in (60, 40, 60, 0)
    ]
    assert len({tuple(order.tolist()) for each in drawn[:3] for order in each}) == 9  # no two share one
