"""Games of the newest snapshots: who meets whom, and in which order."""

from matchmaking.match_design import RequiredOpponents, missing_pairs, others_after
from matchmaking.ratings.ladder import Ladder

WISHES = {
    "blue@8": RequiredOpponents(["red@8"], ["blue@0", "blue@4"], ["pusher"]),
    "red@8": RequiredOpponents(["blue@8"], ["red@0", "red@4"], ["pusher"]),
}
NAMES = ["blue@0", "blue@4", "blue@8", "red@0", "red@4", "red@8", "pusher"]
FIRST = [
    ("blue@8", "red@8"), ("blue@8", "blue@0"), ("red@8", "red@0"), ("blue@8", "blue@4"), ("red@8", "red@4"),
    ("blue@8", "pusher"), ("red@8", "pusher"),
]  # fmt: skip


def open_pairs(log, wishes=WISHES, **given):
    return missing_pairs(Ladder(NAMES, log).payoff, wishes, **{"quota": 4, **given})


def test_the_newest_meet_each_other_first_and_all_lists_are_worked_through_side_by_side():
    assert open_pairs([]) == FIRST


def test_a_round_ends_before_the_next_begins_and_then_rivals_play_to_the_end(match):
    log, planned = [], []
    while pairs := open_pairs(log, target_episodes=12):
        planned.append(pairs[0])
        log.append(match(*pairs[0], home=(1, 0, 1), away=(1, 0, 1)))
    assert planned == [*FIRST, FIRST[0], FIRST[0], *FIRST[1:], *FIRST[1:]]


def test_one_round_is_enough_where_nothing_else_is_said_and_void_episodes_count(match):
    log = [match("blue@8", "red@8", voids=4), match("pusher", "red@8", home=(2, 0, 0), away=(2, 0, 0))]
    assert open_pairs(log) == [pair for pair in FIRST if pair not in (("blue@8", "red@8"), ("red@8", "pusher"))]


def test_a_name_that_stands_twice_is_asked_for_once_and_nobody_meets_itself():
    wishes = {"blue@8": RequiredOpponents(["red@8", "blue@8"], ["blue@0", "blue@0"], ["blue@0", "red@8"])}
    assert open_pairs([], wishes) == [("blue@8", "red@8"), ("blue@8", "blue@0")]


def test_of_many_players_each_meets_one_rival_then_its_measures_then_the_other_rivals():
    newest = [f"p{i}@8" for i in range(6)]
    wishes = {name: RequiredOpponents(others_after(newest, name), [f"{name[:2]}@0"], ["pusher"]) for name in newest}
    names = [*newest, *(f"p{i}@0" for i in range(6)), "pusher"]
    pairs = missing_pairs(Ladder(names, []).payoff, wishes, quota=4)
    assert {name for pair in pairs[:6] for name in pair} == set(newest)
    assert pairs[6:12] == [(name, f"{name[:2]}@0") for name in newest]
    assert len([pair for pair in pairs if set(pair) <= set(newest)]) == 15  # every two of them
    assert pairs[-6:] == [(name, "pusher") for name in newest]
