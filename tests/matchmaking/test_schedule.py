from itertools import pairwise

import numpy as np
import pytest

from matchmaking.payoff import tally
from matchmaking.schedule import Schedule, learners, next_due, next_swap, pairings


def test_leapfrog_takes_turns():
    schedule = Schedule("leapfrog", period=2, learner=1)
    assert [learners(schedule, i, 3) for i in range(8)] == [(1,), (1,), (2,), (2,), (0,), (0,), (1,), (1,)]


def test_simultaneous_and_frozen_never_change():
    assert [learners(Schedule(), i, 2) for i in (0, 99)] == [(0, 1)] * 2
    assert [learners(Schedule("frozen", learner=1), i, 2) for i in (0, 99)] == [(1,)] * 2
    assert next_swap(Schedule(), 7) is next_swap(Schedule("frozen"), 7) is None


def test_next_swap_is_where_the_learners_next_change():
    schedule = Schedule("leapfrog", period=3)
    for i in range(12):
        swap = next_swap(schedule, i)
        assert swap is not None
        assert swap > i
        assert len({learners(schedule, k, 2) for k in range(i, swap)}) == 1
        assert learners(schedule, swap, 2) != learners(schedule, i, 2)


@pytest.mark.parametrize(
    ("fields", "says"), [({"kind": "ladder"}, "leapfrog, frozen"), ({"period": 0}, "period"), ({"learner": -1}, "team")]
)
def test_schedules_that_cannot_be_meant_are_refused(fields, says):
    with pytest.raises(ValueError, match=says):
        Schedule(**fields)


def test_a_learner_beyond_the_teams_is_refused():
    with pytest.raises(ValueError, match="teams are 0 to 1"):
        learners(Schedule("frozen", learner=2), 0, 2)


@pytest.mark.parametrize(
    ("per_doubling", "due"),
    [(1, [0, 1, 2, 4, 8, 16, 32, 64]), (2, [0, 1, 2, 3, 4, 6, 8, 11, 16, 23, 32, 45, 64])],
)
def test_snapshots_are_due_on_a_log_axis(per_doubling, due):
    assert [next_due(i, per_doubling) for i in due[:-1]] == due[1:]


def test_next_due_is_exact_far_out():
    assert next_due(2**40 - 1) == 2**40
    assert next_due(2**40) == 2**41
    with pytest.raises(ValueError, match="per_doubling"):
        next_due(3, 0)


def test_no_pairing_twice_in_a_batch_nor_against_oneself():
    names = [f"s{i}" for i in range(6)]
    plan = pairings(tally([], players=names), names, quota=10, per_batch=100)
    assert len(plan) == 15  # all there are
    assert len({frozenset(pair) for pair in plan}) == 15
    assert all(a != b for a, b in plan)


def test_everything_plays_something_before_anything_plays_much(match):
    names = [f"s{i}" for i in range(9)]
    busy = [match("s0", "s1", home=(30, 0, 30), away=(30, 0, 30))]
    plan = pairings(tally(busy, players=names), names, quota=10, per_batch=4)
    assert {name for pair in plan for name in pair} >= set(names[2:])


def test_a_plan_is_carried_out_to_its_end(match, simulate):
    names, log, rng = [f"s{i}" for i in range(5)], [], np.random.default_rng(0)
    for _ in range(20):
        plan = pairings(tally(log, players=names), names, quota=8, per_batch=3)
        log += [simulate(a, b, float(int(a[1]) - int(b[1])), 4, rng) for a, b in plan]
    games = tally(log).games
    assert plan == []
    assert (games + 8 * np.eye(5) == 8).all()


def test_required_opponents_come_first_until_they_have_their_quota(match):
    names = ["init", "old", "new"]
    always = {"new": ["pusher", "init"], "old": ["init"]}

    def first(log):
        payoff = tally(log, players=[*names, "pusher"])
        return pairings(payoff, names, quota=4, per_batch=1, always=always)

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
    assert pairings(tally(log, players=names), names, quota=1000, per_batch=1) == [("new", "peer")]
    known = [*log, even("peer", "twin", 300, 300), even("new", "peer", 10, 10)]
    fewest = [*known, even("weak", "twin", 1, 99)]
    assert pairings(tally(fewest, players=names), names, quota=1000, per_batch=1) == [("new", "twin")]


def test_only_those_who_can_meet_are_paired():
    names = ["blue0", "blue1", "red0", "red1"]
    plan = pairings(
        tally([], players=names),
        names,
        quota=4,
        per_batch=9,
        may_meet=lambda a, b: a[:-1] != b[:-1],
        always={"blue1": ["blue0"]},
    )
    assert len(plan) == 4
    assert all(a[:-1] != b[:-1] for a, b in plan)


def test_the_same_arguments_give_the_same_plan_whatever_the_order_of_matches(simulate):
    names = [f"s{i}" for i in range(7)]
    rng = np.random.default_rng(3)
    log = [simulate(a, b, 0.0, 4, rng) for a, b in pairwise(names)]
    plans = [pairings(tally(rows, players=names), names, quota=20, per_batch=6) for rows in (log, log[::-1], log)]
    assert plans[0] == plans[1] == plans[2]
    assert len(plans[0]) == 6


def test_a_pair_that_always_fails_is_given_up(match):
    payoff = tally([match("a", "b", voids=50)], players=["a", "b"])
    assert pairings(payoff, ["a", "b"], quota=50, per_batch=4) == []


def test_a_candidate_without_a_place_is_named():
    with pytest.raises(ValueError, match="'b' is not among"):
        pairings(tally([], players=["a"]), ["a", "b"], quota=1, per_batch=1)
