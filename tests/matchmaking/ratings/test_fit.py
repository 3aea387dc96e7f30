import math
import random
from itertools import pairwise

import numpy as np
import pytest

from matchmaking.ratings.fit import ELO, fit
from matchmaking.ratings.payoff import sum_matches

NONE = 1e-9  # a prior too weak to be seen


def swapped(match, a, b, wins, draws, losses, pairs=(0, 0, 0, 0, 0)):
    """A match with the same result on either side: no side advantage."""
    return match(a, b, home=(wins, draws, losses), away=(wins, draws, losses), pairs=pairs)


def elo(ratings):
    return dict(zip(ratings.names, ratings.elo.tolist(), strict=True))


def test_two_players_differ_by_the_log_of_their_odds(match):
    ratings = fit(sum_matches([swapped(match, "a", "b", 30, 0, 10)]), prior=NONE)
    assert ratings.elo[0] - ratings.elo[1] == pytest.approx(400 * math.log10(3), abs=1e-4)  # 190.85
    assert ratings.elo.mean() == pytest.approx(1000)
    assert (ratings.draw, ratings.side_advantage) == (0, pytest.approx(0, abs=1e-6))
    assert ratings.score.tolist() == [0.75, 0.25]
    assert ratings.expected("a", "b") == pytest.approx(0.75)


def test_variance_of_two_players_is_the_textbook_one(match):
    # Information of 80 games at p = ¾ is 80 · ¾ · ¼ = 15 in log odds; its inverse is the variance of the difference.
    ratings = fit(sum_matches([swapped(match, "a", "b", 30, 0, 10)]), prior=NONE, anchors=["b"])
    assert ratings.variances()[0, 1] == pytest.approx(ELO**2 / 15, rel=1e-6)
    assert ratings.high[0] - ratings.low[0] == pytest.approx(2 * 1.959964 * ELO / math.sqrt(15), rel=1e-6)
    assert ratings.low[1] == ratings.high[1] == 1000  # the anchor is where the scale is pinned


def test_three_players_whose_odds_agree_are_fitted_exactly(match):
    # Strengths 1 : 2 : 6, so odds are 2 : 1, 3 : 1 and 6 : 1.
    log = [
        swapped(match, "b", "a", 20, 0, 10),
        swapped(match, "c", "b", 30, 0, 10),
        swapped(match, "a", "c", 10, 0, 60),
    ]
    ratings = elo(fit(sum_matches(log), prior=NONE, anchors=["a"], anchor_elo=0))
    assert ratings == pytest.approx({"a": 0, "b": 400 * math.log10(2), "c": 400 * math.log10(6)}, abs=1e-4)


def test_davidsons_draws_by_hand(match):
    # win : draw : loss = π : ν√(πρ) : ρ. With 40 : 20 : 10 the odds are 4, √(4 · 1) = 2 and so ν = 20 / (10 · 2) = 1.
    ratings = fit(sum_matches([swapped(match, "a", "b", 40, 20, 10)]), prior=NONE)
    assert ratings.draw == pytest.approx(1, abs=1e-6)
    assert ratings.elo[0] - ratings.elo[1] == pytest.approx(400 * math.log10(4), abs=1e-4)
    assert ratings.expected("a", "b") == pytest.approx(50 / 70)


def test_side_advantage_by_hand(match):
    # Odds at home g·s = 8, odds away s/g = 2: strength s = 4, advantage of playing team 0 g = 2.
    ratings = fit(sum_matches([match("a", "b", home=(80, 0, 10), away=(60, 0, 30))]), prior=NONE)
    assert ratings.side_advantage == pytest.approx(400 * math.log10(2), abs=1e-4)
    assert ratings.elo[0] - ratings.elo[1] == pytest.approx(400 * math.log10(4), abs=1e-4)
    assert ratings.expected("a", "b") == pytest.approx((8 / 9 + 2 / 3) / 2)


def test_a_side_that_never_changes_is_strength_not_advantage(match):
    ratings = fit(sum_matches([match("blue", "red", home=(30, 0, 10))]), prior=NONE)
    assert ratings.side_advantage == 0
    assert ratings.elo[0] - ratings.elo[1] == pytest.approx(400 * math.log10(3), abs=1e-4)


def test_jeffreys_prior_for_two_who_met_nobody_else(match):
    # One virtual game adds ½ to either count; the 1% against the average hardly shows.
    ratings = fit(sum_matches([swapped(match, "a", "b", 10, 0, 0)]))
    assert ratings.elo[0] - ratings.elo[1] == pytest.approx(400 * math.log10(20.5 / 0.5), rel=0.02)


def test_rock_paper_scissors_is_level(match):
    log = [swapped(match, *names, 90, 5, 5) for names in (("paper", "rock"), ("rock", "shears"), ("shears", "paper"))]
    ratings = fit(sum_matches(log))
    assert ratings.elo == pytest.approx([1000] * 3, abs=1e-6)
    assert ratings.expected_scores() == pytest.approx(np.full((3, 3), 0.5))


def league(simulate, theta, n=24, seed=0, copied=0.0):
    rng = np.random.default_rng(seed)
    pairs = [(i, j) for i in range(len(theta)) for j in range(i)]
    return [simulate(f"{i:02d}", f"{j:02d}", theta[i] - theta[j], n, rng, copied=copied) for i, j in pairs]


def retold(match, m):
    away = (m.wins - m.side_wins, m.draws - m.side_draws, m.losses - m.side_losses)
    return match(m.b, m.a, away[::-1], (m.side_losses, m.side_draws, m.side_wins), m.pairs[::-1])


def test_neither_the_order_of_matches_nor_who_is_a_matters(match, simulate):
    log = league(simulate, np.linspace(-1, 1, 6))
    shuffled = [retold(match, m) if i % 3 else m for i, m in enumerate(random.Random(1).sample(log, len(log)))]
    assert [m.a for m in shuffled] != [m.a for m in log]
    one, other = fit(sum_matches(log)), fit(sum_matches(shuffled))
    for values in ("elo", "low", "high", "covariance", "draw", "side_advantage"):
        assert np.array_equal(getattr(one, values), getattr(other, values)), values


@pytest.mark.parametrize("copied", [0.0, 0.8])
def test_intervals_cover_true_strengths_at_the_nominal_rate(simulate, copied):
    theta = np.linspace(-1.5, 1.5, 6)
    truth, seeds = 1000 + ELO * theta, 120
    fits = [fit(sum_matches(league(simulate, theta, seed=seed, copied=copied))) for seed in range(seeds)]
    covered = np.mean([(r.low < truth) & (truth < r.high) for r in fits])
    assert 0.92 < covered < 0.98
    assert np.mean([r.elo for r in fits], 0) == pytest.approx(truth, abs=15)
    assert np.mean([r.side_advantage for r in fits]) == pytest.approx(ELO * 0.3, abs=5)
    assert np.mean([r.draw for r in fits]) == pytest.approx(0.6, abs=0.03)


def test_intervals_know_that_two_games_of_a_seed_pair_are_not_independent(match):
    def width(pairs):
        ratings = fit(sum_matches([swapped(match, "a", "b", 20, 0, 20, pairs)]))
        return float(ratings.high[0] - ratings.low[0])

    unpaired = width((0, 0, 0, 0, 0))
    assert width((10, 0, 20, 0, 10)) == pytest.approx(unpaired, rel=0.02)  # what independent games would give
    assert width((20, 0, 0, 0, 20)) == pytest.approx(unpaired * math.sqrt(2), rel=0.03)  # one fate: half the games
    assert 0.1 * unpaired < width((0, 0, 40, 0, 0)) < 0.4 * unpaired  # the seed decided which side wins


def test_the_unbeaten_are_finite_and_their_interval_wide(match):
    log = [
        swapped(match, "a", "b", 500, 0, 0, (0, 0, 0, 0, 500)),
        swapped(match, "b", "c", 15, 0, 10),
        swapped(match, "d", "a", 0, 0, 1),
    ]
    ratings = fit(sum_matches(log))
    a, b, c, d = ratings.elo
    assert np.isfinite(ratings.covariance).all()
    assert a - b > 800
    assert a > d
    assert b > c
    widths = np.sqrt(ratings.variances())
    assert widths[0, 1] > 3 * widths[1, 2]


def test_what_never_met_is_finite_and_says_that_it_knows_nothing(match):
    log = [swapped(match, "a", "b", 20, 5, 10), swapped(match, "c", "d", 10, 5, 20)]
    ratings = fit(sum_matches(log, players=["e"]))
    assert np.isfinite(ratings.elo).all()
    assert ratings.elo[[0, 1]].mean() == pytest.approx(ratings.elo[[2, 3]].mean(), abs=1)
    assert math.sqrt(ratings.variances()[0, 2]) > 1000 > 10 * math.sqrt(ratings.variances()[0, 1])
    assert ratings.games.tolist() == [70, 70, 70, 70, 0]
    assert ratings.elo[4] == pytest.approx(1000, abs=1)
    assert np.isnan(ratings.score[4])


def test_a_long_ladder_is_not_squeezed_by_the_prior(match):
    names = [f"{i:02d}" for i in range(30)]
    log = [swapped(match, above, below, 20, 0, 10) for below, above in pairwise(names)]
    ratings = fit(sum_matches(log))
    assert ratings.elo[-1] - ratings.elo[0] == pytest.approx(29 * 400 * math.log10(2), rel=0.05)


def test_only_draws_are_a_draw(match):
    ratings = fit(sum_matches([swapped(match, "a", "b", 0, 50, 0)]))
    assert ratings.elo == pytest.approx([1000, 1000])
    assert 100 < ratings.draw < math.inf


def test_one_side_that_always_wins_is_a_finite_advantage(match):
    ratings = fit(sum_matches([match("a", "b", home=(20, 0, 0), away=(0, 0, 20), pairs=(0, 0, 20, 0, 0))]))
    assert 400 < ratings.side_advantage < 4000
    assert ratings.elo == pytest.approx([1000, 1000])


def test_nobody_and_one_alone_can_be_rated():
    assert fit(sum_matches([])).elo.shape == (0,)
    assert fit(sum_matches([], players=["a"])).elo == pytest.approx([1000])


def test_anchors_pin_the_scale(match, simulate):
    payoff = sum_matches(league(simulate, np.linspace(-1, 1, 5)))
    free, pinned = fit(payoff), fit(payoff, anchors=["00", "02"], anchor_elo=1500)
    assert pinned.elo[[0, 2]].mean() == pytest.approx(1500)
    assert np.diff(pinned.elo) == pytest.approx(np.diff(free.elo))
    assert pinned.variances() == pytest.approx(free.variances(), abs=1e-6)


def test_superiority_is_the_chance_that_the_difference_is_positive(match):
    ratings = fit(sum_matches([swapped(match, "a", "b", 30, 0, 10)]), prior=NONE)
    z = math.log(3) * math.sqrt(15)  # difference over its deviation, in log odds
    assert ratings.likelihood_of_superiority("a", "b") == pytest.approx(
        0.5 * (1 + math.erf(z / math.sqrt(2))), rel=1e-6
    )
    assert ratings.likelihood_of_superiority("b", "a") == pytest.approx(0.5 * math.erfc(z / math.sqrt(2)), rel=1e-3)
    assert ratings.likelihood_of_superiority("a", "a") == 0.5


@pytest.mark.parametrize(
    ("wrong", "says"), [({"prior": -1}, "a positive number"), ({"anchors": ["z"]}, "'z' is not among")]
)
def test_impossible_requests_are_refused(match, wrong, says):
    with pytest.raises(ValueError, match=says):
        fit(sum_matches([swapped(match, "a", "b", 1, 0, 1)]), **wrong)
