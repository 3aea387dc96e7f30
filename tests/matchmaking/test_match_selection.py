from itertools import pairwise

import numpy as np
import pytest

from matchmaking.match_selection import pairings
from matchmaking.ratings.ladder import Ladder


def test_no_pairing_twice_in_a_batch_nor_against_oneself():
    names = [f"s{i}" for i in range(6)]
    plan = pairings(Ladder(names, []), names, quota=10, per_batch=100)
    assert len(plan) == 15  # all there are
    assert len({frozenset(pair) for pair in plan}) == 15
    assert all(a != b for a, b in plan)


def test_everything_plays_something_before_anything_plays_much(match):
    names = [f"s{i}" for i in range(9)]
    busy = [match("s0", "s1", home=(30, 0, 30), away=(30, 0, 30))]
    plan = pairings(Ladder(names, busy), names, quota=10, per_batch=7)
    assert {name for pair in plan for name in pair} >= set(names[2:])
    assert [len({"s0", "s1", *(name for pair in plan[:n] for name in pair)}) for n in range(8)] == list(range(2, 10))


def test_a_plan_is_carried_out_to_its_end(match, simulate):
    names, log, rng = [f"s{i}" for i in range(5)], [], np.random.default_rng(0)
    for _ in range(20):
        plan = pairings(Ladder(names, log), names, quota=8, per_batch=3)
        log += [simulate(a, b, float(int(a[1]) - int(b[1])), 4, rng) for a, b in plan]
    games = Ladder(names, log).payoff.games
    assert plan == []
    assert (games + 8 * np.eye(5) == 8).all()


def test_required_opponents_come_first_until_they_have_their_quota(match):
    names = ["init", "old", "new"]
    always = {"new": ["pusher", "init"], "old": ["init"]}

    def first(log):
        return pairings(Ladder([*names, "pusher"], log), names, quota=4, per_batch=1, always=always)

    old = match("init", "old", home=(2, 0, 2), away=(2, 0, 2))
    assert first([old]) == [("new", "pusher")]
    pushed = match("new", "pusher", home=(2, 0, 0), away=(2, 0, 0))
    assert first([old, pushed]) == [("new", "init")]
    assert first([old, pushed, match("new", "init", home=(1, 0, 1), away=(1, 0, 1))]) == [("new", "old")]


def test_equals_are_preferred_to_the_far_and_the_unknown_to_the_known(match):
    def even(a, b, wins, losses):
        return match(a, b, home=(wins, 0, losses), away=(wins, 0, losses))

    names = ["weak", "twin", "peer", "new"]
    log = [even("twin", "weak", 49, 1), even("peer", "weak", 49, 1), even("new", "weak", 24, 1)]
    assert pairings(Ladder(names, log), names, quota=1000, per_batch=1) == [("new", "peer")]
    known = [*log, even("peer", "twin", 300, 300), even("new", "peer", 10, 10)]
    fewest = [*known, even("weak", "twin", 1, 99)]
    assert pairings(Ladder(names, fewest), names, quota=1000, per_batch=1) == [("new", "twin")]


def test_only_those_who_can_meet_are_paired():
    names = ["blue0", "blue1", "red0", "red1"]
    plan = pairings(
        Ladder(names, []),
        names,
        quota=4,
        per_batch=9,
        may_meet=lambda a, b: a[:-1] != b[:-1],
        always={"blue1": ["blue0"]},
    )
    assert len(plan) == 4
    assert all(a[:-1] != b[:-1] for a, b in plan)


def test_of_each_kind_one_is_asked_whom_all_may_meet():
    kinds = {name: name[:-1] for name in ("blue0", "blue1", "blue2", "red0", "red1")}
    asked = []

    def may_meet(a: str, b: str) -> bool:
        asked.append((a, b))
        return a[:-1] != b[:-1]

    given = (Ladder(kinds, []), list(kinds))
    with_kinds = pairings(*given, quota=4, per_batch=9, may_meet=may_meet, kinds=kinds)
    assert len(asked) == 4
    assert with_kinds == pairings(*given, quota=4, per_batch=9, may_meet=may_meet)
    assert len(with_kinds) == 6


def test_the_same_arguments_give_the_same_plan_whatever_the_order_of_matches(simulate):
    names = [f"s{i}" for i in range(7)]
    rng = np.random.default_rng(3)
    log = [simulate(a, b, 0.0, 4, rng) for a, b in pairwise(names)]
    plans = [pairings(Ladder(names, rows), names, quota=20, per_batch=6) for rows in (log, log[::-1], log)]
    assert plans[0] == plans[1] == plans[2]
    assert len(plans[0]) == 6


def test_a_pair_that_always_fails_is_given_up(match):
    ladder = Ladder(["a", "b"], [match("a", "b", voids=50)])
    assert pairings(ladder, ["a", "b"], quota=50, per_batch=4) == []


def test_a_candidate_without_a_place_is_named():
    with pytest.raises(ValueError, match="'b' is not among"):
        pairings(Ladder(["a"], []), ["a", "b"], quota=1, per_batch=1)


def test_nothing_is_fitted_once_every_pair_has_its_quota(match, monkeypatch):
    names = [f"s{i}" for i in range(4)]
    log = [match(a, b, home=(1, 0, 1), away=(1, 0, 1)) for i, a in enumerate(names) for b in names[:i]]
    assert pairings(Ladder(names, log), names, quota=5, per_batch=9) != []
    monkeypatch.setattr("matchmaking.ratings.ladder.fit", lambda *_, **__: pytest.fail("the ratings were fitted"))
    assert pairings(Ladder(names, log), names, quota=4, per_batch=9) == []
    apart = pairings(Ladder(names, []), names, quota=4, per_batch=9, may_meet=lambda a, b: False)
    assert apart == []


def test_lineages_that_are_frozen_as_quickly_as_they_are_rated_are_connected(match):
    scripts, players, log = ["pusher", "idle", "dodger"], ["blue@0", "red@0"], []
    for n in (1, 2, 4, 8):
        newest = [f"blue@{n}", f"red@{n}"]
        players += newest
        own = {name: [f"{name.partition('@')[0]}@0"] for name in newest}
        names = [*scripts, *players]
        planned = pairings(Ladder(names, log), names, quota=8, per_batch=3, always=own)
        assert set(planned) >= {(name, *own[name]) for name in newest}
        log += [match(a, b, home=(2, 0, 2), away=(2, 0, 2)) for a, b in planned]
        connected = {"blue@0"}
        for _ in names:
            connected |= {name for m in log for name in (m.a, m.b) if connected & {m.a, m.b}}
        assert connected >= set(players)
    assert connected == set(names)  # meanwhile the scripts have met somebody too


def test_whom_no_game_can_connect_are_paired_all_the_same():
    names = ["a0", "a1", "b0", "b1"]
    plan = pairings(Ladder(names, []), names, quota=4, per_batch=9, may_meet=lambda a, b: a[0] == b[0])
    assert sorted(map(sorted, plan)) == [["a0", "a1"], ["b0", "b1"]]
