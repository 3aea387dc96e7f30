"""Comparison of two players: by their games, else by ratings whose interval has room for the model's misfit."""

import math

import numpy as np
import pytest

from matchmaking.ratings.comparison import CYCLIC_ELO, MIN_DIRECT_GAMES, compare_snapshots
from matchmaking.ratings.fit import ELO
from matchmaking.ratings.ladder import Ladder


def even(match, a, b, wins, losses):
    return match(a, b, home=(wins, 0, losses), away=(wins, 0, losses))


def test_games_of_the_two_decide_whatever_the_detour_says(match):
    detour = [even(match, "blue", "anchor", 900, 100), even(match, "red", "anchor", 500, 500)]
    found = compare_snapshots(Ladder([], [*detour, even(match, "blue", "red", 20, 80)]), "blue", "red")
    assert (found.first, found.second, found.sure, found.direct) == ("red", "blue", True, True)
    assert found.score.score == 0.8
    assert compare_snapshots(Ladder([], detour), "red", "blue").first == "blue"


def test_a_score_whose_interval_holds_one_half_is_not_sure(match):
    found = compare_snapshots(Ladder([], [even(match, "blue", "red", 54, 46)]), "red", "blue")
    assert (found.first, found.direct, found.sure) == ("blue", True, False)
    assert found.score.low < 0.5 < found.score.score
    assert compare_snapshots(Ladder([], [even(match, "blue", "red", 70, 30)]), "red", "blue").sure


def test_few_games_of_the_two_leave_it_to_the_fit(match):
    few = even(match, "blue", "red", MIN_DIRECT_GAMES // 2 - 1, 0)
    assert not compare_snapshots(Ladder([], [few]), "blue", "red").direct
    assert compare_snapshots(Ladder([], [few, even(match, "blue", "red", 1, 0)]), "blue", "red").direct


def test_by_the_fit_alone_the_interval_is_widened_by_the_cyclic_term_of_every_pair(match):
    """Two who met one anchor for ever: the errors of both pairs and of their own add up to three times τ²."""
    log = [even(match, "blue", "anchor", 64_000, 36_000), even(match, "red", "anchor", 50_000, 50_000)]
    found = compare_snapshots(Ladder([], log), "blue", "red")
    assert found.gap == pytest.approx(ELO * math.log(64 / 36), rel=0.01)
    assert found.error == pytest.approx(1.96 * math.sqrt(3 * CYCLIC_ELO**2 / 2), rel=0.02)
    assert not found.sure
    far = [even(match, "blue", "anchor", 90_000, 10_000), even(match, "red", "anchor", 50_000, 50_000)]
    assert compare_snapshots(Ladder([], far), "blue", "red").sure


def test_under_a_cyclic_term_of_100_elo_it_is_seldom_said_of_the_wrong_one(simulate):
    """Detours alone: the probability of the normal law is sure and wrong at times, the widened interval holds."""
    rng, inside, sure, wrong = np.random.default_rng(0), 0, 0, 0
    for _ in range(200):
        angle, others = rng.uniform(0, 2 * np.pi, 6), [f"o{i}" for i in range(4)]
        names = ["blue", "red", *others]

        def gap(i, j, angle=angle):
            return 100 * np.sin(angle[i] - angle[j])

        met = [(i, j) for i in (0, 1) for j in range(2, len(names))]
        log = [simulate(names[i], names[j], gap(i, j) / ELO, 256, rng, side=0.0) for i, j in met]
        ladder = Ladder(names, log)
        found = compare_snapshots(ladder, "blue", "red")
        true = gap(names.index(found.first), names.index(found.second))
        inside += abs(found.gap - true) < found.error
        likelihood = ladder.ratings.likelihood_of_superiority(found.first, found.second)
        sure += likelihood > 0.975 and true < 0
        wrong += found.sure and true < 0
    assert inside >= 0.93 * 200
    assert sure > 10  # what was said before, of the wrong one
    assert wrong <= 4


def test_a_name_that_is_not_there_is_named(match):
    with pytest.raises(ValueError, match="'green' is not among"):
        compare_snapshots(Ladder([], [even(match, "blue", "red", 1, 1)]), "blue", "green")
