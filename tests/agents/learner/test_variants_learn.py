"""Games that variants are for, and the cheapest arena, which every variant learns."""

from dataclasses import replace
from pathlib import Path

import jax
import pytest
import torch

import arenas
from agents.batch import Batch
from agents.bridge import common_critic_size, team_batch, to_jax
from agents.learner.happo import HappoLearner
from agents.policy.jax_policy import stack_policies
from agents.rollout.metrics import rollout_metrics
from agents.rollout.new_worlds import make_reset
from agents.rollout.rollout import make_rollout, scripts_for
from agents.settings import Architecture, HappoConfig

XOR = torch.tensor([[0.0, 1.0], [1.0, 0.0]])  # one of two robots shall go, and only one
GO = HappoConfig(Architecture((8,)), lr=0.05, gamma=0.0, entropy_coef=0.0, epochs=4, minibatches=1, fixed_order=True)


def two_alike(config: HappoConfig) -> HappoLearner:
    """Two agents that begin alike, and go with a probability of a third."""
    learner = HappoLearner([1, 1], [2, 2], config, seed=0)
    with torch.no_grad():
        learner.actors[0].mean.bias.copy_(torch.tensor([0.5, 0.0]))
    for actor in learner.actors[1:]:
        actor.load_state_dict(learner.actors[0].state_dict())
    return learner


def play(learner: HappoLearner, rng: torch.Generator) -> Batch:
    """64 games, and the same with the robots in each other's places: the batch prefers nobody either."""
    obs = torch.ones(1, 128, 1)
    with torch.no_grad():
        policies = [actor(obs) for actor in learner.actors]
        half = [p.mean[:, :64] + p.stddev[:, :64] * torch.randn((1, 64, 2), generator=rng) for p in policies]
        actions = [torch.cat(half, 1), torch.cat(half[::-1], 1)]
        log_probs = [p.log_prob(a).sum(-1) for p, a in zip(policies, actions, strict=True)]
    first, second = (a.argmax(-1) for a in actions)
    yes, no = torch.ones(1, 128, dtype=torch.bool), torch.zeros(1, 128, dtype=torch.bool)
    return Batch([obs] * 2, [obs] * 2, actions, log_probs, [yes] * 2, [yes] * 2, XOR[first, second], yes, no, no)


def payoff(learner: HappoLearner) -> float:
    """What both expect from 4,000 games."""
    rng, obs = torch.Generator().manual_seed(99), torch.ones(4000, 1)
    with torch.no_grad():
        policies = [actor.gaussian(obs) for actor in learner.actors]
        chosen = [(p.mean + p.stddev * torch.randn(4000, 2, generator=rng)).argmax(-1) for p in policies]
    return float(XOR[chosen[0], chosen[1]].mean())


@pytest.mark.parametrize(
    ("variant", "climbs"),
    [({}, True), ({"method": "mappo"}, False), ({"method": "ippo"}, False), ({"share_actors": True}, False)],
    ids=["happo", "mappo", "ippo", "shared"],
)
def test_who_goes_first_matters_where_two_alike_must_do_unlike_things(variant, climbs):
    """Alike policies of alike experience change alike: without M nobody can give way, and half of the games is best.

    In sequence the second agent learns what the first has become by then (Kuba et al., 2022, proposition 1).
    """
    learner, rng = two_alike(replace(GO, **variant)), torch.Generator().manual_seed(1)
    start = payoff(learner)
    for _ in range(40):
        learner.learn(play(learner, rng))
    assert 0.35 < start < 0.5
    assert (payoff(learner) > 0.75) if climbs else (payoff(learner) < 0.55)


# The cheapest arena ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def game():
    """Rock-paper-scissors: the arena, and 8 decisions in each of its worlds, compiled anew for each kind of policy."""
    arena = arenas.settings("rock-paper-scissors").build()
    return arena, make_reset(arena)(jax.random.split(jax.random.key(1), 128)), make_rollout(arena, length=8)


VARIANTS = {
    "happo": {},
    "mappo": {"method": "mappo"},
    "ippo": {"method": "ippo"},
    "hatrpo": {"method": "hatrpo"},
    "target_kl": {"target_kl": 0.02},
    "desired_kl": {"desired_kl": 0.02},
    "decay": {"lr_decay_steps": 20 * 1024},
    "squashed": {"architecture": Architecture((8,), squash=2.0)},
    "state_std": {"architecture": Architecture((8,), state_std=True)},
    "all teams": {"critic_input": "all"},
    "same critic": {"critic_input": "same"},
    "shared": {"share_actors": True},
}


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS.values(), ids=VARIANTS)
def test_every_variant_learns_the_answer_to_rock(variant, game):
    arena, worlds, rollout = game
    worlds = jax.tree.map(lambda x: x.copy(), worlds)  # a rollout uses them up
    config = replace(HappoConfig(Architecture((8,)), lr=0.01), **variant)
    learner = HappoLearner(
        [1], [3], config, seed=0, device="auto", others=[1], critic_size=common_critic_size(arena.teams)
    )
    others = [arena.teams[1]] if config.critic_input == "all" else []
    common = arena.teams if config.critic_input == "same" else []
    rock = stack_policies([list(scripts_for(arena, "chooser")).index("rock")] * 2)
    scores = []
    for iteration in range(20):
        stacks = {"blue/0": stack_policies(to_jax(learner.export()) * 2), "red/0": rock}
        worlds, trajectory = rollout(stacks, worlds, jax.random.key(iteration))
        seen = {"others": others, "common": common}
        learner.learn(team_batch(trajectory, arena.teams[0], 0, slice(None), shaping=0.0, **seen))
        scores.append(rollout_metrics(trajectory, 0, slice(None))["score"])
    assert scores[0] < 0.6
    assert scores[-1] > 0.8


@pytest.mark.slow
def test_a_critic_of_the_whole_state_teaches_a_puck_the_way_to_the_flag():
    """The cheapest arena has no bodies, and so no state to see: this is the cheapest that has."""
    arena = arenas.settings(f"{Path(__file__).parents[2] / 'arenas' / 'race.py'}:race").build(engine="c", threads=1)
    rollout = make_rollout(arena, length=40, privileged=True)
    worlds = make_reset(arena, stagger=False, settle=False)(jax.random.split(jax.random.key(1), 64))
    config = HappoConfig(Architecture((16,)), lr=0.01, critic_lr=0.01, critic_input="privileged")
    learner = HappoLearner([6], [2], config, seed=0, device="auto", critic_size=6 + arena.privileged_size)
    idle = stack_policies([list(scripts_for(arena, "puck")).index("idle")] * 2)
    scores, explained = [], []
    for iteration in range(14):
        stacks = {"blue/0": stack_policies(to_jax(learner.export()) * 2), "red/0": idle}
        worlds, trajectory = rollout(stacks, worlds, jax.random.key(iteration))
        batch = team_batch(trajectory, arena.teams[0], 0, slice(None), shaping=1.0, privileged=True)
        explained.append(learner.learn(batch)["explained_variance"])
        scores.append(rollout_metrics(trajectory, 0, slice(None))["score"])
    assert scores[0] < 0.6
    assert scores[-1] > 0.8
    assert explained[-1] > 0.3


def test_the_order_of_teams_changes_no_teams_update(game, same):
    """Teams share the buffers of one trajectory, and a critic of all teams reads what the others learn from."""
    arena, worlds, rollout = game
    states = []
    for order in ((0, 1), (1, 0)):
        learners = [
            HappoLearner([1], [3], HappoConfig(Architecture((8,)), critic_input="all"), seed, "auto", others=[1])
            for seed in (1, 2)
        ]
        stacks = {
            f"{team}/0": stack_policies(to_jax(learner.export()) * 2)
            for team, learner in zip(("blue", "red"), learners, strict=True)
        }
        _, trajectory = rollout(stacks, jax.tree.map(lambda x: x.copy(), worlds), jax.random.key(0))
        for team in order:
            learners[team].learn(
                team_batch(trajectory, arena.teams[team], team, slice(None), 1.0, others=[arena.teams[1 - team]])
            )
        states.append([learner.save() for learner in learners])
    assert same(*states)
    assert not same(states[0][0], states[0][1])
