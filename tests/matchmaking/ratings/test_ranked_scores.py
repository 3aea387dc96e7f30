"""Scores in matches of three and more teams: intervals by seed clusters, and whether they hold the truth."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from matchmaking.ratings.ladder import Ladder
from matchmaking.ratings.payoff import Payoff, sum_matches
from matchmaking.ratings.plackett_luce import ranking_chances
from matchmaking.ratings.scores import Score, SeedScores, effective_games, effective_seeds, score_interval
from storage.records import RankedMatch, SeedCluster
from tests.matchmaking.ratings.test_seed_clusters import THETA, TIES, drawn, rotations


def unknown(log: list[RankedMatch]) -> list[RankedMatch]:
    """Return rows as those of stores that do not know which games share a seed."""
    return [replace(match, seed_clusters={}) for match in log]


def ends(score: Score) -> tuple[float, ...]:
    return score[:3]


def interval(score: Score):
    return pytest.approx(ends(score))


def halfway(rng: np.random.Generator, seeds: int) -> list[SeedCluster]:
    """Draw rankings of rotations of which the second and third repeat the first with a chance of one half each."""
    repeated = rng.random((seeds, 3)) < 0.5
    return [
        tuple(seed[0] if again else ranks for ranks, again in zip(seed, row, strict=True))
        for seed, row in zip(drawn(rng, seeds), repeated, strict=True)
    ]


def test_seed_pairs_as_units_have_the_effective_games_of_seed_pairs():
    pairs = np.random.default_rng(0).integers(1, 40, (6, 5))
    group, kind = np.divmod(np.arange(30), 5)
    points, two, one = pairs * [0, 0.5, 1, 1.5, 2], np.full(30, 2.0), np.ones(30, int)
    each = np.tile([0, 0.5, 1, 1.5, 2], 6)
    scores = SeedScores(group, group * 5 + kind, two, each, pairs.ravel(), one)
    s, effective = effective_seeds(scores, 6)
    n = 2 * pairs.sum(1)
    want = effective_games(points.sum(1), 0, n - points.sum(1), pairs)
    assert s == pytest.approx(want[0])
    assert effective == pytest.approx(want[1])


def test_without_games_nothing_is_known():
    none = np.zeros(0, int)
    s, effective = effective_seeds(SeedScores(none, none, none, none, none, none), 2)
    assert (s.tolist(), effective.tolist()) == ([0, 0], [0, 0])
    payoff = sum_matches(rotations("abc", drawn(np.random.default_rng(0), 4)), ["d"])
    assert np.isnan(payoff.score("a", "d").score)
    assert payoff.score("a", "d")[1:] == payoff.score("a")[1:] == payoff.mean_score("a", "d")[1:] == (0, 1, 0, 0)


@pytest.mark.parametrize("others", ["b", "c", "bc"])
def test_copies_of_one_game_tell_as_much_as_one(others):
    log = rotations("abc", drawn(np.random.default_rng(0), 50, copies=True))
    once, thrice = sum_matches(unknown(log[:1])), sum_matches(log)
    for name in ("score", "mean_score"):
        found = getattr(thrice, name)("a", *others)
        assert ends(found) == interval(getattr(once, name)("a", *others))
        assert found.games == 150 * len(others)


def test_rows_that_do_not_know_their_seeds_count_as_if_all_rotations_were_copies():
    """This is the largest variance that games of one seed can have, and exactly that of copies."""
    log = rotations("abc", drawn(np.random.default_rng(1), 40, copies=True))
    for others in ("b", "bc"):
        assert ends(sum_matches(unknown(log)).score("a", *others)) == interval(sum_matches(log).score("a", *others))
    two_of_three = sum_matches(unknown(log[:2])).score("a", "b")
    assert ends(two_of_three) == interval(sum_matches(unknown(log[:1])).score("a", "b"))


def test_games_of_a_lineup_that_has_no_rotations_are_independent():
    """Its rosters do not let it change seats; an order of the same players that is no rotation has its own seeds."""
    log = unknown(rotations("abc", drawn(np.random.default_rng(1), 40)))[:1]
    payoff = sum_matches([*log, replace(log[0], snapshots=("b", "a", "c"))])
    wins, draws, losses = payoff.against("a", ["b"])[:3]
    low, high = score_interval(wins, draws, losses)
    assert ends(payoff.score("a", "b"))[1:] == pytest.approx((low, high))


def test_clusters_that_a_void_broke_leave_games_that_may_share_their_seed():
    seeds = drawn(np.random.default_rng(2), 60, copies=True)
    whole = rotations("abc", seeds)
    broken = [replace(whole[0], seed_clusters=dict(Counter(seeds[:50]))), *whole[1:]]
    independent = rotations("abc", seeds[:50])
    narrow, wide = sum_matches(whole).score("a", "b"), sum_matches(broken).score("a", "b")
    assert ends(wide) == interval(narrow)  # here they are copies
    fifty = sum_matches(independent).score("a", "b")
    assert wide.high - wide.low < fifty.high - fifty.low


def test_two_others_that_are_always_on_the_same_side_tell_as_much_as_one():
    seeds = [((1, 2, 3),) * 3, ((3, 1, 2),) * 3, ((1, 3, 2), (3, 1, 2), (1, 2, 3)), ((1, 2, 2),) * 3] * 5
    payoff = sum_matches(rotations("abc", seeds))
    one, both, mean = payoff.score("a", "b"), payoff.score("a", "b", "c"), payoff.mean_score("a", "b", "c")
    assert ends(both) == interval(one)
    assert ends(mean) == interval(one)
    assert both.games == mean.games == 2 * one.games == 120


def test_scores_turn_with_the_viewpoint():
    payoff = sum_matches(rotations("abc", halfway(np.random.default_rng(3), 50)))
    ours, theirs = payoff.score("c", "a"), payoff.score("a", "c")
    assert (theirs.score, theirs.low, theirs.high) == pytest.approx((1 - ours.score, 1 - ours.high, 1 - ours.low))


def test_a_mean_over_equally_many_games_is_the_score_of_all_of_them():
    payoff = sum_matches(rotations("abc", halfway(np.random.default_rng(3), 50)))
    for name, others in (("a", "bc"), ("b", "ac"), ("c", "ab"), ("c", "a")):
        assert ends(payoff.mean_score(name, *others)) == interval(payoff.score(name, *others))


def test_a_snapshot_in_two_seats_is_met_twice_in_each_episode():
    seeds = [((1, 2, 3),) * 3, ((2, 1, 3), (1, 2, 3), (3, 1, 2))] * 20
    score = sum_matches(rotations("abb", seeds)).score("a", "b")
    # In twenty seeds it is ahead of both always; in twenty it has a half, 1 and 0 of the two games.
    assert (score.score, score.games) == (pytest.approx(0.75), 240)
    z2, limit = 1.959964**2, 0.75 * 0.25
    n = 40 * (40 + z2) / (40 * 0.25**2 / limit + z2)
    half = np.sqrt(z2 * (n * limit + z2 / 4)) / (n + z2)
    assert (score.low + score.high) / 2 == pytest.approx((n * 0.75 + z2 / 2) / (n + z2))
    assert score.high - score.low == pytest.approx(2 * half)


def test_results_that_are_all_the_same_have_the_interval_of_as_many_seeds():
    score = sum_matches(rotations("abc", [((1, 2, 3),) * 3] * 8)).score("a", "b", "c")
    assert (score.score, score.high) == (1.0, pytest.approx(1.0))
    assert score.low == pytest.approx(8 / (8 + 1.959964**2))


def test_the_order_of_rows_and_the_parts_of_a_log_do_not_matter():
    rng = np.random.default_rng(5)
    log = [*rotations("abc", halfway(rng, 30)), *rotations("cbd", halfway(rng, 30)), *rotations("abd", drawn(rng, 9))]
    log[6:] = unknown(log[6:])
    whole, parts = sum_matches(log), sum_matches(log[4:], onto=sum_matches(log[:4], ["0"]))
    for payoff in (sum_matches(log[::-1]), parts):
        for name, others in (("a", "b"), ("d", "abc"), ("b", "acd")):
            assert ends(payoff.score(name, *others)) == interval(whole.score(name, *others))
            assert ends(payoff.mean_score(name, *others)) == interval(whole.mean_score(name, *others))


def test_many_scores_at_once_are_those_of_each():
    rng = np.random.default_rng(6)
    ladder = Ladder((), [*rotations("abc", halfway(rng, 30)), *rotations("cbd", halfway(rng, 30))])
    payoff = ladder.payoff
    i, j, group = np.array([0, 0, 3, 3, 0]), np.array([1, 2, 1, 0, 3]), np.array([1, 1, 0, 0, 2])
    assert payoff.scores_of(i, j, group, 3)[:2] == [payoff.score("d", "b", "a"), payoff.score("a", "b", "c")]
    assert np.isnan(payoff.scores_of(i, j, group, 3)[2].score)
    counts, s, effective = payoff.effective_scores(i[:2], j[:2], np.array([0, 1]), 2)
    assert counts[:, :3].tolist() == [list(payoff.against("a", other)[:3]) for other in "bc"]
    assert (effective < counts[:, :3].sum(1)).all()
    assert s == pytest.approx([payoff.score("a", other).score for other in "bc"])


def expected(strengths: tuple[float, ...], ties: dict[int, float]) -> np.ndarray:
    """Return the expected scores (n, n) of the players of one lineup against each other."""
    chances = ranking_chances(strengths, ties)
    ranks, chance = np.array(list(chances)), np.array(list(chances.values()))
    return np.tensordot(chance, (np.sign(ranks[:, None] - ranks[:, :, None]) + 1) / 2, 1)


def ignoring_seeds(payoff: Payoff, others: str) -> tuple[float, float]:
    low, high = score_interval(*payoff.against("a", others)[:3])
    return float(low), float(high)


@pytest.mark.parametrize(
    ("draw", "before"),
    [
        (lambda rng: drawn(rng, 200), (0.97, 0.93)),
        (lambda rng: halfway(rng, 200), (0.89, 0.84)),
        (lambda rng: drawn(rng, 200, copies=True), (0.80, 0.70)),
    ],
    ids=["independent", "halfway", "copies"],
)
def test_intervals_hold_the_truth_as_often_as_they_say(draw, before):
    """The rate among 500 logs is within ±1 % of the true one; `before` bounds that of intervals that ignore seeds.

    Rows that do not know their seeds have wider intervals.
    """
    rng, truth = np.random.default_rng(4), expected(THETA, TIES)[0]
    for others, most in zip(("b", "bc"), before, strict=True):
        true, held, alone, wide = truth[1 : 1 + len(others)].mean(), [], [], []
        for _ in range(500):
            payoff = sum_matches(log := rotations("abc", draw(rng)))
            earlier = sum_matches(unknown(log)).score("a", *others)
            wide.append(earlier.low < true < earlier.high)
            for score in (payoff.score("a", *others), payoff.mean_score("a", *others)):
                held.append(score.low < true < score.high)
            low, high = ignoring_seeds(payoff, others)
            alone.append(low < true < high)
        assert 0.93 < np.mean(held) < 0.985
        assert np.mean(wide) > 0.93
        assert np.mean(alone) < most
