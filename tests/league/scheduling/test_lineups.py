"""Lineups of three and more teams: the newest always together, then a newest with its past among the others' newest."""

from dataclasses import replace

import pytest

from league.config.experiment import Budget
from league.scheduling import match_scheduler
from league.scheduling.match_scheduler import complete
from matchmaking.ratings.ladder import Ladder
from storage.records import Player, RankedMatch, Snapshot
from tests.league.plans import KEY, checkpoints, league_state, pairs_of, snapshots, training, with_matches

TRIO = tuple(Player("quickstart", name, team, "main", "puck") for team, name in enumerate(("blue", "red", "green")))
ALONE = (*TRIO[:2], replace(TRIO[2], roster="tank"))


def trio(*iterations: int, players=TRIO):
    found = [
        Snapshot("quickstart", f"{p.name}@{i}", f"{p.name}@{i}", p.roster, p.name, initial=i == 0, iteration=i)
        for i in iterations
        for p in players
    ]
    return league_state(players=players, snapshots=found)


def played(lineup, episodes=10**4) -> RankedMatch:
    return RankedMatch("quickstart", KEY, lineup, {(1, 2, 3): episodes // 2, (3, 2, 1): episodes // 2}, 0, (0, 0, 0), 1)


def test_pairs_of_two_teams_stay_as_they_are():
    state = league_state(snapshots=snapshots(0, 4))
    pairs = [("blue@4", "red@4"), ("red@4", "blue@4"), ("blue@0", "pusher")]
    assert complete(pairs, state) == pairs


def test_the_pairs_of_newest_snapshots_are_one_lineup_of_all_newest():
    pairs = [("blue@4", "red@4"), ("red@4", "green@4"), ("green@4", "blue@4")]
    assert complete(pairs, trio(0, 4)) == [("blue@4", "red@4", "green@4")]


def test_the_other_seats_go_to_the_newest_of_others_after_the_first_of_the_pair():
    pairs = [("blue@4", "blue@0"), ("red@4", "red@0"), ("green@4", "green@0")]
    wanted = [("blue@4", "blue@0", "red@4"), ("red@4", "red@0", "green@4"), ("green@4", "green@0", "blue@4")]
    assert complete(pairs, trio(0, 4)) == wanted


def test_with_a_pair_of_the_pool_those_sit_who_have_played_least():
    state, log = trio(0, 4), [played(("blue@4", "red@4", "green@4"), 64), played(("blue@0", "red@4", "green@4"), 32)]
    state = replace(state, ladder=Ladder([s.name for s in state.snapshots], log))
    pairs = [("blue@4", "red@0"), ("blue@4", "green@0")]  # red@0 has played nothing, and after the first green@0 too
    assert complete(pairs, state, quota=128) == [("blue@4", "red@0", "green@0"), ("blue@4", "green@0", "blue@0")]


def test_a_snapshot_sits_where_its_roster_fits_and_no_lineup_has_it_twice():
    state = trio(0, 4, players=ALONE)
    assert complete([("green@4", "red@0")], state) == [("red@0", "blue@4", "green@4")]
    assert complete([("green@4", "green@0")], state) == []  # one team alone has that roster


def test_a_thinned_snapshot_completes_nothing():
    state = trio(4)
    gone = [replace(s, thinned=1.0 if s.name == "green@4" else None) for s in state.snapshots]
    assert complete([("blue@4", "red@4")], replace(state, snapshots=gone)) == []


def test_rating_jobs_carry_lineups_until_every_pair_has_met_enough():
    config = replace(training(), budget=Budget(training_time="5m", rating_time="180s"))
    state, log = trio(0, 1, 4), []
    first = pairs_of(match_scheduler.next_matches(config, state))
    assert first[0] == ("blue@4", "red@4", "green@4")
    assert len({frozenset(lineup) for lineup in first}) == len(first) == 4
    for _ in range(40):
        ladder = Ladder([s.name for s in state.snapshots], log, [s.name for s in state.snapshots if s.initial])
        lineups = pairs_of(match_scheduler.next_matches(config, replace(state, ladder=ladder)))
        if not lineups:
            break
        assert all(len(set(lineup)) == 3 for lineup in lineups)
        log += map(played, lineups)
    assert not lineups
    names = [s.name for s in state.snapshots]
    met = {frozenset((a, b)) for m in log for a in m.snapshots for b in m.snapshots if a != b}
    assert met == {frozenset((a, b)) for a in names for b in names if a != b}


def test_a_snapshot_whose_robots_always_fail_is_not_planned_for_ever():
    """Its failures count for the pairs of the others, which it completes to lineups."""

    def outcome(lineup) -> RankedMatch:
        culprits = tuple(128 * (name == "green@4") for name in lineup)
        valid = 0 if any(culprits) else 128
        return replace(played(lineup, valid), voids=sum(culprits), voids_by_team=culprits)

    config = replace(training(), budget=Budget(steps=1))
    state, log = replace(trio(0, 4), checkpoints=checkpoints(4, players=TRIO)), []
    for _ in range(10):
        lineups = pairs_of(match_scheduler.next_matches(config, with_matches(state, log)))
        log += map(outcome, lineups)
    assert not lineups
    assert with_matches(state, log).ladder.score("red@4", "red@0").voids == 0


@pytest.mark.parametrize("episodes", [0, 64])
def test_the_same_lineup_can_be_planned_again_after_it_has_met(episodes):
    config, state = training(), trio(0, 4)
    ladder = Ladder([s.name for s in state.snapshots], [played(("blue@4", "red@4", "green@4"), episodes)])
    job = match_scheduler.rating_job(config, state, [("blue@4", "red@4", "green@4")], None)
    again = match_scheduler.rating_job(config, replace(state, ladder=ladder), [("blue@4", "red@4", "green@4")], None)
    assert (job.key == again.key) == (episodes == 0)
