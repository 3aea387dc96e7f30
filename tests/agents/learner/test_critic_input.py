"""What a critic may see besides its own team, and that it learns from that alone."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from agents.batch import Batch, clean
from agents.learner.happo import HappoLearner
from storage.blobs import arrays
from tests.agents.paper import worst_gap
from tests.agents.trios import FULL, PLAIN, new_learner
from tests.agents.variants import with_sides


def with_others(batch: Batch, seed: int = 11) -> Batch:
    rng = torch.Generator().manual_seed(seed)
    shape = batch.rewards.shape
    seen = [[torch.randn((*shape, n), generator=rng) for n in (3, 2)] for _ in range(2)]
    alive = [[torch.rand(shape, generator=rng) < 0.7 for _ in range(2)] for _ in range(2)]
    return batch._replace(others=seen[0], next_others=seen[1], others_alive=alive[0], next_others_alive=alive[1])


def test_a_critic_may_see_the_other_teams(experience, same):
    config = replace(FULL, critic_input="all", method="mappo")
    states = []
    for garbage in (None, float("nan")):
        learner = new_learner(config, others=[3, 2])
        batch = with_others(experience(learner, seed=4, void=0.1))
        if garbage is not None:  # who is out of the game shows zeros, whatever its numbers say
            for seen, alive in zip(batch.others, batch.others_alive, strict=True):
                seen[~alive] = garbage
        network = copy.deepcopy(learner.critic_learners[0].network)
        figures = learner.learn(batch)
        states.append(learner.save())
    assert same(*states)
    assert len(network.trunk.observation_mean) == 4 + 4 + 3 + 3 + 2

    seen = [
        *batch.observations,
        *(o.where(a[..., None], 0.0) for o, a in zip(batch.others, batch.others_alive, strict=True)),
    ]
    critic_batch = new_learner(config, others=[3, 2]).critic_learners[0].evaluate(clean(batch))
    with torch.no_grad():
        sound = ~batch.void.flatten()
        torch.testing.assert_close(critic_batch.predictions[sound], network(torch.cat(seen, -1))[~batch.void])
    assert np.isfinite(list(figures.values())).all()


@pytest.mark.parametrize(("critic_input", "critic_views"), [("privileged", 1), ("same", 3)])
def test_a_critic_that_sees_something_else_learns_from_that_alone(critic_input, critic_views, experience, same):
    config = replace(FULL, critic_input=critic_input)
    states = []
    for garbage in (None, float("nan")):
        learner = new_learner(config, critic_size=7)
        batch = with_sides(experience(learner, seed=4, void=0.1), critic_views)
        if garbage is not None:  # what is void means nothing, whatever its numbers say
            for side in batch.critic_views:
                for x in (side.seen, side.next_seen, side.rewards):
                    x[side.void] = garbage
        network = copy.deepcopy(learner.critic_learners[0].network)
        critic_batch = learner.critic_learners[0].evaluate(clean(batch))
        figures = learner.learn(batch)
        states.append(learner.save())
    assert same(*states)
    assert np.isfinite(list(figures.values())).all()
    seen = torch.cat([side.seen.flatten(0, 1) for side in batch.critic_views])
    valid = ~torch.cat([side.void.flatten() for side in batch.critic_views])
    assert torch.equal(critic_batch.valid, valid)
    with torch.no_grad():
        torch.testing.assert_close(critic_batch.predictions[valid], network(seen[valid]))
    own = batch.rewards.numel()
    assert critic_batch.advantages.shape == (own,)
    torch.testing.assert_close(critic_batch.returns[:own], critic_batch.advantages + critic_batch.values[:own])
    assert set(learner.observed[-1].tolist()) == {valid.sum().item()}
    np.testing.assert_allclose(states[0]["critic.trunk.observation_mean"], seen[valid].mean(0), atol=1e-5)


def test_a_critic_common_to_all_teams_learns_as_one_to_whom_all_of_them_were_worlds_of_one_team(experience):
    config = replace(PLAIN, gamma=0.97, critic_input="same", value_norm=True)
    common = new_learner(config, critic_size=7)
    batch = with_sides(experience(common, seed=4, void=0.1), 3)
    one = HappoLearner([7], [2], replace(config, critic_input="own"), seed=3)
    one.critic_learners[0].network.load_state_dict(common.critic_learners[0].network.state_dict())
    fields = [torch.cat(each, 1) for each in zip(*batch.critic_views, strict=True)]
    wide = experience(one, seed=5, N=3 * batch.rewards.shape[1])
    wide = wide._replace(
        observations=[fields[0]], next_observations=[fields[1]], rewards=fields[2], terminated=fields[3],
        void=fields[4], truncated=torch.cat([batch.truncated] * 3, 1),
    )  # fmt: skip
    before = copy.deepcopy(common.critic_learners[0].network)
    told, alike = common.critic_learners[0].evaluate(clean(batch)), one.critic_learners[0].evaluate(clean(wide))
    T, N = batch.rewards.shape
    torch.testing.assert_close(told.advantages.view(T, N), alike.advantages.view(T, 3 * N)[:, :N])
    figures = common.update_critic_only(batch)
    assert figures == pytest.approx(one.update_critic_only(wide), abs=1e-5)
    assert worst_gap(common.critic_learners[0].network, one.critic_learners[0].network) < 1e-6
    assert worst_gap(before, one.critic_learners[0].network) > 1e-3


@pytest.mark.parametrize(("critic_input", "critic_views"), [("privileged", 1), ("same", 2)])
def test_such_a_critic_goes_on_from_its_checkpoint_as_if_nothing_had_been(critic_input, critic_views, experience, same):
    config = replace(FULL, critic_input=critic_input)
    learner = new_learner(config, critic_size=7)
    learner.learn(with_sides(experience(learner, seed=1, void=0.1), critic_views))
    saved = arrays.to_bytes(learner.save())
    assert {k.split(".")[0] for k in learner.save()} == {k.split(".")[0] for k in new_learner(FULL).save()}
    then = with_sides(experience(learner, seed=9), critic_views, seed=5)
    figures = learner.learn(then)
    resumed = new_learner(config, seed=77, critic_size=7)
    resumed.load(arrays.from_bytes(saved))
    assert resumed.learn(then) == figures
    assert same(resumed.save(), learner.save())
    with pytest.raises(ValueError, match=r"does not fit this learner: critic\.trunk\."):
        new_learner(FULL).load(learner.save())
