import math

import numpy as np
import pytest

from matchmaking import ladder as module
from matchmaking.ladder import Ladder
from matchmaking.payoff import score_interval, tally
from matchmaking.ratings import fit


def test_a_ladder_says_what_payoff_and_fit_say(match):
    log = [match("a", "b", home=(9, 2, 5), away=(7, 1, 8)), match("c", "b", home=(3, 0, 5), away=(1, 2, 5))]
    ladder, payoff = Ladder(["a", "b", "c"], log, anchors=["b"]), tally(log)
    assert ladder.arena == log[0].arena
    assert ladder.score("a", "b", "c") == payoff.score("a", "b", "c")
    assert np.array_equal(ladder.ratings.elo, fit(payoff, anchors=["b"]).elo)
    assert ladder.ratings.elo[1] == 1000
    assert not ladder.one_team


def test_it_is_fitted_once_and_again_only_when_the_log_grew(match, monkeypatch):
    fits = []
    monkeypatch.setattr(module, "fit", lambda *args, **named: fits.append(1) or fit(*args, **named))
    log = [match("a", "b", home=(3, 0, 1), away=(2, 0, 2))]
    ladder = Ladder(["a", "b"], log)
    assert fits == []
    for _ in range(3):
        assert ladder.known("a")
        ladder.ratings.expected("a", "b")
        ladder = ladder.extended([], ["b", "a"])
    assert len(fits) == 1
    more = ladder.extended([match("b", "c", home=(1, 0, 1), away=(1, 0, 1))], ["d"])
    assert more.names == ("a", "b", "c", "d")
    assert more.ratings.elo.shape == (4,)
    assert len(fits) == 2
    assert ladder.names == ("a", "b")


def test_an_anchor_that_has_not_played_blurs_nobody(match):
    log = [match("a", "b", home=(30, 0, 20), away=(25, 0, 25))]
    both, one = Ladder(["b"], log, anchors=["b", "new"]), Ladder(["b", "new"], log, anchors=["b"])
    assert both.ratings.low == pytest.approx(one.ratings.low)
    assert both.known("a")
    assert not both.known("new")


def test_a_rating_is_known_once_its_interval_is_narrow_enough(match):
    few = Ladder(["a", "b", "x"], [match("a", "b", home=(1, 0, 0)), match("x", "y", home=(9, 0, 9), away=(9, 0, 9))])
    assert not few.known("a")  # one game, and it never met x or y
    # Two halves of a league that never met: the fit puts both at the average, and does not claim to know it.
    assert not few.known("x")
    joined = few.extended([match("a", "x", home=(9, 0, 9), away=(9, 0, 9))])
    assert joined.known("a")
    assert joined.known("x")


def test_success_of_one_team_has_wilsons_interval(match):
    ladder = Ladder(["a", "b"], [match("a", None, home=(6, 2, 2), voids=1), match("a", None, home=(2, 0, 0))])
    success = ladder.success("a")
    assert (success.score, success.games) == (8 / 12, 12)
    assert (success.low, success.high) == pytest.approx(score_interval(8, 0, 4))
    assert (ladder.tried("a"), ladder.tried("b"), ladder.one_team) == (13, 0, True)
    assert math.isnan(ladder.success("b").score)
    assert ladder.success("b")[1:] == (0, 1, 0)


def test_voids_are_told_apart_by_whose_robots_broke(match):
    log = [
        match("a", "b", home=(4, 0, 4), away=(4, 0, 2), voids=6, blame=(3, 1)),
        match("c", "a", home=(1, 0, 1), away=(2, 0, 1), voids=5, blame=(4, 1)),
    ]
    ladder = Ladder(["a", "z"], log)
    assert ladder.void_rate("a") == pytest.approx((4 / 30, 2 / 30, 30))
    assert ladder.void_rate("b") == pytest.approx((1 / 20, 2 / 20, 20))
    assert ladder.void_rate("c") == pytest.approx((4 / 10, 0, 10))
    assert ladder.void_rate("a").suspect == pytest.approx(0.2)
    assert ladder.void_rate("z") == (0, 0, 0)
    alone = Ladder(["a"], [match("a", None, home=(5, 0, 0), voids=5, blame=(2, 0))])
    assert alone.void_rate("a") == pytest.approx((0.2, 0.3, 10))


def test_an_empty_ladder_can_be_asked(match):
    assert Ladder([]).ratings.elo.shape == (0,)
    empty = Ladder(["a"])
    assert (empty.arena, empty.known("a"), empty.one_team) == (None, False, False)
