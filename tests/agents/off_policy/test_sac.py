"""Soft actor-critic: densities, targets, the order of agents, and what a checkpoint holds."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.distributions import AffineTransform, Normal, TanhTransform, TransformedDistribution

from agents.batch import zero_absent
from agents.devices.cuda_graphs import EagerRunner
from agents.off_policy.replay import Layout
from agents.policy.networks import SquashedGaussian
from agents.settings import ReplaySettings
from tests.agents.off_policy.conftest import AGENTS, config, experience, learner

SIZES = [a.observation_size for a in AGENTS], [a.action_size for a in AGENTS]
SAVED = config(ReplaySettings(150, 64, saved=True))


def same(one, other) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)


def test_a_sample_has_the_density_of_its_distribution():
    actor, rng = learner().agents[0].network, torch.Generator().manual_seed(1)
    with torch.no_grad():
        for tensor in actor.parameters():
            tensor += 0.5 * torch.randn(tensor.shape, generator=rng)
        policy = actor(torch.randn(50, 3, generator=rng))
    assert isinstance(policy, SquashedGaussian)
    actions, log_probs = policy.rsample(torch.randn(50, 2, generator=rng))
    limit = policy.limit.item()
    assert limit == 1.5
    inner = AffineTransform(0.0, 1 / limit), TanhTransform(), AffineTransform(0.0, limit)
    known = TransformedDistribution(Normal(policy.gaussian.mean, policy.gaussian.stddev), list(inner))
    torch.testing.assert_close(log_probs, known.log_prob(actions), atol=1e-3, rtol=1e-3)
    u = torch.linspace(-12, 12, 20_001)[:, None]  # the density of one state's actions sums to 1
    (mean, std), one = (policy.gaussian.mean[0, 0], policy.gaussian.stddev[0, 0]), slice(0, 1)
    narrow = SquashedGaussian(type(policy.gaussian)(mean.view(1), std.view(1)), policy.limit, u[one], u[one])
    a, log_density = narrow.rsample((u - mean) / std)
    assert torch.trapezoid(log_density[:, 0].exp(), a[:, 0]).item() == pytest.approx(1.0, abs=1e-3)


def test_targets_are_those_of_the_formula():
    mine = learner(config(target_entropy=-0.3))
    for seed in range(3):
        mine.learn(experience(seed))
    batch, noise = experience(9, T=1, N=40, void=0.0, dead=0.4), torch.randn(40, 3)
    decisions = mine._layout.decisions(mine._layout.rows(batch, 0.9))
    found = mine.targets(decisions, noise)
    temperatures, unit = mine.temperatures().detach(), mine.rewards.unit.item()
    assert unit != 1
    for n in range(40):
        bonus, actions = 0.0, []
        for i, agent in enumerate(mine.agents):
            with torch.no_grad():
                policy = agent.network(batch.next_observations[i][0, n])
                action, density = policy.rsample(noise[n, agent.columns])
            there = bool(batch.next_alive[i][0, n])
            actions.append(action if there else torch.zeros_like(action))
            target = AGENTS[i].action_size * (-0.3 + math.log(1.5))
            bonus -= temperatures[i].item() * (density.sum().item() + target) * there
        seen = torch.cat([x[0, n] for x in batch.next_observations])
        with torch.no_grad():
            logits = mine.target(mine.input_norm(seen)[None], torch.cat(actions)[None] / 1.5)
        twins = [(each.softmax(-1) * mine.bins.centres).sum().item() for each in logits[:, 0]]
        future = 0.0 if batch.terminated[0, n] else sum(twins) / 2 + bonus  # a truncated episode would have gone on
        assert found[n].item() == pytest.approx(batch.rewards[0, n].item() / unit + 0.9 * future, abs=1e-4)
    assert batch.terminated.any()
    assert (batch.truncated & ~batch.terminated).any()


@pytest.mark.parametrize("sequence", [True, False])
def test_each_agent_sees_the_new_actions_of_those_before_it(sequence, monkeypatch):
    mine = learner(config(sequence=sequence, lr=0.05))
    for seed in range(2):
        mine.learn(experience(seed))
    seen, first = [], set()
    for agent in mine.agents:
        monkeypatch.setattr(agent, "improve", _watched(agent, seen))
    rows, noise = mine._layout.rows(experience(7, T=1, N=40, void=0.0), 0.9), torch.randn(40, 3)
    for _ in range(12):
        seen.clear()
        before = mine._draw_joint(rows, noise)
        mine._improve_actors(EagerRunner(), rows, noise)
        after = mine._draw_joint(rows, noise)
        (one, given), (other, given_later) = seen
        first.add(one)
        assert {one, other} == {0, 1}
        torch.testing.assert_close(given, before)
        columns = mine.agents[one].columns
        torch.testing.assert_close(given_later[:, columns], (after if sequence else before)[:, columns])
        assert not torch.equal(before[:, columns], after[:, columns])
        own = mine.agents[other].columns
        torch.testing.assert_close(given_later[:, own], before[:, own])
    assert first == ({0, 1} if sequence else {0})


def _watched(agent, seen):
    improve = agent.improve

    def watched(observations, alive, joint, *more):
        seen.append((agent.number, joint.clone()))
        improve(observations, alive, joint, *more)

    return watched


def test_an_actor_climbs_the_critic_and_nothing_else():
    """The gradient of its loss is that of central differences in its own last bias."""
    mine = learner()
    for seed in range(2):
        mine.learn(experience(seed))
    rows, noise = mine._layout.rows(experience(7, T=1, N=40, void=0.0), 0.9), torch.randn(40, 3)
    batch, agent = mine._layout.decisions(rows), mine.agents[0]
    joint, seen = mine._draw_joint(rows, noise), mine.input_norm(torch.cat([*batch.observations], -1))
    bias, alive = agent.network.mean.bias, batch.alive[:, 0]

    def loss() -> torch.Tensor:
        actions, log_probs = agent.sample(batch.observations[0], noise)
        value = mine._values(mine.critic, seen, torch.cat([actions, joint[:, 2:]], -1))
        return ((mine.temperatures().detach()[0] * log_probs - value) * alive).sum() / alive.sum()

    (slope,) = torch.autograd.grad(loss(), [bias])
    for i in range(2):
        sides = []
        for step in (0.01, -0.02, 0.01):
            with torch.no_grad():
                bias[i] += step
                sides.append(loss().item())
        assert slope[i].item() == pytest.approx((sides[0] - sides[1]) / 0.02, abs=2e-3)


def test_an_agent_that_is_out_learns_nothing_while_the_other_does():
    mine = learner()
    before = mine.save()
    for seed in range(4):
        batch = experience(seed)
        none = [batch.alive[0] & False, batch.alive[1]]
        seen, actions = zero_absent(batch.observations, none), zero_absent(batch.actions, none)
        mine.learn(batch._replace(alive=none, observations=seen, actions=actions))
    after = mine.save()
    moved = {name for name in after if name.startswith("actor.") and not np.array_equal(after[name], before[name])}
    assert {name.split(".")[1] for name in moved} == {"1"}


def test_without_a_valid_decision_no_weight_moves():
    mine = learner()
    before = mine.save()
    for seed in range(4):
        mine.learn(experience(seed, void=1.1))
    after = mine.save()
    same_now = {name for name in after if np.array_equal(after[name], before[name])}
    assert {name for name in after if name.startswith(("actor.", "critic.", "input_norm."))} <= same_now


def test_learning_waits_until_the_buffer_holds_enough():
    mine = learner(config(ReplaySettings(2000, 100)))
    for seed, begun in enumerate((False, False, True)):  # 48 decisions each
        told = mine.learn(experience(seed))
        assert ("value_loss" in told) == begun
        assert told["replay"] == 48 * (seed + 1)


def test_with_its_buffer_in_the_checkpoint_a_learner_goes_on_to_the_same_bytes():
    one, other = learner(SAVED), learner(SAVED, seed=2)
    for seed in range(5):  # 240 decisions: the ring has begun anew
        one.learn(experience(seed))
    other.learn(experience(77))
    other.load(one.save())
    assert same(one.save(), other.save())
    for seed in range(5, 8):
        assert one.learn(experience(seed)) == other.learn(experience(seed))
    assert same(one.save(), other.save())


def test_without_it_a_learner_waits_until_the_buffer_is_full_enough_again():
    one, other = learner(), learner(seed=2)
    for seed in range(3):
        one.learn(experience(seed))
    for seed in (77, 78):
        assert ("value_loss" in other.learn(experience(seed))) == (seed == 78)
    other.load(one.save())
    assert not any(name.startswith("replay") for name in one.save())
    told = other.learn(experience(3))
    assert told["replay"] == 48
    assert "value_loss" not in told
    weights = {k: v for k, v in one.save().items() if k.startswith(("critic.", "target.", "adam."))}
    assert same(weights, {k: v for k, v in other.save().items() if k in weights})
    assert "value_loss" in other.learn(experience(4))


def test_a_buffer_that_a_checkpoint_cannot_hold_is_refused():
    with pytest.raises(ValueError, match=r"saved: 10000000 decisions are \d+ MiB .*capacity of \d+ or less"):
        learner(config(ReplaySettings(10_000_000, 64, saved=True)))


@pytest.mark.parametrize("forget", ["never", "opponents"])
def test_decisions_against_opponents_that_are_gone_are_forgotten(forget):
    mine = learner(config(ReplaySettings(2000, 10, forget=forget)))
    mine.meet(["red@1", "red@2"])
    mine.learn(experience(0))
    mine.meet(["red@2", "red"])
    mine.learn(experience(1))
    assert mine.replay is not None
    assert mine.replay.usable == (96 if forget == "never" else 72 - int((~mine.replay.valid[:48]).sum() - 24))
    if forget == "opponents":
        first = mine.replay.valid[:48].view(8, 6)
        assert not first[:, :3].any()  # the worlds of red@1
        assert first[:, 3:].any()


def test_critics_may_observe_more_than_their_team():
    mine, batch = learner(critic_size=12), experience(1)
    others, next_others = torch.randn(2, 8, 6, 5)
    for _ in range(3):
        told = mine.learn(batch._replace(others=[others], next_others=[next_others]))
    assert math.isfinite(told["value_loss"])
    with pytest.raises(ValueError, match="observes 0 further numbers, not 5"):
        mine.learn(batch)


def test_replayed_steps_are_steps(device):
    from agents.off_policy.sac import SacLearner

    settings = config(replay_ratio=8.0)
    replaying, plain = (
        SacLearner(AGENTS, replace(settings, cuda_graphs=on), 1, torch.device(device)) for on in (True, False)
    )
    replaying.graphs.on = True
    for seed in range(4):
        batch = experience(seed)
        told, expected = replaying.learn(batch), plain.learn(batch)
        assert told == pytest.approx(expected, rel=1e-4, abs=1e-5)
    theirs = plain.save()
    for name, array in replaying.save().items():
        np.testing.assert_allclose(array, theirs[name], rtol=1e-4, atol=1e-5, err_msg=name)
    (lane,) = replaying.graphs._by_shape.values()
    assert sum(known.replay is not None for known in lane._known.values()) == 6  # type: ignore[attr-defined]


@pytest.mark.parametrize("sequence", [True, False])
def test_a_team_learns_actions_that_fit_each_other(sequence):
    """The reward wants one agent to follow its observation, and the other to repeat what the first one does."""
    mine = learner(config(ReplaySettings(5000, 200), gamma=0.0, replay_ratio=8.0, lr=1e-2, sequence=sequence))
    rng, scores = torch.Generator().manual_seed(5), []
    for _ in range(20):
        batch = experience(int(torch.randint(10**6, (), generator=rng)), T=4, N=32, void=0.0, dead=0.0)
        shown = batch.observations[0][..., 0].tanh()
        batch.observations[1][..., 0] = batch.observations[0][..., 0]
        with torch.no_grad():
            for agent, seen, actions in zip(mine.agents, batch.observations, batch.actions, strict=True):
                noise = torch.randn(4, 32, 3, generator=rng).flatten(0, 1)
                actions.copy_(agent.sample(seen.flatten(0, 1), noise)[0].view(actions.shape))
        first, second = batch.actions[0][..., 0], batch.actions[1][..., 0]
        reward = -((first - shown) ** 2) - (second - first) ** 2
        scores.append(reward.mean().item())
        mine.learn(batch._replace(rewards=reward))
    assert scores[0] < -1.0
    assert np.mean(scores[-3:]) > -0.3


def test_the_layout_counts_every_number():
    assert Layout(*SIZES, 5).width == 2 * (7 + 5) + 3 + 2 * 2 + 2
