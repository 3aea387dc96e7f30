import numpy as np
import pytest

from matchmaking.opponents import (
    Opponents,
    Qualities,
    WinRecord,
    WinRecords,
    alphastar,
    by_quality,
    delta_uniform,
    draw,
    gaussian,
    latest,
    pfsp,
    uniform,
)


def test_latest_and_uniform():
    assert latest(3).tolist() == [0, 0, 1]
    assert uniform(4).tolist() == [0.25] * 4


@pytest.mark.parametrize(
    ("n", "delta", "first"), [(4, 0, 0), (4, 0.5, 2), (5, 0.5, 3), (30, 0.1, 3), (50, 0.14, 7), (4, 1, 3), (1, 1, 0)]
)
def test_delta_uniform_starts_at_the_share_left_out(n, delta, first):
    weights = delta_uniform(n, delta)
    assert np.flatnonzero(weights).tolist() == list(range(first, n))
    assert weights[first:] == pytest.approx(np.full(n - first, 1 / (n - first)))


@pytest.mark.parametrize(
    ("weighting", "weights"),
    [
        ("squared", [0.0, 0.01, 0.25, 0.64, 1.0]),
        ("variance", [0.0, 0.09, 0.25, 0.16, 0.0]),
        ("linear", [0.0, 0.1, 0.5, 0.8, 1.0]),
        ("linear_capped", [0.0, 0.1, 0.5, 0.5, 0.5]),
    ],
)
def test_the_four_weightings_of_pfsp(weighting, weights):
    found = pfsp(np.array([1.0, 0.9, 0.5, 0.2, 0.0]), weighting)
    assert found == pytest.approx(np.array(weights) / sum(weights))


def test_pfsp_takes_a_half_for_the_unknown_and_is_uniform_over_those_who_are_always_beaten():
    assert pfsp(np.array([np.nan, 0.5])) == pytest.approx([0.5, 0.5])
    assert pfsp(np.ones(4)) == pytest.approx([0.25] * 4)
    assert pfsp(np.array([1.0, 0.0]), "variance") == pytest.approx([0.5, 0.5])


def test_the_normal_law_prefers_equals():
    found = gaussian(np.array([0.5, 0.5 + 1 / 6, 0.0]))
    assert found[1] / found[0] == pytest.approx(np.exp(-0.5))
    assert found[2] / found[0] == pytest.approx(np.exp(-4.5))
    assert gaussian(np.array([0.0, 1.0]), 1e-3) == pytest.approx([0.5, 0.5])


def test_qualities_are_a_softmax_and_large_ones_do_not_overflow():
    assert by_quality(np.log([1.0, 3.0])) == pytest.approx([0.25, 0.75])
    assert by_quality(np.array([5000.0, 5000.0, -5000.0])) == pytest.approx([0.5, 0.5, 0])


def test_a_game_that_is_won_lowers_a_quality_and_a_lost_one_does_not():
    known = Qualities(rate=0.01)
    known.add(["a", "b"])
    known.note([("a", 1, 1, 1.0), ("b", 0, 0, 0.5)], pool=2)
    assert known.of(["a", "b"]) == pytest.approx([-0.01 / (2 * 1.0), 0])
    known.note([("b", 0, 50, 0.5)], pool=2)
    assert known.of(["b"]) == pytest.approx([0])
    known.note([("a", 0.5, 1, 1.0)], pool=2)  # a draw is half a win
    assert known.of(["a"]) == pytest.approx([-0.0075])


def test_a_new_opponent_begins_with_the_largest_quality():
    known = Qualities()
    known.note([("a", 100, 100, 1.0)], pool=1)
    known.add(["b"])
    assert known.q["b"] == known.q["a"] == pytest.approx(-1.0)


def test_an_unlikely_draw_of_a_whole_turn_does_not_throw_its_quality_away():
    known = Qualities(rate=0.01)
    known.note([("a", 500, 500, 1e-9), ("b", 0, 500, 1.0)], pool=2)
    assert known.of(["a"]) == pytest.approx([-0.01 * 1000 / 2])


def test_a_record_is_a_half_until_there_are_enough_games_and_forgets():
    record = WinRecord.new(10)
    assert record.rate == 0.5
    assert record.after(1, 0, 0, decay=1).rate == pytest.approx(6 / 11)
    assert record.after(0, 0, 1, decay=1).rate == pytest.approx(5 / 11)
    assert record.after(0, 7, 0).rate == pytest.approx(0.5)  # draws are no losses
    assert record.after(1000, 0, 0).rate == pytest.approx(1.0, abs=1e-3)
    assert record.after(0, 0, 0) == record
    lost = record.after(1000, 0, 0).after(0, 0, 200)
    assert lost.rate == pytest.approx(0.99**200, rel=0.05)  # what is left of the wins


def test_games_one_by_one_count_as_a_batch_of_equal_ones():
    one_by_one = WinRecord.new()
    for _ in range(30):
        one_by_one = one_by_one.after(1, 0, 0)
    together = WinRecord.new().after(30, 0, 0)
    assert (one_by_one.score, one_by_one.games) == pytest.approx((together.score, together.games))


def test_a_snapshot_that_was_never_met_inherits_from_the_nearest_that_was():
    known = WinRecords(parents={"red@2": "red@1", "red@1": "red@0", "red@4": "red@2"})
    known.note("red@1", 90, 0, 10)
    assert known.against("red@4") == known.against("red@1") == known.row["red@1"]
    assert known.against("red@0").rate == 0.5
    assert (known.source("red@4"), known.source("red@0")) == ("red@1", None)
    assert known.games(["red@4", "red@1"]).tolist() == [0, 100]
    before = known.rates(["red@4"])[0]
    assert before == known.against("red@1").rate > 0.7
    known.note("red@2", 0, 0, 100)
    assert known.rates(["red@4"])[0] == known.against("red@2").rate < before
    assert known.against("red@1").rate == before


def mixture(x, present=0.5, own=None, exploiters=(), **more):
    n = len(x)
    of_exploiters = np.isin(np.arange(n), exploiters)
    mine = ~of_exploiters if own is None else np.isin(np.arange(n), own)
    return alphastar(np.array(x), present, mine, of_exploiters, **more)


def test_alphastars_main_players_play_half_their_games_by_pfsp():
    x = [0.9, 0.8, 0.7]  # each harder than the one before: nobody is forgotten
    found = mixture(x)
    assert found.present == pytest.approx(0.5)  # 0.35, and 0.15 as there is nobody to be verified against
    assert found.past == pytest.approx(0.5 * pfsp(np.array(x)))


def test_a_present_opponent_that_is_beaten_too_seldom_is_replaced_by_its_past():
    x = [0.9, 0.6, 0.2]
    found = mixture(x, present=0.3)
    assert found.present == 0
    assert found.past == pytest.approx(0.5 * pfsp(np.array(x)) + 0.5 * pfsp(np.array(x), "variance"))
    assert mixture(x, present=0.31).present == pytest.approx(0.5)


def test_exploiters_that_win_are_met_before_the_forgotten():
    x = [0.9, 0.2, 0.95, 0.1, 0.6]
    found = mixture(x, exploiters=(3, 4))
    wanted = 0.5 * pfsp(np.array(x))
    wanted[3:] += 0.15 * pfsp(np.array([0.1, 0.6]))
    assert (found.present, found.past) == (pytest.approx(0.35), pytest.approx(wanted))
    x[3] = 0.3  # no longer beaten in less than 30 %
    wanted = 0.5 * pfsp(np.array(x))
    wanted[:3] += 0.15 * pfsp(np.array(x[:3]))  # the second is forgotten; none is new, as the third is easier
    assert mixture(x, exploiters=(3, 4)).past == pytest.approx(wanted)


def test_if_one_is_forgotten_all_but_the_newest_harder_ones_are_met_again():
    x = [0.9, 0.8, 0.75, 0.65, 0.72, 0.7]  # the last one is new, as it is harder than the one before
    found = mixture(x)
    wanted = 0.5 * pfsp(np.array(x))
    wanted[:5] += 0.15 * pfsp(np.array(x[:5]))
    assert (found.present, found.past) == (pytest.approx(0.35), pytest.approx(wanted))


def test_alphastars_shares_can_be_chosen_and_always_sum_to_one():
    rng = np.random.default_rng(0)
    for _ in range(200):
        n = rng.integers(1, 9)
        found = alphastar(rng.random(n), rng.random(), rng.random(n) < 0.5, rng.random(n) < 0.2, (0.2, 0.3, 0.5))
        assert found.present + found.past.sum() == pytest.approx(1)
    assert mixture([0.5], present=None).present == 0
    with pytest.raises(ValueError, match=r"sum to 1, not to 0\.9"):
        mixture([0.5], mix=(0.5, 0.3, 0.1))


def test_draw_follows_the_weights_and_changes_only_as_far_as_they_do():
    names, keys = ["a", "b", "c"], [f"group {i}" for i in range(4000)]
    drawn = draw(np.array([0.0, 0.25, 0.75]), names, keys)
    assert np.bincount(drawn, minlength=3) / 4000 == pytest.approx([0.0, 0.25, 0.75], abs=0.03)
    assert drawn == draw(np.array([0.0, 0.25, 0.75]), names, keys)
    before, after = (np.array(draw(np.ones(n) / n, [f"red@{i}" for i in range(n)], keys)) for n in (9, 10))
    assert (after == 9).mean() == pytest.approx(0.1, abs=0.02)
    assert (before == after)[after < 9].all()
    heavier = np.array(draw(np.array([0.3, *[0.1] * 7]), [f"red@{i}" for i in range(8)], keys))
    lighter = np.array(draw(np.array([0.2, *[0.8 / 7] * 7]), [f"red@{i}" for i in range(8)], keys))
    assert (heavier == 0).mean() == pytest.approx(0.3, abs=0.03)
    assert (heavier == lighter)[heavier != 0].all()


def test_a_rule_has_its_published_share_of_the_past_unless_another_is_given():
    shares = {kind: Opponents(kind).share for kind in ("latest", "openai_five", "uniform", "pfsp", "alphastar")}
    assert shares == {"latest": 0, "openai_five": 0.2, "uniform": 1, "pfsp": 1, "alphastar": 1}
    assert Opponents("pfsp", past=0.5).share == 0.5


def test_settings_of_older_leagues_go_on():
    assert Opponents("prioritized", past=0.2) == Opponents("pfsp", past=0.2)


@pytest.mark.parametrize("groups", [2, 3, 8, 10])
@pytest.mark.parametrize("past", [0.0, 0.01, 0.2, 0.5, 0.8, 0.99, 1.0])
def test_the_groups_follow_the_share_to_within_one_of_them(past, groups):
    opponents = Opponents(past=past, groups=groups)
    split = opponents.split()
    assert opponents.actual_share == split.past / sum(split)
    assert abs(opponents.actual_share - past) <= 1 / groups
    assert (split.past > 0) == (past > 0)
    assert (split.present > 0) == (past < 1)
    assert sum(split) == groups or split == (1, 0)


def test_a_large_share_of_few_groups_leaves_a_present_one():
    # Until this was a share of all groups, past = 0.8 with one past group gave 100 %.
    assert Opponents("uniform", past=0.8, groups=5).split() == (1, 4)
    assert Opponents("uniform", past=0.8, groups=2).split() == (1, 1)
    assert Opponents("uniform", past=1.0, groups=3).split() == (0, 3)
    assert Opponents().split() == (1, 0)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"kind": "newest"}, "choose one of latest, uniform, delta_uniform, pfsp"),
        ({"past": 1.5}, "between 0 and 1"),
        ({"kind": "delta_uniform", "past": 0.5, "delta": -0.1}, "between 0 and 1"),
        ({"groups": 0}, "1 or more"),
        ({"kind": "uniform", "past": 0.5, "groups": 1}, "2 or more, for present and past"),
        ({"kind": "uniform", "past": 0.2, "delta": 0.5}, "use kind = 'delta_uniform'"),
        ({"kind": "uniform", "past": 0.0}, "give past > 0"),
        ({"kind": "pfsp", "weighting": "cubed"}, "choose one of squared, variance, linear, linear_capped"),
        ({"kind": "uniform", "weighting": "linear"}, "use kind = 'pfsp'"),
        ({"kind": "alphastar", "mix": (0.5, 0.5, 0.5)}, "sum to 1, not to 1.5"),
        ({"kind": "alphastar", "past": 0.5}, "its shares are in mix"),
        ({"kind": "gaussian", "sigma": 0.0}, "above 0"),
        ({"kind": "nash", "alpha": 5.0}, "use kind = 'alpharank'"),
        ({"kind": "uniform", "decay": 0.9}, "use kind = 'pfsp' or kind = 'alphastar'"),
        ({"kind": "pfsp", "decay": 1.1}, "between 0 and 1"),
        ({"kind": "fixed"}, "give victim"),
        ({"victim": "pusher"}, "use kind = 'fixed'"),
    ],
)
def test_settings_that_cannot_be_meant_are_refused(fields, says):
    with pytest.raises(ValueError, match=says):
        Opponents(**fields)


def test_impossible_arguments_are_refused():
    for nobody in (lambda: latest(0), lambda: pfsp(np.zeros(0)), lambda: by_quality(np.zeros(0))):
        with pytest.raises(ValueError, match="0 snapshots"):
            nobody()
    with pytest.raises(ValueError, match="choose one of squared"):
        pfsp(np.array([0.5]), "hardest")
    with pytest.raises(ValueError, match="delta is 2"):
        delta_uniform(3, 2)
    with pytest.raises(ValueError, match="scores between 0 and 1"):
        pfsp(np.array([0.5, 1.5]))
