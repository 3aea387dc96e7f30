"""The whole loop: rollouts in JAX, HAPPO in torch, matches in JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from agents.bridge import team_batch, to_jax
from agents.learner.happo import HappoLearner
from agents.policy.jax_policy import stack_policies
from agents.rollout.metrics import rollout_metrics
from agents.rollout.new_worlds import make_reset
from agents.rollout.rollout import make_play, make_rollout, scripts_for
from agents.settings import Architecture, HappoConfig


@pytest.mark.slow
def test_two_teams_learn_to_beat_what_they_were():
    arena = arenas.settings("sumo-1v1").build(engine="c")
    learners = [HappoLearner([20], [2], HappoConfig(), seed, device="auto") for seed in (1, 2)]
    initial = [policy for learner in learners for policy in to_jax(learner.export())]
    worlds = make_reset(arena)(jax.random.split(jax.random.key(1), 128))
    rollout = make_rollout(arena, length=32)

    present = initial
    for iteration in range(9):
        stacks = {f"{team}/0": stack_policies([policy]) for team, policy in zip(("blue", "red"), present, strict=True)}
        worlds, trajectory = rollout(stacks, worlds, jax.random.key(iteration))
        for index, (learner, team) in enumerate(zip(learners, arena.teams, strict=True)):
            diagnostics = learner.learn(team_batch(trajectory, team, index, slice(None), shaping=1.0))
            assert np.isfinite(list(diagnostics.values())).all()
        present = [policy for learner in learners for policy in to_jax(learner.export())]

    # Both sides of each of 128 starts: the new blue against the first red, then the first blue against the new red.
    seats = {"blue/0": stack_policies([present[0], initial[0]]), "red/0": stack_policies([initial[1], present[1]])}
    games = make_play(arena)(seats, jnp.tile(jax.random.split(jax.random.key(7), 128), 2))
    score = float((games.score[:128, 0].mean() + games.score[128:, 1].mean()) / 2)
    assert score > 0.75, f"{score:.3f}: half is no better than before, 256 episodes err by 0.03"


def test_a_team_finds_the_answer_to_whom_it_meets_in_a_game_without_bodies():
    """Rock-paper-scissors against rock in every world: paper. It reads nothing but a constant."""
    arena = arenas.settings("rock-paper-scissors").build()
    scripts = list(scripts_for(arena, "chooser"))
    learner = HappoLearner([1], [3], HappoConfig(Architecture((8,)), lr=0.01), seed=0, device="auto")
    worlds, rollout = make_reset(arena)(jax.random.split(jax.random.key(1), 128)), make_rollout(arena, length=8)
    rock = stack_policies([scripts.index("rock")] * 2)
    scores = []
    for iteration in range(12):
        stacks = {"blue/0": stack_policies(to_jax(learner.export()) * 2), "red/0": rock}
        worlds, trajectory = rollout(stacks, worlds, jax.random.key(iteration))
        learner.learn(team_batch(trajectory, arena.teams[0], 0, slice(None), shaping=0.0))
        scores.append(rollout_metrics(trajectory, 0, slice(None))["score"])
    assert abs(scores[0] - 0.5) < 0.1
    assert scores[-1] > 0.8

    met = stack_policies([scripts.index(name) for name in ("rock", "paper", "scissors")])
    games = make_play(arena)(
        {"blue/0": stack_policies(to_jax(learner.export()) * 3), "red/0": met},
        jax.random.split(jax.random.key(7), 300),
    )
    by_opponent = np.asarray(games.score[:, 0]).reshape(3, 100).mean(axis=1)
    assert by_opponent[0] > 0.8  # paper beats rock, draws with paper and loses to scissors
    assert abs(by_opponent[1] - 0.5) < 0.2
    assert by_opponent[2] < 0.3
