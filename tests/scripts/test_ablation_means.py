"""Means of variants over seeds, and their intervals when seeds are drawn again."""

import pytest

from experiments.ablations import of_variants, seeds_drawn_again


def test_the_interval_counts_seeds_and_not_games():
    scores = {(a, b): [0.5 + 0.1 * (int(a) - 2)] for a in "123" for b in "123"}
    found = seeds_drawn_again(scores)
    # The mean of three draws of 0.4, 0.5 and 0.6 is 0.4 in one of 27 cases, so more often than in 2.5 %.
    assert found == {"low": pytest.approx(0.4), "high": pytest.approx(0.6)}


@pytest.mark.parametrize("scores", [{("1", "1"): [0.5]}, {("1", "2"): [0.5], ("2", "1"): [0.5]}])
def test_there_is_no_interval_of_one_seed_or_of_a_variant_against_itself(scores):
    assert seeds_drawn_again(scores) == {}


def test_each_variant_has_its_mean_against_each_other():
    whose = {f"{variant}-{seed}": (variant, seed, "rovers") for variant in ("new", "old") for seed in "12"}
    table = [
        {"a": "new-1", "b": "old-1", "score": 0.75}, {"a": "new-1", "b": "old-2", "score": 0.75},
        {"a": "new-2", "b": "old-1", "score": 0.75}, {"a": "new-2", "b": "old-2", "score": 0.75},
        {"a": "new-1", "b": "new-2", "score": 0.625},
    ]  # fmt: skip
    found = of_variants(table, whose)
    assert found["new against old"] == {
        "median": 0.75, "min": 0.75, "max": 0.75, "mean": 0.75, "pairs": 4, "low": 0.75, "high": 0.75,
    }  # fmt: skip
    assert found["old against new"]["mean"] == 0.25
    assert found["new against new"] == {"median": 0.5, "min": 0.375, "max": 0.625, "mean": 0.5, "pairs": 2}
