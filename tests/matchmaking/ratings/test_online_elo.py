import math

import pytest

from matchmaking.ratings.online_elo import START, K, online_elo


def test_one_game_moves_both_by_the_formula(match):
    elo = online_elo([match("a", "b", home=(1, 0, 0))])
    assert elo == pytest.approx({"a": START + K / 2, "b": START - K / 2})
    again = online_elo([match("a", "b", home=(1, 0, 0)), match("b", "a", home=(0, 1, 0))])
    expected = 1 / (1 + 10 ** (-K / 400))
    assert again["a"] == pytest.approx(START + K / 2 + K * (0.5 - expected))
    assert again["a"] + again["b"] == pytest.approx(2 * START)


def test_many_games_end_where_the_score_is_what_is_expected(match):
    elo = online_elo([match("a", "b", home=(3000, 0, 1000))])
    assert elo["a"] - elo["b"] == pytest.approx(400 * math.log10(3), abs=1e-6)


def test_a_snapshot_begins_where_its_parent_is_then(match):
    log = [match("a@1", "b", home=(60, 0, 4)), match("a@2", "b", home=(0, 0, 1)), match("c", "c", home=(9, 0, 0))]
    before, after = online_elo(log[:1]), online_elo(log, {"a@2": "a@1"})
    assert after["a@1"] == before["a@1"]
    assert before["a@1"] - K < after["a@2"] < before["a@1"]
    assert "c" not in after  # games against oneself, and those of one team, say nothing
    assert online_elo([match("a", None, home=(5, 0, 0))]) == {}


def test_it_depends_on_the_order_and_a_fit_does_not(match):
    log = [match("a", "b", home=(20, 0, 0)), match("b", "c", home=(20, 0, 0)), match("c", "a", home=(20, 0, 0))]
    assert online_elo(log)["a"] != pytest.approx(online_elo(log[::-1])["a"], abs=1)
