"""Tables with what games leave open, and the intervals of mixtures."""

from dataclasses import replace

import numpy as np
import pytest

from matchmaking.metagame.alpharank import alpharank
from matchmaking.metagame.mixtures import PayoffPosterior, mixture_interval
from matchmaking.metagame.nash import nash
from matchmaking.ratings.fit import fit
from matchmaking.ratings.payoff import sum_matches
from tests.matchmaking.ratings.test_seed_clusters import drawn, rotations


def evidence(log, names):
    payoff = sum_matches(log)
    return PayoffPosterior.of(payoff, fit(payoff, prior=1.0), names)


def line(match, n=40):
    """Four players, each of whom beats the next by 3 to 1; no others have met."""
    return [match(a, b, home=(3 * n // 2, 0, n // 2), away=(3 * n // 2, 0, n // 2)) for a, b in ("ab", "bc", "cd")]


def test_pairs_that_have_not_met_get_the_score_that_ratings_expect(match):
    found = evidence(line(match), "dcba")  # in another order than the payoff has
    payoff = sum_matches(line(match))
    ratings = fit(payoff, prior=1.0)
    assert np.isnan(found.scores).sum() == 6
    table = found.completed()
    assert table[2, 3] == pytest.approx(0.25)  # b against a: as played
    assert table[0, 3] == pytest.approx(ratings.expected("d", "a"))
    assert table[0, 3] < 0.1
    assert table + table.T == pytest.approx(np.ones((4, 4)))
    assert np.diag(table).tolist() == [0.5] * 4


def test_drawn_scores_have_the_posterior_of_their_games_and_of_the_fit(match):
    found = evidence([*line(match), match("a", "x", home=(3, 0, 0), away=(2, 0, 0))], "abcdx")
    tables = np.array(list(found.sample_tables(4000)))
    assert tables + tables.transpose(0, 2, 1) == pytest.approx(np.ones(tables.shape))
    beta = (120 + 0.5) / (160 + 1)
    assert tables[:, 0, 1].mean() == pytest.approx(beta, abs=0.002)
    assert tables[:, 0, 1].var() == pytest.approx(beta * (1 - beta) / 162, rel=0.1)
    assert tables[:, 0, 1].var() == pytest.approx(found.variances()[0, 1], rel=0.1)
    # Five games that were all won leave open what a beta law of half a game beside them leaves open.
    assert tables[:, 0, 4].mean() == pytest.approx(5.5 / 6, abs=0.01)
    # The unmet pair a, d: its log odds vary as the difference of the two strengths does.
    gap = np.log10(tables[:, 0, 3] / tables[:, 3, 0]) * 400
    variance = np.array([1, -1]) @ found.covariance[np.ix_([0, 3], [0, 3])] @ np.array([1, -1])
    assert gap.mean() == pytest.approx(found.strength[0] - found.strength[3], abs=5)
    assert gap.var() == pytest.approx(variance, rel=0.1)
    again = np.array(list(found.sample_tables(3)))
    assert (again == tables[:3]).all()


def test_draws_and_seed_pairs_count_in_what_is_drawn(match):
    sample_tables = evidence([match("a", "b", home=(0, 50, 0), away=(0, 50, 0))], "ab")
    decided = evidence([match("a", "b", home=(25, 0, 25), away=(25, 0, 25))], "ab")
    assert sample_tables.variances()[0, 1] < decided.variances()[0, 1] / 5
    one_fate = evidence([match("a", "b", home=(25, 0, 25), away=(25, 0, 25), pairs=(25, 0, 0, 0, 25))], "ab")
    assert one_fate.variances()[0, 1] > 1.7 * decided.variances()[0, 1]


@pytest.mark.parametrize("solve", [nash, alpharank])
def test_a_mixtures_interval_shrinks_with_the_games_to_the_mixture(match, solve):
    """Biased rock, paper, scissors: the more games, the narrower."""
    widths = []
    for n in (20, 2000):
        half = n // 20
        log = [
            match("paper", "rock", home=(8 * half, 0, 2 * half), away=(8 * half, 0, 2 * half)),
            match("scissors", "paper", home=(7 * half, 0, 3 * half), away=(7 * half, 0, 3 * half)),
            match("rock", "scissors", home=(9 * half, 0, half), away=(9 * half, 0, half)),
        ]
        found = evidence(log, ["rock", "paper", "scissors"])
        bounds, mass = mixture_interval(solve, found.sample_tables(100)), solve(found.completed()).mass
        assert (bounds.low - 1e-9 <= mass).all()
        assert (mass <= bounds.high + 1e-9).all()
        assert bounds.mean.sum() == pytest.approx(1)
        assert bounds.value[0] == pytest.approx(0.5)
        widths.append((bounds.high - bounds.low).max())
    assert widths[1] < widths[0] / 4 or (solve is alpharank and widths[1] < 1e-3)


def test_rotations_that_share_their_seeds_tell_as_much_as_their_seeds():
    log = rotations("abc", drawn(np.random.default_rng(0), 60, copies=True))
    once, thrice = evidence([replace(log[0], seed_clusters={})], "abc"), evidence(log, "abc")
    assert thrice.effective == pytest.approx(once.effective)
    assert thrice.scores == pytest.approx(once.scores, nan_ok=True)
    assert (thrice.effective[0, 1:] > 30).all()
