import numpy as np
import pytest

from matchmaking.opponents import Opponents, delta_uniform, draw, latest, prioritized, uniform
from matchmaking.roles import MAIN


def test_latest_and_uniform():
    assert latest(3).tolist() == [0, 0, 1]
    assert uniform(4).tolist() == [0.25] * 4


@pytest.mark.parametrize(
    ("n", "delta", "first"), [(4, 0, 0), (4, 0.5, 2), (5, 0.5, 3), (30, 0.1, 3), (50, 0.14, 7), (4, 1, 3), (1, 1, 0)]
)
def test_delta_uniform_starts_at_the_share_left_out(n, delta, first):
    weights = delta_uniform(n, delta)
    assert np.flatnonzero(weights).tolist() == list(range(first, n))
    assert weights[first:] == pytest.approx(np.full(n - first, 1 / (n - first)))


def test_prioritized_looks_hard_at_the_strong():
    assert prioritized(np.array([1.0, 0.5, 0.0]), hardness=2) == pytest.approx([0, 0.2, 0.8])
    assert prioritized(np.array([np.nan, 0.5])) == pytest.approx([0.5, 0.5])
    assert prioritized(np.array([0.1, 0.9]), hardness=0) == pytest.approx([0.5, 0.5])


def test_prioritized_is_uniform_over_those_who_are_always_beaten():
    assert prioritized(np.ones(4)) == pytest.approx([0.25] * 4)


def test_draw_follows_the_weights_and_the_generator():
    weights = np.array([0.0, 0.25, 0.75])
    drawn = draw(weights, 4000, np.random.default_rng(0))
    assert np.bincount(drawn, minlength=3) / 4000 == pytest.approx(weights, abs=0.03)
    assert drawn.tolist() == draw(weights, 4000, np.random.default_rng(0)).tolist()


def test_the_configuration_picks_the_weights():
    assert Opponents().weights(3).tolist() == [0, 0, 1]
    assert Opponents("uniform", past=0.2).weights(2).tolist() == [0.5, 0.5]
    assert Opponents("delta_uniform", past=0.2, delta=0.5).weights(4).tolist() == [0, 0, 0.5, 0.5]
    chosen = Opponents("prioritized", past=0.2)
    assert chosen.weights(2, np.array([0.0, 1.0])).tolist() == [1, 0]
    assert chosen.weights(2).tolist() == [0.5, 0.5]


@pytest.mark.parametrize("groups", [2, 3, 8, 10])
@pytest.mark.parametrize("past", [0.0, 0.01, 0.2, 0.5, 0.8, 0.99, 1.0])
def test_the_groups_follow_the_share_to_within_one_of_them(past, groups):
    opponents = Opponents(past=past, groups=groups)
    split = opponents.split()
    assert opponents.true_share == split.past / sum(split)
    assert abs(opponents.true_share - past) <= 1 / groups
    assert (split.past > 0) == (past > 0)
    assert (split.present > 0) == (past < 1)
    assert sum(split) == groups or split == (1, 0)


def test_a_large_share_of_few_groups_leaves_a_present_one():
    # Until this was a share of all groups, past = 0.8 with one past group gave 100 %.
    assert Opponents("uniform", past=0.8, groups=5).split() == (1, 4)
    assert Opponents("uniform", past=0.8, groups=2).split() == (1, 1)
    assert Opponents("uniform", past=1.0, groups=3).split() == (0, 3)
    assert Opponents().split() == (1, 0)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"kind": "newest"}, "choose one of latest, uniform, delta_uniform, prioritized"),
        ({"past": 1.5}, "between 0 and 1"),
        ({"kind": "delta_uniform", "past": 0.5, "delta": -0.1}, "between 0 and 1"),
        ({"groups": 0}, "1 or more"),
        ({"kind": "uniform", "past": 0.5, "groups": 1}, "2 or more, for present and past"),
        ({"kind": "uniform", "past": 0.2, "delta": 0.5}, "use kind = 'delta_uniform'"),
        ({"kind": "uniform"}, "give past > 0"),
    ],
)
def test_settings_that_cannot_be_meant_are_refused(fields, says):
    with pytest.raises(ValueError, match=says):
        Opponents(**fields)


def test_impossible_arguments_are_refused():
    with pytest.raises(ValueError, match="0 snapshots"):
        Opponents("prioritized", past=0.5).weights(0)
    with pytest.raises(ValueError, match="delta is 2"):
        delta_uniform(3, 2)
    with pytest.raises(ValueError, match="scores between 0 and 1"):
        prioritized(np.array([0.5, 1.5]))


def test_a_main_player_meets_the_present_main_players():
    assert MAIN.meets == (MAIN.name,)
    assert MAIN.opponents.past == 0
