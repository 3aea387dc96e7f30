"""Policies and critics that remember: equal numbers in JAX and in torch, and nothing kept beyond an episode's end."""

import copy
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from torch import Tensor

import arenas
from agents.batch import Batch, Critique, Sequences, clean
from agents.bridge import team_batch, to_jax
from agents.happo import Learner
from agents.networks import GRU
from agents.policy import Crew, act, crew, learned, remember, units
from agents.rollout import Trajectory, Worlds, make_play, make_reset, make_restart, make_rollout, remembering
from agents.settings import Architecture, HappoConfig
from arenas.arena import Arena

KINDS = {
    "plain": Architecture((6,), recurrent=5),
    "two layers, layer norm": Architecture((7, 6), "elu", layer_norm=True, recurrent=5),
    "squashed, state_std": Architecture((6,), squash=1.5, state_std=True, recurrent=5),
}
WORLDS = 24
WHOLE = HappoConfig(  # one step on the whole batch
    Architecture((5,), recurrent=4), lr=0.02, critic_lr=0.05, gamma=0.0, epochs=1, minibatches=1, value_norm=False,
    fixed_order=True, chunk=8,
)  # fmt: skip


@pytest.fixture(scope="module")
def echo() -> Arena:
    """A cue to be repeated four decisions later."""
    return arenas.settings(f"{Path(__file__).parents[1] / 'arenas' / 'echo.py'}:echo").build()


def scrambled(config: HappoConfig, seed: int = 0, sizes: tuple[list[int], list[int]] = ([2], [1])) -> Learner:
    """A learner whose every weight counts, so that what it remembers shows."""
    learner, rng = Learner(*sizes, config, seed), torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for each in (*learner.actor_learners, *learner.critic_learners):
            for weights in each.network.parameters():
                weights += 0.4 * torch.randn(weights.shape, generator=rng)
    return learner


# The unit itself ------------------------------------------------------------------------------------------------------


def cell_of(gru: GRU) -> torch.nn.GRUCell:
    """Torch's own cell with the same weights under the same names."""
    cell = torch.nn.GRUCell(gru.weight_ih.shape[1], gru.weight_hh.shape[1])
    cell.load_state_dict({name: w for name, w in gru.state_dict().items() if not name.startswith("norm")})
    return cell.to(gru.weight_ih.dtype)


def along(cell: torch.nn.GRUCell, x: Tensor, first: Tensor, memory: Tensor) -> Tensor:
    """What the cell remembers (B, L, units) over sequences, each episode from nothing."""
    states = []
    for t in range(x.shape[1]):
        memory = torch.where(first[:, t, None], torch.zeros_like(memory), memory)
        memory = cell(x[:, t], memory)
        states.append(memory)
    return torch.stack(states, 1)


def test_the_unit_is_torchs_cell_which_forgets_where_an_episode_begins():
    rng = torch.Generator().manual_seed(0)
    gru = GRU(3, 4, layer_norm=False)
    with torch.no_grad():
        for bias in (gru.bias_ih, gru.bias_hh):
            bias += torch.randn(bias.shape, generator=rng)
    x, memory = torch.randn(6, 9, 3, generator=rng), torch.randn(6, 4, generator=rng)
    first = torch.rand(6, 9, generator=rng) < 0.2
    torch.testing.assert_close(gru(x, first, memory), along(cell_of(gru), x, first, memory))
    untouched = gru(x, first, memory)
    changed = gru(x, first, memory + 1.0)
    begun = first.cumsum(1) > 0
    assert torch.equal(changed[begun], untouched[begun])
    assert (changed[~begun] != untouched[~begun]).any(-1).all()


# In rollouts ----------------------------------------------------------------------------------------------------------


def rolled(arena: Arena, learner: Learner, rollouts: int = 2) -> list[tuple[Trajectory, Worlds]]:
    """Rollouts of 20 decisions that go on from each other, and the worlds after each."""
    rollout = make_rollout(arena, 20, learner.config.sequence)
    worlds = make_reset(arena)(jax.random.split(jax.random.key(1), WORLDS))
    crews, found = {"pupil/0": crew(to_jax(learner.policies()))}, []
    for number in range(rollouts):
        worlds, trajectory = rollout(crews, remembering(worlds, crews), jax.random.key(number))
        found.append((trajectory, jax.tree.map(lambda x: x.copy(), worlds)))
    return found


@pytest.mark.parametrize("architecture", KINDS.values(), ids=KINDS)
def test_densities_of_the_policy_that_acted_are_those_that_torch_computes_over_chunks(architecture, echo):
    learner = scrambled(HappoConfig(architecture, chunk=4))  # episodes have five decisions, and the first ones fewer
    actor = learner.actor_learners[0]
    for trajectory, _ in rolled(echo, learner):
        batch = clean(team_batch(trajectory, echo.teams[0], 0, slice(None), 0.0))
        assert 0.15 < float(batch.first[0].float().mean()) < 0.4
        share = actor.share(batch, torch.ones(5 * WORLDS, 4), [torch.ones(5 * WORLDS, 4)])
        torch.testing.assert_close(actor.log_probs(share), share.log_probs, rtol=1e-5, atol=1e-5)
        # Neither what was before a chunk nor that episodes end within it may be left out.
        for field in ("first", "memory"):
            without = share.observations._replace(**{field: torch.zeros_like(getattr(share.observations, field))})
            found = actor.log_probs(share._replace(observations=without))
            assert float((found - share.log_probs).abs().max()) > 0.01


def test_memory_is_that_of_the_episode(echo):
    """What a chunk begins with is what torch has remembered by then, over two rollouts and all ends of episodes."""
    learner = scrambled(HappoConfig(KINDS["plain"], chunk=4))
    found = [team_batch(t, echo.teams[0], 0, slice(None), 0.0) for t, _ in rolled(echo, learner)]
    observations, first = (torch.cat([getattr(b, field)[0] for b in found]) for field in ("observations", "first"))
    memories = torch.cat([b.memories[0] for b in found])
    actor = learner.actors[0]
    x = actor.trunk(observations).transpose(0, 1)
    states = along(cell_of(actor.gru), x, first.transpose(0, 1), torch.zeros(WORLDS, 5)).transpose(0, 1)
    torch.testing.assert_close(memories[1:], states[3:-1:4], rtol=1e-5, atol=1e-5)
    assert first[0].all()


def test_who_begins_anew_remembers_nothing_and_the_others_everything(echo):
    """As where others sit down: `make_restart` forgets what whoever sat there before remembered."""
    learner = scrambled(HappoConfig(KINDS["plain"], chunk=4))
    crews, (_, worlds) = {"pupil/0": crew(to_jax(learner.policies()))}, rolled(echo, learner, 1)[0]
    where, keys = jnp.arange(WORLDS) % 3 == 0, jax.random.split(jax.random.key(9), WORLDS)
    restarted = make_restart(echo, stagger=False)(worlds, keys, where)
    rollout = make_rollout(echo, 4, 4)

    def densities(memory: jax.Array) -> np.ndarray:
        given = jax.tree.map(lambda x: x.copy(), restarted)._replace(memory={"pupil/0": memory.copy()})
        return np.asarray(rollout(crews, given, jax.random.key(5))[1].actions["pupil/0"])

    kept = restarted.memory["pupil/0"]
    went_on, forgot, poisoned = (densities(m) for m in (
        kept, jnp.zeros_like(kept), jnp.where(where[:, None], jnp.nan, kept)
    ))  # fmt: skip
    begun = np.asarray(restarted.age == 0)  # also those whose episode had just ended
    assert begun.sum() > np.asarray(where).sum()
    np.testing.assert_array_equal(went_on[:, begun], forgot[:, begun])
    np.testing.assert_array_equal(went_on, poisoned)
    assert (went_on[0, ~begun] != forgot[0, ~begun]).all()


def test_a_rollout_is_a_whole_number_of_chunks(echo):
    with pytest.raises(ValueError, match="20 decisions are no whole number of chunks of 6"):
        make_rollout(echo, 20, 6)


def test_chunks_change_nothing_but_what_is_told_of_memory(echo, same):
    learner = scrambled(HappoConfig(KINDS["plain"], chunk=4))
    crews = {"pupil/0": crew(to_jax(learner.policies()))}
    found = []
    for chunk in (None, 4, 2):
        worlds = remembering(make_reset(echo)(jax.random.split(jax.random.key(1), WORLDS)), crews)
        found.append(make_rollout(echo, 20, chunk)(crews, worlds, jax.random.key(0)))
    (worlds, whole), *others = found
    assert whole.memories is None
    for after, chunked in others:
        assert same(chunked._replace(memories=None), whole)
        assert same(after, worlds)
    four, two = (chunked.memories["pupil/0"] for _, chunked in others)
    assert four.shape == (5, WORLDS, 5)
    np.testing.assert_array_equal(four, two[::2])


# Crews of all kinds ---------------------------------------------------------------------------------------------------

SEATED = {
    "wide": Architecture((6,), recurrent=8),
    "small": Architecture((6,), recurrent=3, layer_norm=True),
    "plain": Architecture((6,)),
}


@pytest.fixture(scope="module")
def member(scramble):
    actors = {name: scramble(i, kind, 2, 1) for i, (name, kind) in enumerate(SEATED.items())}
    return lambda who: who if isinstance(who, int) else learned(actors[who].state_dict())


def test_all_kinds_play_in_one_crew_each_as_it_would_alone(echo, member):
    who, each = ["wide", "plain", 0, "small", "wide"], 6
    keys = jax.random.split(jax.random.key(3), len(who) * each)
    members = crew([member(name) for name in who])
    assert len(members.parts) == 3
    assert units(members) == 8
    games = make_play(echo, tuple(range(len(keys))))({"pupil/0": members}, keys)
    assert games.actions["pupil/0"].shape == (5, len(keys), 1)
    play = make_play(echo, tuple(range(each)))
    for k, name in enumerate(who):
        here = slice(k * each, (k + 1) * each)
        alone = play({"pupil/0": crew([member(name)])}, keys[here])
        np.testing.assert_allclose(
            games.actions["pupil/0"][:, here], alone.actions["pupil/0"], rtol=1e-5, atol=1e-5, err_msg=str(name)
        )
        np.testing.assert_array_equal(games.score[here], alone.score)


def test_memory_stays_where_it_is_when_a_crew_becomes_wider_or_narrower(echo, member):
    worlds = make_reset(echo)(jax.random.split(jax.random.key(1), 4))

    def fitted(worlds: Worlds, *who: str) -> Worlds:
        return remembering(worlds, {"pupil/0": crew([member(name) for name in who])})

    assert fitted(worlds, "plain", "plain").memory is None
    small = fitted(worlds, "small", "plain")
    assert small.memory["pupil/0"].shape == (4, 3)
    held = small._replace(memory={"pupil/0": jnp.arange(12.0).reshape(4, 3)})
    wide = fitted(held, "small", "wide").memory["pupil/0"]
    np.testing.assert_array_equal(wide[:, :3], held.memory["pupil/0"])
    np.testing.assert_array_equal(wide[:, 3:], np.zeros((4, 5)))
    again = fitted(held._replace(memory={"pupil/0": wide}), "small", "small")
    np.testing.assert_array_equal(again.memory["pupil/0"], held.memory["pupil/0"])


def test_a_part_of_a_crew_writes_no_further_than_its_own_memory(member):
    members: Crew = crew([member("small"), member("plain"), member("wide")])
    memory = jax.random.normal(jax.random.key(0), (6, 8)).at[:2, 3:].set(0.0)
    seen = jax.random.normal(jax.random.key(1), (6, 2))
    after = np.asarray(remember(members, seen, memory, jnp.zeros(6, bool)))
    np.testing.assert_array_equal(after[:2, 3:], 0.0)
    np.testing.assert_array_equal(after[2:4], memory[2:4])  # who remembers nothing leaves it alone
    assert (after[4:] != memory[4:]).all()


def test_who_should_remember_cannot_act_without_memory(member):
    with pytest.raises(ValueError, match="give it its memory"):
        act(crew([member("small")]), jnp.zeros((2, 2)), jax.random.split(jax.random.key(0), 2))


# The update -----------------------------------------------------------------------------------------------------------


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
    value = critic.value(along(cells[1], critic.trunk(obs), first, batch.recalled[0])).squeeze(-1)
    A = R - value.detach()
    A = (A - A.mean()) / (A.std(correction=0) + 1e-5)
    features = along(cells[0], actor.trunk(obs), first, batch.memories[0][0])
    std = torch.sigmoid(actor.std_logit) * actor.std_scale
    policy = torch.distributions.Normal(actor.mean(features), std.expand(actions.shape))
    r = (policy.log_prob(actions).sum(-1) - old).exp()
    gain = torch.minimum(r * A, r.clamp(0.8, 1.2) * A).mean()
    losses = (
        -gain - WHOLE.entropy * policy.entropy().sum(-1).mean(),
        torch.nn.functional.huber_loss(value, R, delta=10.0),
    )
    for network, optimizer, loss in zip((actor, critic), optimizers, losses, strict=True):
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), WHOLE.max_grad_norm)
        optimizer.step()
    fresh = copy.deepcopy(learner)
    learner.update(batch)
    for expected, found, before in (
        (actor, learner.actors[0], fresh.actors[0]),
        (critic, learner.critic_learners[0].network, fresh.critic_learners[0].network),
    ):
        mine, old_ones = dict(found.named_parameters()), dict(before.named_parameters())
        for name, weights in expected.named_parameters():
            torch.testing.assert_close(mine[name], weights, rtol=1e-4, atol=1e-5, msg=name)
            assert float((mine[name] - old_ones[name]).detach().abs().max()) > 1e-4, name


def critique_of(learner: Learner, batch: Batch) -> Critique:
    return learner.critic_learners[0].criticise(clean(batch))


def part_of(batch: Batch, begin: int, end: int) -> Batch:
    """Some decisions of a batch in chunks of one."""
    cut = [[x[begin:end] for x in each] if isinstance(each, list) else each[begin:end] for each in batch[:10]]
    return Batch(*cut, first=[batch.first[0][begin:end]], memories=batch.memories, recalled=batch.recalled)


def test_a_critic_goes_on_from_what_it_remembered_at_the_end_of_the_batch_before(experience):
    config = HappoConfig(Architecture((5,), recurrent=4), chunk=2, gamma=0.9)
    learner = scrambled(config, sizes=([4, 3], [2, 1]))
    batch = experience(learner, seed=3)
    whole = critique_of(learner, batch)
    learner.update_critic_only(batch)
    (last,) = learner.remembered
    begin = critique_of(scrambled(config, sizes=([4, 3], [2, 1])), part_of(batch, 0, 4))
    rest = critique_of(
        scrambled(config, sizes=([4, 3], [2, 1])), part_of(batch, 4, 8)._replace(recalled=list(begin.last))
    )
    torch.testing.assert_close(torch.cat([begin.values, rest.values]), whole.values)
    torch.testing.assert_close(torch.cat([begin.seen.memory, rest.seen.memory]), whole.seen.memory)
    torch.testing.assert_close(rest.last[0], last)
    goes_on = ~batch.first[0][4]  # into the second part; where it does not, what was before is of no account
    poisoned = [begin.last[0].masked_fill(~goes_on[:, None], 99.0)]
    again = critique_of(scrambled(config, sizes=([4, 3], [2, 1])), part_of(batch, 4, 8)._replace(recalled=poisoned))
    assert torch.equal(again.values, rest.values)
    lost = critique_of(
        scrambled(config, sizes=([4, 3], [2, 1])), part_of(batch, 4, 8)._replace(recalled=[0 * begin.last[0]])
    )
    assert ((lost.values != rest.values)[: len(goes_on), 0] == goes_on).all()


def test_what_followed_is_valued_as_the_next_decision_sees_it(experience):
    """V(s_{t+1}) is V(s_t) of the next row as long as the episode lasts, and that of the same episode where it ends."""
    learner = scrambled(HappoConfig(Architecture((5,), recurrent=4), chunk=2), sizes=([4], [2]))
    batch = experience(learner, seed=3)
    critic, first = learner.critic_learners[0].network, batch.first[0]
    following = torch.where(first[1:, :, None], batch.next_observations[0][:-1], batch.observations[0][1:])
    following = torch.cat([following, batch.next_observations[0][-1:]])
    by_world = [x.transpose(0, 1) for x in (batch.observations[0], following, first)]
    with torch.no_grad():
        seen = Sequences(by_world[0], by_world[2], batch.recalled[0])
        values, next_values, states = critic.along(seen, by_world[1])
    goes_on = ~first[1:].transpose(0, 1)
    torch.testing.assert_close(next_values[:, :-1][goes_on], values[:, 1:][goes_on])
    torch.testing.assert_close(values, critic(seen))
    ended = cell_of(critic.gru)(critic.trunk(by_world[1]).flatten(0, 1), states.flatten(0, 1))
    torch.testing.assert_close(critic.value(ended).view_as(next_values), next_values)


def test_after_a_batch_in_which_all_is_void_nothing_is_remembered(experience):
    learner = scrambled(WHOLE, sizes=([4], [2]))
    batch = experience(learner, seed=2)
    learner.update(batch)
    assert [m.shape for m in learner.remembered] == [(6, 4)]
    assert learner.update(batch._replace(void=torch.ones_like(batch.void))) == {}
    assert learner.remembered == ()


def test_what_a_void_decision_holds_changes_nothing(experience, same):
    states = []
    for garbage in (None, 1e3, float("nan")):
        learner = scrambled(HappoConfig(Architecture((5,), recurrent=4), chunk=2), sizes=([4, 3], [2, 1]))
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
            for memory in (*batch.memories, batch.recalled):  # before a chunk with which an episode begins
                for number, held in enumerate(memory):
                    held[batch.first[0][2 * number]] = garbage
        learner.update(batch)
        states.append((learner.state(), list(learner.remembered)))
    assert same(states[0], states[1])
    assert same(states[0], states[2])


# A game for who remembers ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("recurrent", "learns"), [(16, True), (0, False)], ids=["GRU", "feed-forward"])
def test_who_remembers_can_repeat_what_was_said_and_nobody_else(recurrent, learns, echo):
    """Chance is a half. The answer is due four decisions after the cue, and all that is seen by then is that it is."""
    config = HappoConfig(Architecture((16,), recurrent=recurrent), lr=0.01, critic_lr=0.01, chunk=10)
    learner, rollout = Learner([2], [1], config, seed=0), make_rollout(echo, 20, config.sequence)
    worlds, recalled = make_reset(echo)(jax.random.split(jax.random.key(1), 128)), ()
    for iteration in range(25):
        crews = {"pupil/0": crew(to_jax(learner.policies()))}
        worlds, trajectory = rollout(crews, remembering(worlds, crews), jax.random.key(iteration))
        figures = learner.update(team_batch(trajectory, echo.teams[0], 0, slice(None), 0.0, recalled=recalled))
        recalled = learner.remembered
    games = make_play(echo)({"pupil/0": crew(to_jax(learner.policies()))}, jax.random.split(jax.random.key(7), 512))
    score = float(games.score.mean())
    if learns:
        assert score > 0.95
        assert figures["explained_variance"] > 0.8  # the critic remembers too: the answer is known before it is given
    else:
        assert 0.4 < score < 0.6  # 512 games err by 0.02
        assert figures["explained_variance"] < 0.2
