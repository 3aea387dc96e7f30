"""Means of scores against several opponents, and whether their intervals hold the truth."""

import numpy as np
import pytest

from matchmaking.ratings.payoff import sum_matches
from matchmaking.ratings.scores import mean_interval


def test_each_opponent_has_the_same_weight_in_a_mean_however_many_games_it_has(match):
    log = [
        match("a", "b", home=(50, 0, 0), away=(50, 0, 0)),
        match("a", "c", home=(150, 0, 150), away=(150, 0, 150), voids=7),
        match("a", "d", home=(0, 0, 0), away=(0, 0, 0), voids=5),
    ]
    payoff = sum_matches(log, ["e"])
    found = payoff.mean_score("a", "b", "c", "c", "d", "e")
    assert found.score == pytest.approx(0.75)
    assert (found.games, found.voids) == (700, 12)
    assert 0.70 < found.low < 0.71 < 0.79 < found.high < 0.80  # by b's 100 games
    assert payoff.mean_score("a", "c") == payoff.score("a", "c")
    for nobody in ((), ("e",), ("d",)):
        assert payoff.mean_score("a", *nobody)[1:] == payoff.score("a", *nobody)[1:]
    assert payoff.mean_score("b", "a").high == payoff.score("b", "a").high


@pytest.mark.parametrize("truths", [(0.5, 0.5), (0.97, 0.3), (0.99, 0.95, 0.6), (0.9,) * 6, (0.98,) * 8, (0.1,) * 6])
@pytest.mark.parametrize("games", [(128, 128), (100, 600)])
def test_the_interval_of_a_mean_holds_the_truth_as_often_as_it_says(truths, games):
    n, none = np.resize(games, len(truths)), np.zeros(len(truths))
    won = np.random.default_rng(3).binomial(n, truths, (2000, len(truths)))
    found = [mean_interval(wins, none, n - wins, np.zeros((len(n), 5))) for wins in won]
    assert np.mean([low > np.mean(truths) for _, low, _ in found]) < 0.04
    assert np.mean([high < np.mean(truths) for *_, high in found]) < 0.04
