"""The whole loop: rollouts in JAX, HAPPO in torch, matches in JAX."""

import jax
import jax.numpy as jnp
import numpy as np

import arenas
from agents.bridge import team_batch, to_jax
from agents.happo import HappoConfig, Learner
from agents.policy import stack
from agents.rollout import make_play, make_reset, make_rollout


def test_two_teams_learn_to_beat_what_they_were():
    arena = arenas.settings("sumo-1v1").build(engine="c")
    learners = [Learner([20], [2], HappoConfig(), seed) for seed in (1, 2)]
    initial = [policy for learner in learners for policy in to_jax(learner.policies())]
    worlds = make_reset(arena)(jax.random.split(jax.random.key(1), 128))
    rollout = make_rollout(arena, length=32)

    present = initial
    for iteration in range(9):
        policies = {f"{team}/0": stack([policy]) for team, policy in zip(("blue", "red"), present, strict=True)}
        worlds, trajectory = rollout(policies, worlds, jax.random.key(iteration))
        for index, (learner, team) in enumerate(zip(learners, arena.teams, strict=True)):
            diagnostics = learner.update(team_batch(trajectory, team, index, slice(None), shaping=1.0))
            assert np.isfinite(list(diagnostics.values())).all()
        present = [policy for learner in learners for policy in to_jax(learner.policies())]

    # Both sides of each of 128 starts: the new blue against the first red, then the first blue against the new red.
    seats = {"blue/0": stack([present[0], initial[0]]), "red/0": stack([initial[1], present[1]])}
    games = make_play(arena)(seats, jnp.tile(jax.random.split(jax.random.key(7), 128), 2))
    score = float((games.score[:128, 0].mean() + games.score[128:, 1].mean()) / 2)
    assert score > 0.75, f"{score:.3f}: half is no better than before, 256 episodes err by 0.03"
