"""Actors and critics that remember, as they learn: against torch's own cell, over chunks and from batch to batch."""

import copy
from collections.abc import Sequence

import torch
from torch import Tensor

from agents.batch import Batch, CriticBatch, Sequences, clean
from agents.learner.happo import HappoLearner
from agents.policy.networks import GRU
from agents.settings import Architecture, HappoConfig
from tests.agents.memories import cell_of, evaluate_sequence, scrambled

WHOLE = HappoConfig(  # one step on the whole batch
    Architecture((5,), recurrent=4), lr=0.02, critic_lr=0.05, gamma=0.0, epochs=1, minibatches=1, value_norm=False,
    fixed_order=True, chunk_length=8,
)  # fmt: skip


def test_the_unit_is_torchs_cell_which_forgets_where_an_episode_begins():
    rng = torch.Generator().manual_seed(0)
    gru = GRU(3, 4, layer_norm=False)
    with torch.no_grad():
        for bias in (gru.bias_ih, gru.bias_hh):
            bias += torch.randn(bias.shape, generator=rng)
    x, memory = torch.randn(6, 9, 3, generator=rng), torch.randn(6, 4, generator=rng)
    first = torch.rand(6, 9, generator=rng) < 0.2
    torch.testing.assert_close(gru(x, first, memory), evaluate_sequence(cell_of(gru), x, first, memory))
    untouched = gru(x, first, memory)
    changed = gru(x, first, memory + 1.0)
    begun = first.cumsum(1) > 0
    assert torch.equal(changed[begun], untouched[begun])
    assert (changed[~begun] != untouched[~begun]).any(-1).all()


def sequences(batch: Batch, i: int) -> Sequence[Tensor]:
    """Agent i's whole rollout in each world: observations, actions, densities, and where episodes begin."""
    return [x.transpose(0, 1) for x in (batch.observations[i], batch.actions[i], batch.log_probs[i], batch.first[0])]


def test_a_chunk_as_long_as_the_rollout_is_the_plain_computation(experience):
    """PPO on whole sequences with torch's own cell; so is the critic's step."""
    learner = scrambled(WHOLE, sizes=([4], [2]))
    batch, (actor, critic) = experience(learner, seed=2), (
        copy.deepcopy(x[0].network) for x in (learner.actor_learners, learner.critic_learners)
    )  # fmt: skip
    obs, actions, old, first = sequences(batch, 0)
    cells = [cell_of(network.gru) for network in (actor, critic)]
    for network, cell in zip((actor, critic), cells, strict=True):
        network.gru = cell  # the optimiser below sees the cell's weights
    optimizers = [torch.optim.Adam(x.parameters(), lr, eps=1e-5) for x, lr in ((actor, 0.02), (critic, 0.05))]

    R = batch.rewards.transpose(0, 1)
    value = critic.value(evaluate_sequence(cells[1], critic.trunk(obs), first, batch.critic_memories[0])).squeeze(-1)
    A = R - value.detach()
    A = (A - A.mean()) / (A.std(correction=0) + 1e-5)
    features = evaluate_sequence(cells[0], actor.trunk(obs), first, batch.memories[0][0])
    std = torch.sigmoid(actor.std_logit) * actor.std_scale
    policy = torch.distributions.Normal(actor.mean(features), std.expand(actions.shape))
    r = (policy.log_prob(actions).sum(-1) - old).exp()
    gain = torch.minimum(r * A, r.clamp(0.8, 1.2) * A).mean()
    losses = (
        -gain - WHOLE.entropy_coef * policy.entropy().sum(-1).mean(),
        torch.nn.functional.huber_loss(value, R, delta=10.0),
    )
    for network, optimizer, loss in zip((actor, critic), optimizers, losses, strict=True):
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), WHOLE.max_grad_norm)
        optimizer.step()
    fresh = copy.deepcopy(learner)
    learner.learn(batch)
    for expected, found, before in (
        (actor, learner.actors[0], fresh.actors[0]),
        (critic, learner.critic_learners[0].network, fresh.critic_learners[0].network),
    ):
        mine, old_ones = dict(found.named_parameters()), dict(before.named_parameters())
        for name, weights in expected.named_parameters():
            torch.testing.assert_close(mine[name], weights, rtol=1e-4, atol=1e-5, msg=name)
            assert float((mine[name] - old_ones[name]).detach().abs().max()) > 1e-4, name


def critique_of(learner: HappoLearner, batch: Batch) -> CriticBatch:
    return learner.critic_learners[0].evaluate(clean(batch))


def part_of(batch: Batch, begin: int, end: int) -> Batch:
    """Some decisions of a batch in chunks of one."""
    cut = [[x[begin:end] for x in each] if isinstance(each, list) else each[begin:end] for each in batch[:10]]
    return Batch(
        *cut, first=[batch.first[0][begin:end]], memories=batch.memories, critic_memories=batch.critic_memories
    )


def test_a_critic_goes_on_from_what_it_remembered_at_the_end_of_the_batch_before(experience):
    config = HappoConfig(Architecture((5,), recurrent=4), chunk_length=2, gamma=0.9)
    learner = scrambled(config, sizes=([4, 3], [2, 1]))
    batch = experience(learner, seed=3)
    whole = critique_of(learner, batch)
    learner.update_critic_only(batch)
    (last,) = learner.final_memories
    begin = critique_of(scrambled(config, sizes=([4, 3], [2, 1])), part_of(batch, 0, 4))
    rest = critique_of(
        scrambled(config, sizes=([4, 3], [2, 1])), part_of(batch, 4, 8)._replace(critic_memories=list(begin.last))
    )
    torch.testing.assert_close(torch.cat([begin.values, rest.values]), whole.values)
    torch.testing.assert_close(torch.cat([begin.seen.memory, rest.seen.memory]), whole.seen.memory)
    torch.testing.assert_close(rest.last[0], last)
    goes_on = ~batch.first[0][4]  # into the second part; where it does not, what was before is of no account
    poisoned = [begin.last[0].masked_fill(~goes_on[:, None], 99.0)]
    again = critique_of(
        scrambled(config, sizes=([4, 3], [2, 1])), part_of(batch, 4, 8)._replace(critic_memories=poisoned)
    )
    assert torch.equal(again.values, rest.values)
    lost = critique_of(
        scrambled(config, sizes=([4, 3], [2, 1])), part_of(batch, 4, 8)._replace(critic_memories=[0 * begin.last[0]])
    )
    assert ((lost.values != rest.values)[: len(goes_on), 0] == goes_on).all()


def test_a_value_is_that_of_what_was_remembered_and_without_that_of_nothing(experience):
    learner = scrambled(HappoConfig(Architecture((5,), recurrent=4), chunk_length=2), sizes=([4, 3], [2, 1]))
    batch = experience(learner, seed=3)
    (values,) = learner.values(batch)
    known = critique_of(learner, batch).values.unflatten(0, (-1, batch.rewards.shape[1])).transpose(1, 2).flatten(0, 1)
    torch.testing.assert_close(values, known)
    (fresh,) = learner.values(batch._replace(critic_memories=()))
    torch.testing.assert_close(fresh, learner.values(batch._replace(critic_memories=[0 * batch.critic_memories[0]]))[0])
    assert not torch.allclose(fresh, values)


def test_what_followed_is_valued_as_the_next_decision_sees_it(experience):
    """V(s_{t+1}) is V(s_t) of the next row as long as the episode lasts, and that of the same episode where it ends."""
    learner = scrambled(HappoConfig(Architecture((5,), recurrent=4), chunk_length=2), sizes=([4], [2]))
    batch = experience(learner, seed=3)
    critic, first = learner.critic_learners[0].network, batch.first[0]
    following = torch.where(first[1:, :, None], batch.next_observations[0][:-1], batch.observations[0][1:])
    following = torch.cat([following, batch.next_observations[0][-1:]])
    by_world = [x.transpose(0, 1) for x in (batch.observations[0], following, first)]
    with torch.no_grad():
        seen = Sequences(by_world[0], by_world[2], batch.critic_memories[0])
        values, next_values, states = critic.evaluate_sequence(seen, by_world[1])
    goes_on = ~first[1:].transpose(0, 1)
    torch.testing.assert_close(next_values[:, :-1][goes_on], values[:, 1:][goes_on])
    torch.testing.assert_close(values, critic(seen))
    ended = cell_of(critic.gru)(critic.trunk(by_world[1]).flatten(0, 1), states.flatten(0, 1))
    torch.testing.assert_close(critic.value(ended).view_as(next_values), next_values)


def test_after_a_batch_in_which_all_is_void_nothing_is_remembered(experience):
    learner = scrambled(WHOLE, sizes=([4], [2]))
    batch = experience(learner, seed=2)
    learner.learn(batch)
    assert [m.shape for m in learner.final_memories] == [(6, 4)]
    assert learner.learn(batch._replace(void=torch.ones_like(batch.void))) == {}
    assert learner.final_memories == ()


def test_what_a_void_decision_holds_changes_nothing(experience, same):
    states = []
    for garbage in (None, 1e3, float("nan")):
        learner = scrambled(HappoConfig(Architecture((5,), recurrent=4), chunk_length=2), sizes=([4, 3], [2, 1]))
        batch = experience(learner, seed=4, void=0.2)
        if garbage is not None:
            for tensor in (
                *batch.observations,
                *batch.next_observations,
                *batch.actions,
                *batch.log_probs,
                batch.rewards,
            ):
                tensor[batch.void] = garbage
            for memory in (*batch.memories, batch.critic_memories):  # before a chunk with which an episode begins
                for number, held in enumerate(memory):
                    held[batch.first[0][2 * number]] = garbage
        learner.learn(batch)
        states.append((learner.save(), list(learner.final_memories)))
    assert same(states[0], states[1])
    assert same(states[0], states[2])
