import math

import numpy as np
import pytest

from matchmaking.ratings import ladder as module
from matchmaking.ratings.fit import ELO, fit
from matchmaking.ratings.ladder import Ladder, Pool
from matchmaking.ratings.payoff import sum_matches
from matchmaking.ratings.scores import score_interval
from storage.records import Player, Snapshot


def test_a_ladder_says_what_payoff_and_fit_say(match):
    log = [match("a", "b", home=(9, 2, 5), away=(7, 1, 8)), match("c", "b", home=(3, 0, 5), away=(1, 2, 5))]
    ladder, payoff = Ladder(["a", "b", "c"], log, anchors=["b"]), sum_matches(log)
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
    assert (success.score, success.games, success.voids) == (8 / 12, 12, 1)
    assert (success.low, success.high) == pytest.approx(score_interval(8, 0, 4))
    assert (ladder.trial_episodes("a"), ladder.trial_episodes("b"), ladder.one_team) == (13, 0, True)
    assert math.isnan(ladder.success("b").score)
    assert ladder.success("b")[1:] == (0, 1, 0, 0)


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


def unlike(match, population_offset):
    """Rovers and ants that meet only each other; rovers are stronger by `population_offset` (log odds)."""
    rovers, ants = {"r0": 0.0, "r1": 0.7}, {"a0": 0.0, "a1": 0.4, "a2": 1.0}

    def wins(gap):
        return round(40_000 / (1 + math.exp(-gap)))

    log = [
        match(r, a, home=(wins(x - y + population_offset), 0, wins(y - x - population_offset)))
        for r, x in rovers.items() for a, y in ants.items()
    ]  # fmt: skip
    populations = {name: "rover" for name in rovers} | {name: "ant" for name in ants}
    return Ladder(Pool(tuple(populations), ("r0", "a0"), {}, populations), log)


@pytest.mark.parametrize("population_offset", [-1.0, 0.0, 0.5])
def test_populations_that_never_meet_within_have_a_ladder_each_and_the_arena_a_tilt(match, population_offset):
    ladder = unlike(match, population_offset)
    ratings = ladder.ratings
    assert ratings.populations == ("ant", "rover")
    elo = dict(zip(ratings.names, ((ratings.elo - 1000) / ELO).tolist(), strict=True))
    # Whatever the arena's population_offset, each side's Elo counts from its own initial snapshot.
    assert elo == pytest.approx({"a0": 0, "a1": 0.4, "a2": 1.0, "r0": 0, "r1": 0.7}, abs=0.01)
    assert (ratings.stderr[0], ratings.stderr[3]) == pytest.approx((0, 0), abs=1e-3)
    leans, error = ratings.population_offset("rover", "ant")
    assert leans / ELO == pytest.approx(population_offset, abs=0.01)
    assert 0 < error < 10
    assert ratings.population_offset("ant", "rover") == pytest.approx((-leans, error))
    assert ratings.expected("r1", "a2") == pytest.approx(1 / (1 + math.exp(1.0 - 0.7 - population_offset)), abs=1e-3)
    assert (ratings.likelihood_of_superiority("r1", "a2") > 0.5) == (population_offset > 0.3)
    assert (ratings.side_advantage, math.isnan(ratings.side_stderr)) == (0, True)


def test_a_population_without_an_anchor_that_played_counts_from_all_its_own(match):
    ladder = unlike(match, 0.5)
    pool = Pool(ladder.pool.names, ("a0",), {}, ladder.pool.populations)
    ratings = Ladder(pool, onto=ladder.payoff).ratings
    assert ratings.elo[3:].mean() == pytest.approx(1000)
    assert ratings.elo[0] == 1000
    assert ratings.expected_scores() == pytest.approx(ladder.ratings.expected_scores())


def test_a_new_snapshot_is_as_strong_as_its_parent_until_games_say_otherwise(match):
    log = [match("a", "b", home=(30, 0, 10), away=(30, 0, 10))]
    names = ("a", "b", "c", "d")
    ladder = Ladder(Pool(names, ("b",), {"c": "a", "d": "elsewhere"}), log)
    elo = dict(zip(names, ladder.ratings.elo.tolist(), strict=True))
    assert elo["c"] == pytest.approx(elo["a"], abs=3)
    assert not ladder.known("c")
    few = ladder.extended([match("c", "b", home=(0, 0, 2), away=(0, 0, 2))])
    many = few.extended([match("c", "b", home=(0, 0, 98), away=(0, 0, 98))])
    fell = [ladder.ratings.elo[2], few.ratings.elo[2], many.ratings.elo[2]]
    assert fell == sorted(fell, reverse=True)
    assert fell[2] < elo["b"] < fell[0]


def test_a_lineage_that_has_not_played_is_level():
    ladder = Ladder(Pool(("a", "b", "c"), ("a",), {"b": "a", "c": "b"}))
    assert ladder.ratings.elo == pytest.approx([1000, 1000, 1000])
    assert not ladder.known("c")


def test_a_pool_is_what_a_league_says_of_its_snapshots():
    def snapshot(name, roster, **given):
        return Snapshot("cup", name, name, roster, **given)

    rovers = [snapshot("blue@0", "rover", player="blue", initial=True), snapshot("blue@1", "rover", parent="blue@0")]
    ants = [snapshot("red@0", "ant", player="red", initial=True), snapshot("idle", "ant", script="idle")]
    alike = Pool.of([*rovers], [Player("cup", "blue", 0, "main", "rover"), Player("cup", "red", 1, "main", "rover")])
    assert alike == Pool(("blue@0", "blue@1"), ("blue@0",), {"blue@1": "blue@0"}, {})
    other = Pool.of(
        [*rovers, *ants], [Player("cup", "blue", 0, "main", "rover"), Player("cup", "red", 1, "main", "ant")]
    )
    assert other.populations == {"blue@0": "rover", "blue@1": "rover", "red@0": "ant", "idle": "ant"}
