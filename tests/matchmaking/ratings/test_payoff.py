import math
from dataclasses import replace

import numpy as np
import pytest

from matchmaking.ratings.payoff import sum_matches
from matchmaking.ratings.scores import score_interval


def test_counts_are_seen_from_both_sides(match):
    # b beat a 5:2 with 3 draws as A; a (as A) then won 4:1. Sides are kept apart: a's home games are b's away games.
    payoff = sum_matches([match("b", "a", home=(3, 2, 1), away=(2, 1, 1)), match("a", "b", home=(4, 0, 1))])
    a, b = payoff.index("a"), payoff.index("b")
    assert payoff.names == ("a", "b")
    assert (payoff.wins[a, b], payoff.draws[a, b], payoff.losses[a, b]) == (6, 3, 6)
    assert (payoff.wins[b, a], payoff.draws[b, a], payoff.losses[b, a]) == (6, 3, 6)
    assert payoff.home.tolist() == [[1 + 4, 1, 2 + 1]]
    assert payoff.away.tolist() == [[1, 2, 3]]
    assert payoff.scores()[a, b] == 0.5
    assert np.isnan(payoff.scores()[a, a])


def test_a_match_told_from_the_other_side_is_the_same_match(match):
    told = sum_matches([match("a", "b", home=(5, 1, 2), away=(3, 0, 5), pairs=(1, 2, 3, 0, 1), voids=4, blame=(3, 1))])
    retold = sum_matches(
        [match("b", "a", home=(5, 0, 3), away=(2, 1, 5), pairs=(1, 0, 3, 2, 1), voids=4, blame=(1, 3))]
    )
    for counts in ("names", "first", "second", "home", "away", "pairs", "voids", "at_fault"):
        assert np.array_equal(getattr(told, counts), getattr(retold, counts)), counts


def test_pairs_of_the_score_turn_with_the_viewpoint(match):
    payoff = sum_matches([match("a", "b", home=(6, 0, 2), away=(5, 0, 3), pairs=(0, 0, 5, 0, 3))])
    ours, theirs = payoff.score("a", "b"), payoff.score("b", "a")
    assert ours.score == 11 / 16
    assert ours.games == theirs.games == 16
    assert (theirs.score, theirs.low, theirs.high) == pytest.approx((1 - ours.score, 1 - ours.high, 1 - ours.low))


def test_listed_players_have_a_place_and_selfplay_is_left_out(match):
    payoff = sum_matches([match("c", "c", home=(9, 2, 3)), match("a", "c", home=(1, 0, 0), voids=2)], players=["b"])
    assert payoff.names == ("a", "b", "c")
    assert payoff.games.tolist() == [[0, 0, 1], [0, 0, 0], [1, 0, 0]]
    assert payoff.episodes[0, 2] == 3
    assert payoff.score("a", "b")[1:] == (0, 1, 0, 0)


def test_a_score_is_pooled_over_several_opponents_seed_pairs_included(match):
    log = [
        match("b", "a", home=(6, 0, 2), away=(5, 0, 3), pairs=(0, 0, 5, 0, 3)),
        match("b", "c", home=(2, 4, 2), away=(1, 1, 6), pairs=(1, 3, 2, 2, 0)),
        match("c", "a", home=(8, 0, 0), away=(8, 0, 0), pairs=(0, 0, 0, 0, 8)),
    ]
    payoff = sum_matches(log)
    pooled = payoff.score("b", "a", "c")
    assert pooled.score == (11 + 3 + 5 / 2) / 32
    assert (pooled.low, pooled.high) == pytest.approx(score_interval(14, 5, 13, np.array([1, 3, 7, 2, 3])))
    assert payoff.score("b", "c", "a", "c") == pooled
    assert payoff.score("b").games == 0


def test_trials_of_one_team_are_no_pairs(match):
    log = [match("a", None, home=(5, 1, 2), voids=3, blame=(2, 0)), match("b", None, home=(1, 0, 0))]
    payoff = sum_matches([*log, log[0]], players=["c"])
    assert payoff.trials.tolist() == [[10, 6, 6, 4], [1, 0, 0, 0], [0, 0, 0, 0]]
    assert not payoff.games.any()


def test_a_log_summed_in_parts_is_the_log_summed_at_once(match, simulate):
    rng = np.random.default_rng(0)
    log = [simulate(a, b, 0.3, 8, rng) for a, b in (("m", "k"), ("k", "z"), ("a", "z"), ("z", "m"), ("m", "k"))]
    log += [match("k", None, home=(1, 0, 2)), match("b", "m", voids=3, blame=(1, 1))]
    for cut in range(len(log) + 1):
        before = sum_matches(log[:cut], players=["c"])
        assert before.arena == (log[0].arena if cut else None)
        parts, whole = sum_matches(log[cut:], players=["d"], onto=before), sum_matches(log, players=["c", "d"])
        for name in ("names", "first", "second", "home", "away", "pairs", "voids", "at_fault", "trials", "arena"):
            assert np.array_equal(getattr(parts, name), getattr(whole, name)), name
    with pytest.raises(ValueError, match="2 arenas"):
        sum_matches([replace(log[0], arena=log[0].arena._replace(engine="warp"))], onto=before)


def test_an_empty_log_is_an_empty_payoff():
    assert sum_matches([]).games.shape == (0, 0)


def test_matches_of_two_arenas_are_refused(match):
    sumo = match("a", "b", home=(1, 0, 0))
    with pytest.raises(ValueError, match="2 arenas cannot be compared"):
        sum_matches([sumo, replace(sumo, arena=sumo.arena._replace(engine="warp"))])


@pytest.mark.parametrize(
    "wrong", [{"side_wins": 3}, {"voids": -1}, {"pairs": (0, 0, 2, 0, 0)}, {"voids_b": 1}, {"voids": 2, "voids_a": -1}]
)
def test_counts_that_contradict_each_other_are_refused(match, wrong):
    with pytest.raises(ValueError, match="contradicts itself"):
        sum_matches([replace(match("a", "b", home=(1, 0, 0), away=(1, 0, 1)), **wrong)])


def test_an_unknown_snapshot_is_named(match):
    with pytest.raises(ValueError, match="'z' is not among the 2"):
        sum_matches([match("a", "b", home=(1, 0, 0))]).score("a", "z")


def test_without_draws_or_pairs_the_interval_is_wilsons():
    # 8 of 10 at 95%: the standard worked example, (0.4902, 0.9433).
    assert score_interval(8, 0, 2) == pytest.approx((0.49016, 0.94332), abs=1e-5)
    assert score_interval(0, 0, 10)[1] == pytest.approx(1.95996**2 / (10 + 1.95996**2), abs=1e-5)


def test_interval_follows_the_variance_that_was_seen():
    def width(*counts):
        low, high = score_interval(*counts)
        return float(high - low)

    decisive, drawn = width(50, 0, 50), width(0, 100, 0)
    fair = width(50, 0, 50, [12, 0, 26, 0, 12])  # close to what 50 independent pairs would give
    assert fair == pytest.approx(decisive, rel=0.05)
    assert width(50, 0, 50, [0, 0, 50, 0, 0]) < 0.5 * fair < fair < width(50, 0, 50, [25, 0, 0, 0, 25])
    assert 0 < drawn < 0.5 * decisive
    assert width(100, 0, 0, [0, 0, 0, 0, 50]) == pytest.approx(width(50, 0, 0))  # pairs may have had one fate each
    assert score_interval(0, 0, 0) == (0, 1)


def test_interval_covers_the_truth(simulate):
    hits, seeds = 0, 400
    for seed in range(seeds):
        m = simulate("a", "b", 0.0, 32, np.random.default_rng(seed), copied=0.7)
        low, high = score_interval(m.wins, m.draws, m.losses, m.pairs)
        hits += low < 0.5 < high
    assert 0.92 < hits / seeds < 0.98


def test_interval_takes_arrays():
    low, high = score_interval(np.array([8, 0]), np.array([0, 0]), np.array([2, 0]))
    assert low == pytest.approx([0.49016, 0], abs=1e-5)
    assert high == pytest.approx([0.94332, 1], abs=1e-5)


def test_a_confidence_in_percent_is_refused():
    with pytest.raises(ValueError, match="between 0 and 1"):
        score_interval(1, 0, 0, confidence=95)


@pytest.mark.parametrize("damage", [{"created": math.inf}, {"created": math.nan}, {"wins": 2**63 - 1}])
def test_a_row_that_is_not_finite_is_refused(match, damage):
    row = replace(match("a", "b", home=(1, 0, 0)), **damage)
    with pytest.raises(ValueError, match="the log of matches is damaged: a time or a count of games is not finite"):
        sum_matches([row])
