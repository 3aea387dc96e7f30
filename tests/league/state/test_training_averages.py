"""Averages over the newest iterations of training: they decide when a stage ends, and when trials of it begin."""

import pytest

from league.state.league_state import LeagueState
from league.state.recent_curves import ENOUGH
from storage.records import CurvePoint
from tests.league.leagues import filled, finish


@pytest.fixture
def averages(tmp_path):
    """Averages of blue over its newest iterations, which had these numbers of episodes and scores; 4 are done."""

    def read(recent, *iterations):
        with filled(tmp_path / "league-data") as store:
            points = [
                CurvePoint("cup", "blue", i, 100 * i, float(i), {"reward": 0.5, "episodes": float(n)} | told)
                for i, (n, told) in enumerate(iterations, 5 - len(iterations))
            ]
            finish(store, curves=points)
            state = LeagueState.of(store, "cup", recent=recent)
        return state.rewards, state.successes

    return read


def ended(episodes, score):
    return episodes, {"length": 10.0, "score": score}


def test_success_is_the_share_of_episodes_and_not_of_iterations(averages):
    rewards, successes = averages(2, ended(1000, 0.0), ended(300, 1.0), ended(100, 0.0))
    assert rewards == {"blue": 5.0}
    assert successes == {"blue": 0.75}


def test_few_episodes_say_nothing(averages):
    assert averages(2, ended(ENOUGH - 2, 1.0), ended(1, 1.0)) == ({"blue": 5.0}, {})


def test_iterations_without_an_ended_episode_are_left_out_of_it(averages):
    assert averages(3, ended(ENOUGH, 0.5), (0, {}), (0, {})) == ({"blue": 5.0}, {"blue": 0.5})


def test_there_are_none_before_so_many_iterations_or_if_none_are_asked_for(averages):
    assert averages(3, ended(ENOUGH, 1.0), ended(ENOUGH, 1.0)) == ({}, {})


def test_without_a_number_of_iterations_nothing_is_read(averages):
    assert averages(0, ended(ENOUGH, 1.0)) == ({}, {})
