"""Metrics of games of three teams: a ranking counts as a game of every pair of teams."""

import jax.numpy as jnp
import numpy as np
import pytest

from agents.rollout.metrics import episode_results, rollout_metrics
from agents.rollout.rollout import Trajectory
from arenas.state import mean_pairwise_score


def played(score, void=(), cut=()) -> Trajectory:
    """One decision in N worlds, which ended their episodes with these scores (N, 3)."""
    score = jnp.array(score, jnp.float32)[None]
    number, zeros = score.shape[1], jnp.zeros_like(score)
    voids, cuts = (jnp.isin(jnp.arange(number), jnp.array(some, int))[None] for some in (void, cut))
    return Trajectory(
        {}, {}, {}, {}, {}, {}, zeros, zeros, score, ~voids, jnp.zeros_like(voids), voids, zeros.astype(bool), cuts,
        jnp.ones((1, number), jnp.int32),
    )  # fmt: skip


def test_results_are_counted_against_each_team_in_each_group_of_worlds():
    score = [[3, 2, 1], [1, 2, 3], [5, 5, 0], [9, 0, 0]]
    found = episode_results(played(score, void=(3,)), 0, groups=2)
    assert found.shape == (2, 3, 4)
    np.testing.assert_array_equal(found[0, 1], [1, 0, 1, 0])  # against red: ahead, then behind
    np.testing.assert_array_equal(found[0, 2], [1, 0, 1, 0])
    np.testing.assert_array_equal(found[1, 1], [0, 1, 0, 1])  # a tie, and a void episode
    np.testing.assert_array_equal(found[1, 2], [1, 0, 0, 1])


def test_a_cut_episode_counts_against_nobody():
    assert episode_results(played([[3, 2, 1]], cut=(0,)), 0, groups=1).sum() == 0


@pytest.mark.parametrize(
    ("team", "score"), [(0, (1 + 0 + 0.75) / 3), (1, (0.5 + 0.5 + 0.75) / 3), (2, (0 + 1 + 0) / 3)]
)
def test_the_curves_score_is_the_mean_against_the_other_teams(team, score):
    figures = rollout_metrics(played([[3, 2, 1], [1, 2, 3], [5, 5, 0]]), team, slice(None))
    assert figures["episodes"] == 3
    assert figures["score"] == pytest.approx(score)


def test_scores_of_one_team_and_of_two_are_kept():
    for score in (np.array([[1.0], [0.0]]), np.array([[1.0, 0.0], [0.5, 0.5]])):
        assert mean_pairwise_score(score) is score


def test_the_mean_over_teams_is_one_half_whatever_the_ties():
    score = np.random.default_rng(0).integers(0, 4, (50, 8))
    np.testing.assert_allclose(mean_pairwise_score(score).mean(1), 0.5)
