"""Policies that remember, as they act: equal numbers in JAX and in torch, and nothing kept beyond an episode's end."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

import arenas
from agents.batch import clean
from agents.bridge import team_batch, to_jax
from agents.learner.happo import HappoLearner
from agents.policy.jax_policy import PolicyStack, decide, memory_size, policy_params, stack_policies, update_memory
from agents.rollout.new_worlds import make_reset, make_restart
from agents.rollout.rollout import Trajectory, Worlds, make_play, make_rollout, with_memory
from agents.settings import Architecture, HappoConfig
from arenas.arena import Arena
from tests.agents.memories import cell_of, evaluate_sequence, scrambled

KINDS = {
    "plain": Architecture((6,), recurrent=5),
    "two layers, layer norm": Architecture((7, 6), "elu", layer_norm=True, recurrent=5),
    "squashed, state_std": Architecture((6,), squash=1.5, state_std=True, recurrent=5),
}
WORLDS = 24


@pytest.fixture(scope="module")
def echo() -> Arena:
    """A cue to be repeated four decisions later."""
    return arenas.settings(f"{Path(__file__).parents[2] / 'arenas' / 'echo.py'}:echo").build()


# In rollouts ----------------------------------------------------------------------------------------------------------


def rolled(arena: Arena, learner: HappoLearner, rollouts: int = 2) -> list[tuple[Trajectory, Worlds]]:
    """Rollouts of 20 decisions that go on from each other, and the worlds after each."""
    rollout = make_rollout(arena, 20, learner.config.sequence)
    worlds = make_reset(arena)(jax.random.split(jax.random.key(1), WORLDS))
    stacks, found = {"pupil/0": stack_policies(to_jax(learner.export()))}, []
    for number in range(rollouts):
        worlds, trajectory = rollout(stacks, with_memory(worlds, stacks), jax.random.key(number))
        found.append((trajectory, jax.tree.map(lambda x: x.copy(), worlds)))
    return found


@pytest.mark.parametrize("architecture", KINDS.values(), ids=KINDS)
def test_densities_of_the_policy_that_acted_are_those_that_torch_computes_over_chunks(architecture, echo):
    learner = scrambled(
        HappoConfig(architecture, chunk_length=4)
    )  # episodes have five decisions, and the first ones fewer
    actor = learner.actor_learners[0]
    for trajectory, _ in rolled(echo, learner):
        batch = clean(team_batch(trajectory, echo.teams[0], 0, slice(None), 0.0))
        assert 0.15 < float(batch.first[0].float().mean()) < 0.4
        actor_batch = actor.actor_batch(batch, torch.ones(5 * WORLDS, 4), [torch.ones(5 * WORLDS, 4)])
        torch.testing.assert_close(actor.log_probs(actor_batch), actor_batch.log_probs, rtol=1e-5, atol=1e-5)
        # Neither what was before a chunk nor that episodes end within it may be left out.
        for field in ("first", "memory"):
            without = actor_batch.observations._replace(
                **{field: torch.zeros_like(getattr(actor_batch.observations, field))}
            )
            found = actor.log_probs(actor_batch._replace(observations=without))
            assert float((found - actor_batch.log_probs).abs().max()) > 0.01


def test_memory_is_that_of_the_episode(echo):
    """What a chunk begins with is what torch has remembered by then, over two rollouts and all ends of episodes."""
    learner = scrambled(HappoConfig(KINDS["plain"], chunk_length=4))
    found = [team_batch(t, echo.teams[0], 0, slice(None), 0.0) for t, _ in rolled(echo, learner)]
    observations, first = (torch.cat([getattr(b, field)[0] for b in found]) for field in ("observations", "first"))
    memories = torch.cat([b.memories[0] for b in found])
    actor = learner.actors[0]
    x = actor.trunk(observations).transpose(0, 1)
    states = evaluate_sequence(cell_of(actor.gru), x, first.transpose(0, 1), torch.zeros(WORLDS, 5)).transpose(0, 1)
    torch.testing.assert_close(memories[1:], states[3:-1:4], rtol=1e-5, atol=1e-5)
    assert first[0].all()


def test_who_begins_anew_remembers_nothing_and_the_others_everything(echo):
    """As where others sit down: `make_restart` forgets what whoever sat there before remembered."""
    learner = scrambled(HappoConfig(KINDS["plain"], chunk_length=4))
    stacks, (_, worlds) = {"pupil/0": stack_policies(to_jax(learner.export()))}, rolled(echo, learner, 1)[0]
    where, keys = jnp.arange(WORLDS) % 3 == 0, jax.random.split(jax.random.key(9), WORLDS)
    restarted = make_restart(echo, stagger=False)(worlds, keys, where)
    rollout = make_rollout(echo, 4, 4)

    def densities(memory: jax.Array) -> np.ndarray:
        given = jax.tree.map(lambda x: x.copy(), restarted)._replace(memory={"pupil/0": memory.copy()})
        return np.asarray(rollout(stacks, given, jax.random.key(5))[1].actions["pupil/0"])

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


@pytest.mark.optimised
def test_chunks_change_nothing_but_what_is_told_of_memory(echo, same):
    learner = scrambled(HappoConfig(KINDS["plain"], chunk_length=4))
    stacks = {"pupil/0": stack_policies(to_jax(learner.export()))}
    found = []
    for chunk in (None, 4, 2):
        worlds = with_memory(make_reset(echo)(jax.random.split(jax.random.key(1), WORLDS)), stacks)
        found.append(make_rollout(echo, 20, chunk)(stacks, worlds, jax.random.key(0)))
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
    return lambda who: who if isinstance(who, int) else policy_params(actors[who].state_dict())


@pytest.mark.slow
def test_all_kinds_play_in_one_crew_each_as_it_would_alone(echo, member):
    who, each = ["wide", "plain", 0, "small", "wide"], 6
    keys = jax.random.split(jax.random.key(3), len(who) * each)
    stack = stack_policies([member(name) for name in who])
    assert len(stack.parts) == 3
    assert memory_size(stack) == 8
    games = make_play(echo, tuple(range(len(keys))))({"pupil/0": stack}, keys)
    assert games.actions["pupil/0"].shape == (5, len(keys), 1)
    play = make_play(echo, tuple(range(each)))
    for k, name in enumerate(who):
        here = slice(k * each, (k + 1) * each)
        alone = play({"pupil/0": stack_policies([member(name)])}, keys[here])
        np.testing.assert_allclose(
            games.actions["pupil/0"][:, here], alone.actions["pupil/0"], rtol=1e-5, atol=1e-5, err_msg=str(name)
        )
        np.testing.assert_array_equal(games.score[here], alone.score)


def test_memory_stays_where_it_is_when_a_crew_becomes_wider_or_narrower(echo, member):
    worlds = make_reset(echo)(jax.random.split(jax.random.key(1), 4))

    def fitted(worlds: Worlds, *who: str) -> Worlds:
        return with_memory(worlds, {"pupil/0": stack_policies([member(name) for name in who])})

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
    stack: PolicyStack = stack_policies([member("small"), member("plain"), member("wide")])
    memory = jax.random.normal(jax.random.key(0), (6, 8)).at[:2, 3:].set(0.0)
    seen = jax.random.normal(jax.random.key(1), (6, 2))
    after = np.asarray(update_memory(stack, seen, memory, jnp.zeros(6, bool)))
    np.testing.assert_array_equal(after[:2, 3:], 0.0)
    np.testing.assert_array_equal(after[2:4], memory[2:4])  # who remembers nothing leaves it alone
    assert (after[4:] != memory[4:]).all()


def test_who_should_remember_cannot_act_without_memory(member):
    with pytest.raises(ValueError, match="give it its memory"):
        decide(stack_policies([member("small")]), jnp.zeros((2, 2)), jax.random.split(jax.random.key(0), 2))


# A game for who remembers ---------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("recurrent", "learns"), [(16, True), (0, False)], ids=["GRU", "feed-forward"])
def test_who_remembers_can_repeat_what_was_said_and_nobody_else(recurrent, learns, echo):
    """Chance is a half. The answer is due four decisions after the cue, and all that is seen by then is that it is."""
    config = HappoConfig(Architecture((16,), recurrent=recurrent), lr=0.01, critic_lr=0.01, chunk_length=10)
    learner, rollout = HappoLearner([2], [1], config, seed=0), make_rollout(echo, 20, config.sequence)
    worlds, critic_memories = make_reset(echo)(jax.random.split(jax.random.key(1), 128)), ()
    for iteration in range(25):
        stacks = {"pupil/0": stack_policies(to_jax(learner.export()))}
        worlds, trajectory = rollout(stacks, with_memory(worlds, stacks), jax.random.key(iteration))
        figures = learner.learn(
            team_batch(trajectory, echo.teams[0], 0, slice(None), 0.0, critic_memories=critic_memories)
        )
        critic_memories = learner.final_memories
    games = make_play(echo)(
        {"pupil/0": stack_policies(to_jax(learner.export()))}, jax.random.split(jax.random.key(7), 512)
    )
    score = float(games.score.mean())
    if learns:
        assert score > 0.95
        assert figures["explained_variance"] > 0.8  # the critic remembers too: the answer is known before it is given
    else:
        assert 0.4 < score < 0.6  # 512 games err by 0.02
        assert figures["explained_variance"] < 0.2
