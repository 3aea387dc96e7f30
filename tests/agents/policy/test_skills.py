"""Policies over skills: whose action it is, how long a command lasts, and what their learner learns from."""

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

import arenas
from agents.bridge import team_batch, to_jax
from agents.learner.happo import HappoLearner
from agents.policy.constant_inputs import silence_constant_inputs
from agents.policy.jax_policy import Params, decide, mean_action, memory_size, policy_params, stack_policies
from agents.policy.networks import Actor
from agents.policy.skill_arrays import Skill, skill_arrays
from agents.policy.skills import skilled_actions
from agents.rollout.command_clock import at_command_clock
from agents.rollout.metrics import rollout_metrics
from agents.rollout.new_worlds import make_reset
from agents.rollout.rollout import (
    Trajectory,
    Worlds,
    make_play,
    make_rollout,
    scripts_for,
    with_memory,
)
from agents.settings import Architecture, HappoConfig, SkillSettings
from arenas.arena import Arena
from league.snapshots import policy_file
from league.snapshots.transfer.skills import team_skills

WORLDS, SEES, ACTS = 12, 7, 3
decided, mean = jax.jit(decide), jax.jit(mean_action)  # one program instead of one for each operation


def network(seed: int, sees: int, acts: int, std: float = 1.0) -> dict[str, np.ndarray]:
    """An actor of which every number counts."""
    torch.manual_seed(seed)
    actor = Actor(sees, acts, Architecture((9, 8), "elu"), std)
    with torch.no_grad():
        for weights in actor.parameters():
            weights += 0.4 * torch.randn(weights.shape)
    return {name: tensor.numpy() for name, tensor in actor.state_dict().items()}


def policy(every: int = 1, skills: int = 1, blend: bool = False, reach: float = 2.0) -> Params:
    """A strategy over skills that see the first four numbers of an observation and two commands of their own."""
    total = 2 * skills
    source = np.array([0, 1, 2, 3, SEES, SEES], np.int32)
    targets = [np.array([total] * 4 + [2 * i, 2 * i + 1], np.int32) for i in range(skills)]
    own = [Skill(network(10 + i, 6, ACTS), source, each, np.zeros(6, np.float32)) for i, each in enumerate(targets)]
    strategy = network(1, SEES, total + (skills if skills > 1 else 0))
    return policy_params(strategy | skill_arrays(own, every, reach, blend))


def seen(decisions: int) -> np.ndarray:
    return np.asarray(jax.random.normal(jax.random.key(7), (decisions, WORLDS, SEES)), np.float32)


def acted(stack, observations, firsts, ticks=None):
    """Decisions of successive observations, by the memory of each before."""
    memory, found = jnp.zeros((WORLDS, memory_size(stack))), []
    for t, (now, first) in enumerate(zip(observations, firsts, strict=True)):
        keys = jax.random.split(jax.random.fold_in(jax.random.key(3), t), WORLDS)
        tick = None if ticks is None else jnp.asarray(ticks[t])
        found.append(decided(stack, jnp.asarray(now), keys, memory=memory, first=jnp.asarray(first), tick=tick))
        memory = found[-1].memory
    return found


# Whose action it is ---------------------------------------------------------------------------------------------------


def test_a_strategy_that_passes_a_command_through_gives_the_shipped_skill_bit_by_bit():
    """The command is the enemy's place, which the agent sees; the skill is then `anymal-walk` that sees it itself."""
    arena = arenas.settings("sumo-1v1-anymal").build(engine="c", threads=1)
    settings = SkillSettings(("anymal-walk",), ("slot A",), "replace", reach=16.0, every=1)
    skills = team_skills(settings, arena, arena.teams[0])
    assert skills is not None
    observations = np.asarray(jax.random.normal(jax.random.key(0), (WORLDS, 56)), np.float32)
    through = {  # a linear layer without hidden ones: 1/16 of slot A, which the reach of 16 takes back exactly
        "activation": np.int32(0), "std_scale": np.float32(0.0), "std_logit": np.zeros(3, np.float32),
        "mean.bias": np.zeros(3, np.float32), "mean.weight": np.eye(3, 56, 45, dtype=np.float32) / 16,
        "trunk.observation_mean": np.zeros(56, np.float32), "trunk.observation_var": np.ones(56, np.float32),
        "trunk.observation_clip": np.float32(np.finfo(np.float32).max),
    }  # fmt: skip
    (joined,) = skills.joined([through])
    walk = {k[2:]: v for k, v in policy_file.read(policy_file.find("anymal-walk")).arrays.items()}
    alone = mean(policy_params(silence_constant_inputs(walk)), observations)
    stack = stack_policies([policy_params(joined)])
    keys = jax.random.split(jax.random.key(1), WORLDS)
    found = decided(stack, observations, keys, memory=jnp.zeros((WORLDS, 4)))
    np.testing.assert_array_equal(found.choices, observations[:, 45:48] / 16)
    np.testing.assert_array_equal(found.actions, alone)


def test_a_shift_of_zero_is_the_skill_as_it_is():
    arena = arenas.settings("sumo-by-team").build(engine="c", threads=1)
    skills = team_skills(SkillSettings(("anymal-walk",), ("slot A:2",)), arena, arena.teams[0])
    assert skills is not None
    assert [agent.action_size for agent in skills.team.agents] == [2, 2]
    observations = jax.random.normal(jax.random.key(0), (WORLDS, 56))
    strategy = network(3, 56, 2, std=0.01)
    strategy |= {"mean.weight": np.zeros_like(strategy["mean.weight"]), "mean.bias": np.zeros(2, np.float32)}
    strategy["std_scale"] = np.zeros((), np.float32)
    params = policy_params(skills.joined([strategy] * 2)[0])
    skill = {k.removeprefix("skill.0."): v for k, v in params.items() if k.startswith("skill.0.")}
    found = decided(
        stack_policies([params]),
        observations,
        jax.random.split(jax.random.key(1), WORLDS),
        memory=jnp.zeros((WORLDS, 3)),
    )
    np.testing.assert_array_equal(found.actions, mean(skill, observations))


@pytest.mark.parametrize("skills", [1, 2])
def test_in_another_arena_skills_ignore_what_was_constant_unless_it_is_commanded(skills):
    before = {name: np.array(array) for name, array in policy(skills=skills, blend=True).items()}
    for network in (f"skill.{i}." for i in range(skills)):
        before[f"{network}trunk.observation_var"][[1, 3, 5]] = 1e-9  # two that it observes, and a command
        before[f"{network}trunk.observation_mean"][[1, 3]] = 0.5
    after = silence_constant_inputs(before)
    still = np.isin(np.arange(SEES), [1, 3])
    rests = np.where(still, np.float32(0.5), seen(1)[0])
    moved = rests + still * seen(2)[1]
    choice = np.asarray(jax.random.normal(jax.random.key(1), (WORLDS, before["mean.bias"].size)), np.float32)

    def acts(own, observations) -> np.ndarray:
        return np.asarray(skilled_actions(policy_params(own), jnp.asarray(observations), jnp.asarray(choice), mean))

    np.testing.assert_allclose(acts(after, rests), acts(before, rests), atol=1e-5)
    np.testing.assert_allclose(acts(after, moved), acts(before, rests), atol=1e-5)
    assert np.abs(acts(before, moved) - acts(before, rests)).max() > 0.1


def test_of_several_skills_the_best_scored_acts_and_blended_ones_share():
    observations = seen(1)
    answers = {}
    for blend in (False, True):
        params = policy(skills=2, blend=blend)
        (found,) = acted(stack_policies([params]), observations, [np.ones(WORLDS, bool)])
        choice = np.asarray(found.choices)
        each = []
        for i in range(2):
            own = {k.removeprefix(f"skill.{i}."): v for k, v in params.items() if k.startswith(f"skill.{i}.")}
            command = 2.0 * np.clip(choice[:, 2 * i : 2 * i + 2], -1, 1)
            each.append(np.asarray(mean(own, jnp.concatenate([observations[0][:, :4], command], 1))))
        answers[blend] = np.asarray(found.actions), each, choice[:, 4:]
    chosen, each, scores = answers[False]
    assert set(scores.argmax(1)) == {0, 1}
    np.testing.assert_allclose(chosen, np.where(scores.argmax(1)[:, None] == 0, *each), atol=1e-6)
    mixed, each, scores = answers[True]
    share = 1 / (1 + np.exp(scores[:, 1] - scores[:, 0]))[:, None]
    np.testing.assert_allclose(mixed, share * each[0] + (1 - share) * each[1], atol=1e-5)


# How long a command lasts ---------------------------------------------------------------------------------------------


def test_a_command_lasts_for_its_decisions_or_to_the_end_of_the_episode():
    firsts = np.zeros((9, WORLDS), bool)
    firsts[0], firsts[4, 0] = True, True
    found = acted(stack_policies([policy(every=3)]), seen(9), firsts)
    changed = np.array([(a.choices != b.choices).any(1) for a, b in pairwise(found)])
    np.testing.assert_array_equal(changed[:, 1], [False, False, True, False, False, True, False, False])
    np.testing.assert_array_equal(changed[:, 0], [False, False, True, True, False, False, True, False])
    actions = np.stack([each.actions for each in found])
    assert (actions[0] != actions[1]).any(1).all()  # a skill sees what happens meanwhile


def test_in_a_rollout_all_worlds_choose_together():
    firsts = np.zeros((9, WORLDS), bool)
    firsts[0], firsts[4, 0] = True, True
    found = acted(stack_policies([policy(every=3)]), seen(9), firsts, range(9))
    changed = np.array([(a.choices != b.choices).any(1) for a, b in pairwise(found)])
    np.testing.assert_array_equal(changed[:, 0], [False, False, True, True, False, True, False, False])


def test_flat_policies_and_those_over_skills_act_in_one_stack():
    """Each group has the actions that its policy gives alone, and what a flat policy learns stays its action."""
    flat, over, other = policy_params(network(5, SEES, ACTS)), policy(every=2), policy(every=2, skills=2)
    each = WORLDS // 3
    together = acted(stack_policies([flat, over, other]), seen(4), np.arange(4)[:, None] == np.zeros((1, WORLDS)))
    for i, params in enumerate((flat, over, other)):
        own, width = slice(each * i, each * (i + 1)), memory_size(stack_policies([params]))
        memory = jnp.zeros((each, width)) if width else None
        for t, found in enumerate(together):
            keys = jax.random.split(jax.random.fold_in(jax.random.key(3), t), WORLDS)[own]
            first = jnp.full(each, t == 0)
            alone = decided(stack_policies([params]), seen(4)[t][own], keys, memory=memory, first=first)
            memory = alone.memory
            np.testing.assert_allclose(found.actions[own], alone.actions, atol=1e-6)
            size = alone.choices.shape[1]
            np.testing.assert_allclose(found.choices[own, :size], alone.choices, atol=1e-6)


def test_who_has_no_skill_beside_others_holds_its_action():
    params = policy_params(network(5, SEES, ACTS) | skill_arrays([], 2, 1.0, False))
    found = acted(stack_policies([params]), seen(4), np.arange(4)[:, None] == np.zeros((1, WORLDS)))
    for a, b in zip(found[::2], found[1::2], strict=True):
        np.testing.assert_array_equal(a.actions, b.actions)
        np.testing.assert_array_equal(a.actions, a.choices)
    assert (found[0].actions != found[2].actions).any(1).all()


def test_a_command_needs_a_memory():
    with pytest.raises(ValueError, match="holds its command in its memory"):
        decide(stack_policies([policy()]), seen(1)[0], jax.random.split(jax.random.key(0), WORLDS))


# What is learnt from --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def race() -> Arena:
    """A race of two pucks, whose actions are two numbers."""
    return arenas.settings(f"{Path(__file__).parents[2] / 'arenas' / 'race.py'}:race").build(engine="c", threads=1)


@cache
def rolled(race: Arena, every: int, length: int = 12) -> tuple[Trajectory, Worlds]:
    """Play twice as many decisions with commands that last for `every` of them; return the second half and its end."""
    agents = [agent for team in race.teams for agent in team.agents]
    held = [
        policy_params(network(i, agent.observation_size, agent.action_size) | skill_arrays([], every, 1.0, False))
        for i, agent in enumerate(agents)
    ]
    stacks = {agent.name: stack_policies([each]) for agent, each in zip(agents, held, strict=True)}
    worlds = with_memory(make_reset(race)(jax.random.split(jax.random.key(1), WORLDS)), stacks)
    rollout = make_rollout(race, length)
    worlds, _ = rollout(stacks, worlds, jax.random.key(0))
    worlds, trajectory = rollout(stacks, worlds, jax.random.key(2))
    return trajectory, worlds


def test_a_row_of_a_command_is_the_sum_of_its_decisions(race):
    """Computed a second time, one decision after the other, in worlds whose episodes end anywhere."""
    trajectory, _ = rolled(race, 3)
    t = jax.device_get(trajectory)
    (agent, *_) = race.teams[0].agents
    gamma, rows = 0.9, jax.device_get(at_command_clock(trajectory, 3, 0.9))
    over = t.terminated | t.truncated | t.void
    assert over[np.arange(len(over)) % 3 != 2].sum() > 0
    for row in range(len(over) // 3):
        for world in range(WORLDS):
            at, reward, discount = 3 * row, 0.0, 1.0
            while True:
                reward += discount * t.reward[at, world, 0]
                discount *= gamma
                if over[at, world] or at % 3 == 2:
                    break
                at += 1
            np.testing.assert_allclose(rows.reward[row, world, 0], reward, rtol=1e-5, atol=1e-7)
            assert rows.terminated[row, world] == t.terminated[at, world]
            assert rows.truncated[row, world] == t.truncated[at, world]
            for ours, theirs, when in (
                (rows.observations, t.observations, 3 * row), (rows.actions, t.actions, 3 * row),
                (rows.next_observations, t.next_observations, at),
            ):  # fmt: skip
                np.testing.assert_array_equal(ours[agent.name][row, world], theirs[agent.name][when, world])


def test_densities_are_those_of_the_commands_that_were_chosen(race):
    """Torch computes them from the rows alone, as a learner does."""
    trajectory, _ = rolled(race, 3)
    batch = team_batch(trajectory, race.teams[0], 0, slice(None), 0.0, every=3, gamma=0.9)
    agent = race.teams[0].agents[0]
    actor = Actor(agent.observation_size, agent.action_size, Architecture((9, 8), "elu"), 1.0)
    given = network(0, agent.observation_size, agent.action_size)
    actor.load_state_dict({name: torch.tensor(value) for name, value in given.items()})
    with torch.no_grad():
        found = actor(batch.observations[0]).log_prob(batch.actions[0]).sum(-1)
    torch.testing.assert_close(found, batch.log_probs[0], rtol=1e-5, atol=1e-5)
    assert batch.rewards.shape == (4, WORLDS)


def test_a_row_of_one_decision_is_that_decision(race):
    trajectory, _ = rolled(race, 1)
    same = at_command_clock(trajectory, 1, 0.9)
    for ours, theirs in zip(jax.tree.leaves(same), jax.tree.leaves(trajectory), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_matches_are_played_with_commands(race):
    """In a match the clock begins with the episode."""
    agents = [agent for team in race.teams for agent in team.agents]
    held = [
        policy_params(network(i, a.observation_size, a.action_size) | skill_arrays([], 4, 1.0, False))
        for i, a in enumerate(agents)
    ]
    stacks = {agent.name: stack_policies([each]) for agent, each in zip(agents, held, strict=True)}
    episodes = make_play(race, (0, 1))(stacks, jax.random.split(jax.random.key(0), 4))
    done = np.asarray(episodes.actions[agents[0].name])[:8, 0]
    np.testing.assert_array_equal(done[:4], np.repeat(done[:1], 4, 0))
    assert (done[4] != done[3]).any()


def test_a_policy_over_skills_crosses_from_torch_unchanged():
    arrays = skill_arrays([], 4, 1.5, False)
    assert arrays["skill.every"] == 4
    assert arrays["skill.reach"] == np.float32(1.5)
    actor = Actor(SEES, ACTS, Architecture((9, 8)), 1.0)
    (strategy,) = to_jax([actor.state_dict()])
    assert set(strategy | policy_params(arrays)) == {*actor.state_dict(), *arrays}


def test_a_strategy_learns_what_to_command():
    """Rock-paper-scissors of six rounds against rock, by a skill that plays what beats the commanded hand."""
    game = arenas.settings("rock-paper-scissors")
    game = replace(game, rules=replace(game.rules, rounds=6)).build()
    rock = list(scripts_for(game, "chooser")).index("rock")
    beats = {
        "activation": np.int32(0), "std_scale": np.float32(1.0), "std_logit": np.zeros(3, np.float32),
        "mean.bias": np.zeros(3, np.float32), "mean.weight": np.eye(3, dtype=np.float32)[[2, 0, 1]],
        "trunk.observation_mean": np.zeros(3, np.float32), "trunk.observation_var": np.ones(3, np.float32),
        "trunk.observation_clip": np.float32(10.0),
    }  # fmt: skip
    arrays = {name: np.asarray(array) for name, array in beats.items()}
    skill = Skill(arrays, np.ones(3, np.int32), np.arange(3, dtype=np.int32), np.zeros(3, np.float32))
    own = policy_params(skill_arrays([skill], 4, 1.0, False))
    config = HappoConfig(Architecture((8,)), lr=0.01, skill=SkillSettings(("a file",), ("hand",), every=4))
    learner = HappoLearner([1], [3], config, seed=0)
    assert learner.config.discount == config.gamma**4
    worlds, rollout = make_reset(game)(jax.random.split(jax.random.key(1), 128)), make_rollout(game, length=16)
    enemy, scores = stack_policies([rock] * 2), []
    for iteration in range(12):
        stacks = {"blue/0": stack_policies([to_jax(learner.export())[0] | own] * 2), "red/0": enemy}
        worlds, trajectory = rollout(stacks, with_memory(worlds, stacks), jax.random.key(iteration))
        learner.learn(team_batch(trajectory, game.teams[0], 0, slice(None), 0.0, every=4, gamma=config.gamma))
        scores.append(rollout_metrics(trajectory, 0, slice(None))["score"])
    assert abs(scores[0] - 0.5) < 0.15
    assert scores[-1] > 0.8
