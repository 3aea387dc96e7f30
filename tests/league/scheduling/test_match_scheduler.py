"""Rating matches: what shall be played next is read off the store alone, handed over here as values."""

from dataclasses import replace

import pytest

from league.config import experiment as configuration
from league.scheduling import match_scheduler, turn_scheduler
from league.scheduling.match_scheduler import CREDIT
from league.scheduling.progress_metrics import initial_opponents, reference_opponents
from league.state.jobs import RatingMatch, decode
from league.state.league_state import Batches, LeagueState
from league.state.recent_curves import RecentCurve
from league.system.batch_sizes import RATING
from matchmaking.schedule import Schedule
from storage.errors import StorageError
from storage.records import Job, Match
from tests.league.plans import (
    MORE,
    PLAYERS,
    checkpoints,
    league_state,
    match,
    pairs_of,
    snapshots,
    training,
    with_matches,
)

HISTORY = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)


def order(config, state) -> list[frozenset[str]]:
    """The pairs of all batches until nothing is left to play, as their games are planned."""
    played: list[Match] = []
    while pairs := pairs_of(match_scheduler.next_matches(config, with_matches(state, played))):
        played += [match(a, b) for a, b in pairs]
    return [frozenset((m.a, str(m.b))) for m in played]


def test_the_newest_of_all_players_meet_in_the_first_batch_while_players_learn():
    state = league_state(checkpoints=checkpoints(64), snapshots=snapshots(*HISTORY))
    planned = order(training(), state)
    assert planned[0] == {"blue@64", "red@64"}
    assert planned[:3] == [{"blue@64", "red@64"}, {"blue@64", "blue@0"}, {"red@64", "red@0"}]


def test_each_newest_meets_its_parent_and_those_3_and_10_back_before_the_pool_is_played():
    state = league_state(checkpoints=checkpoints(64), snapshots=snapshots(*HISTORY))
    own = [{f"{p}@64", f"{p}@{i}"} for i in (0, 24, 48, 2) for p in ("blue", "red")]  # initial, 3 back, parent, 10 back
    scripts = [{"blue@64", "pusher"}, {"red@64", "pusher"}]
    assert order(training(), state)[: 1 + len(own) + 2] == [{"blue@64", "red@64"}, *own, *scripts]
    copied = [replace(s, parent="red@48") if s.name == "blue@64" else s for s in state.snapshots]
    assert {"blue@64", "red@48"} in order(training(), replace(state, snapshots=copied))[:7]


def test_what_has_been_thinned_is_passed_over_when_going_back():
    gone = {"blue@48", "blue@24"}
    frozen = [replace(s, thinned=1.0 if s.name in gone else None) for s in snapshots(*HISTORY)]
    state = league_state(checkpoints=checkpoints(64), snapshots=frozen)
    met = [pair for pair in order(training(), state)[:11] if "blue@64" in pair]
    assert met == [{"blue@64", other} for other in ("red@64", "blue@0", "blue@12", "blue@32", "pusher")]


def test_every_two_newest_meet_where_there_are_many_players():
    state = league_state(
        checkpoints=checkpoints(4, players=MORE), players=MORE, snapshots=snapshots(0, 1, 4, players=MORE)
    )
    newest = {f"{p.name}@4" for p in MORE}
    planned = order(training(), state)
    assert set().union(*planned[:4]) == newest
    assert len({pair for pair in planned[:20] if pair <= newest}) == 6


def test_one_batch_of_matches_at_a_time():
    open_job = Job("quickstart", RatingMatch.kind, "match:0", state="queued")
    state = league_state(checkpoints=checkpoints(0), snapshots=snapshots(0), jobs=(open_job,))
    assert match_scheduler.next_matches(training(), state) == turn_scheduler.Plan()


def test_when_training_is_over_the_newest_meet_all_yardsticks_until_their_quota():
    config = training()
    state = league_state(checkpoints=checkpoints(64, seconds=300.0), snapshots=snapshots(0, 1, 16, 64, seconds=4.7))
    newest = {s.name: s for s in state.snapshots}
    for name in ("blue", "red"):
        found = [s.name for s in reference_opponents(config, state, newest[f"{name}@64"])]
        assert found == [f"{name}@0", f"{name}@16", "pusher"]
    played: list[Match] = []
    for _ in range(40):
        pairs = pairs_of(match_scheduler.next_matches(config, with_matches(state, played)))
        if not pairs or not all(a in ("blue@64", "red@64") for a, _ in pairs):
            break
        played += [match(a, b) for a, b in pairs]
    met = {}
    for m in played:
        met[m.a, m.b] = met.get((m.a, m.b), 0) + m.wins + m.losses
    wanted = {(f"{p}@64", o) for p in ("blue", "red") for o in (f"{p}@0", f"{p}@16", "pusher")}
    wanted |= {("blue@64", "red@64")}
    assert met == dict.fromkeys(wanted, config.rating.final_episodes_per_pair)


def test_rating_goes_on_until_nothing_is_left_to_play_or_no_time():
    config = replace(training(), budget=configuration.Budget(training_time="5m", rating_time="180s"))
    state = league_state(checkpoints=checkpoints(64, seconds=300.0), snapshots=snapshots(0, 16, 64, seconds=4.7))
    newest = [s for s in state.snapshots if s.iteration == 64]
    told = [match(s.name, o.name, 10**4) for s in newest for o in reference_opponents(config, state, s)]
    assert match_scheduler.rating_goes_on(config, state)
    assert match_scheduler.rating_goes_on(config, with_matches(state, told))  # there are those below the newest
    names = [s.name for s in state.snapshots]
    all_of_them = [match(a, b, 10**4) for i, a in enumerate(names) for b in names[:i]]
    assert not match_scheduler.rating_goes_on(config, with_matches(state, all_of_them))
    (batch,) = match_scheduler.next_matches(config, state).jobs
    assert match_scheduler.rating_goes_on(
        config, replace(with_matches(state, all_of_them), jobs=(replace(batch, state="leased"),))
    )
    over = replace(state, phases={match_scheduler.RATING: match_scheduler.rating_over(config, state)})
    assert not match_scheduler.rating_goes_on(config, over)
    assert match_scheduler.rating_goes_on(config, replace(over, checkpoints=checkpoints(65, seconds=300.0)))
    nobody = replace(config, workers=replace(config.workers, match=0))
    assert not match_scheduler.rating_goes_on(nobody, state)


def test_thinned_snapshots_are_not_rated_and_keep_their_place_on_the_ladder():
    config = replace(training(), budget=configuration.Budget(training_time="5m", rating_time="180s"))
    state = league_state(checkpoints=checkpoints(64, seconds=300.0), snapshots=snapshots(0, 4, 16, 64, seconds=4.7))
    gone = {"blue@4", "red@16"}
    state = replace(state, snapshots=[replace(s, thinned=1.0 if s.name in gone else None) for s in state.snapshots])
    played: list[Match] = []
    while pairs := pairs_of(match_scheduler.next_matches(config, with_matches(state, played))):
        assert gone.isdisjoint(name for pair in pairs for name in pair)
        played += [match(a, b, 10**4) for a, b in pairs]
    assert len(played) > 10
    assert gone < set(with_matches(state, played).ladder.names)


def test_with_unlike_rosters_only_opponents_can_meet_and_initial_is_the_other_side():
    players = tuple(replace(p, roster=f"roster {p.name}") for p in PLAYERS)
    frozen = tuple(s for s in snapshots(0, 1, players=players) if s.player)
    state = league_state(players=players, checkpoints=checkpoints(1), snapshots=frozen)
    newest = next(s for s in frozen if s.name == "blue@1")
    assert [s.name for s in initial_opponents(newest, frozen, players)] == ["red@0"]
    for a, b in pairs_of(match_scheduler.next_matches(training(), state)):
        assert {a.partition("@")[0], b.partition("@")[0]} == {"blue", "red"}


def test_scripts_by_which_training_ends_are_met_before_initial_snapshots():
    config = training()
    config = replace(config, budget=configuration.Budget(score=0.8, against=("pusher",)))
    state = league_state(checkpoints=checkpoints(64), snapshots=snapshots(0, 1, 2, 4, 8, 16, 32, 64))
    asked = [frozenset((f"{name}@64", "pusher")) for name in ("blue", "red")]
    assert order(config, state)[1:3] == asked
    assert set(asked).isdisjoint(order(training(), state)[:3])


@pytest.mark.parametrize("workers", [1, 3])
def test_each_match_worker_gets_a_batch_of_its_own(workers):
    config = training()
    config = replace(config, workers=replace(config.workers, match=workers))
    state = league_state(checkpoints=checkpoints(64), snapshots=snapshots(0, 1, 2, 4, 8, 16, 32, 64))
    jobs = match_scheduler.next_matches(config, state).jobs
    assert len({job.key for job in jobs}) == workers
    pairs = [tuple(sorted(pair)) for job in jobs for pair in decode(job).lineups]
    assert len(set(pairs)) == len(pairs) == workers * RATING["cpu"].pairings


def test_the_pairs_of_a_batch_set_aside_are_tried_alone_and_what_fails_alone_is_left_out():
    config = training()
    state = league_state(checkpoints=checkpoints(4), snapshots=snapshots(0, 1, 2, 4))
    (batch,) = match_scheduler.next_matches(config, state).jobs
    pairs = decode(batch).lineups
    state = replace(state, jobs=(replace(batch, state="failed"),))
    alone = match_scheduler.next_matches(config, state).jobs
    assert [decode(job).lineups for job in alone] == [(pair,) for pair in pairs]
    bad, *good = alone
    played = [match(*decode(job).lineups[0]) for job in good]
    after = replace(with_matches(state, played), jobs=(*state.jobs, replace(bad, state="failed")))
    again = pairs_of(match_scheduler.next_matches(config, after))
    assert again
    assert decode(bad).lineups[0] not in again


def test_the_key_of_a_batch_follows_what_was_played_and_not_how_many_rows_there_are():
    config = training()
    state = league_state(checkpoints=checkpoints(1), snapshots=snapshots(0, 1))
    (first,) = match_scheduler.next_matches(config, state).jobs
    assert (
        match_scheduler.next_matches(config, replace(state, jobs=(replace(first, state="done"),))).jobs[0].key
        == first.key
    )
    later = with_matches(state, [match(a, b) for a, b in decode(first).lineups])
    assert match_scheduler.next_matches(config, later).jobs[0].key != first.key


def test_time_to_rate_goes_on_where_a_restart_left_it_and_begins_anew_after_more_training():
    config = replace(training(), budget=configuration.Budget(training_time="5m", rating_time="180s"))
    state = league_state(checkpoints=checkpoints(64))
    phase = match_scheduler.rating_phase(config, state)
    assert phase.until["seconds"] == 180.0
    kept = {match_scheduler.RATING: replace(phase, created=1000.0)}
    played = [replace(match("blue@64", "blue@0"), created=1100.0)]
    state = league_state(matches=played, checkpoints=checkpoints(64), snapshots=snapshots(0, 64), phases=kept)
    after = match_scheduler.rating_phase(config, state)
    assert (after.number, after.until["seconds"]) == (1, 80.0)
    assert match_scheduler.rating_phase(config, replace(state, checkpoints=checkpoints(65))).until["seconds"] == 180.0


# The share of rating


def sharing(share=0.1, **changes):
    base = training(**changes)
    return replace(base, rating=replace(base.rating, share=share))


def under_way(seconds: float, last: Batches | None = None, **given) -> LeagueState:
    """A league that has been trained for so long, in which there is much to be rated."""
    frozen = snapshots(0, 1, 2, 4, 8, 16, 32, 64)
    return league_state(**{"checkpoints": checkpoints(64, seconds), "snapshots": frozen, "batches": last, **given})


def dues(config, state) -> list[float | None]:
    return [decode(job).due for job in match_scheduler.next_matches(config, state).jobs]


def test_matches_wait_until_training_has_paid_for_the_last_ones():
    last = Batches(due=100.0, seconds=3.0)  # at a tenth it is paid for at second 130
    assert dues(sharing(), under_way(129.9, last)) == []
    assert dues(sharing(), under_way(130.0, last)) == [130.0]
    assert dues(sharing(0.2), under_way(115.0, last)) == [115.0]
    assert dues(sharing(0.01), under_way(290.0, last)) == []


def test_the_first_batch_waits_for_nothing_and_time_saved_for_long_is_forgotten():
    assert dues(sharing(), under_way(0.0)) == [0.0]
    assert dues(sharing(), under_way(250.0)) == [250.0 - CREDIT]
    assert dues(sharing(), under_way(250.0, Batches(10.0, 1.0))) == [250.0 - CREDIT]


@pytest.mark.parametrize("took", [1.5, 60.0])
@pytest.mark.parametrize("share", [0.02, 0.1, 0.4])
def test_what_matches_took_in_all_is_their_share_whatever_a_batch_takes(took, share):
    config, last, rated = sharing(share, iterations_per_turn=16), None, 0.0
    for turn in range(1, 501):  # of 4 s each: 240 s in which nobody asks, then all the time
        state = under_way(4.0 * turn, last)
        config = replace(config, budget=configuration.Budget())
        for _ in range(1000 if turn > 60 else 0):
            if not (due := dues(config, replace(state, batches=last))):
                break
            last, rated = Batches(due[0], took), rated + took
    assert last is not None
    counted = 2000.0 - (240.0 - CREDIT)
    assert share * counted - took - 4.0 <= rated <= share * counted + took


def test_before_anybody_has_learnt_there_is_no_progress_to_be_told():
    state = under_way(0.0, checkpoints=checkpoints(0), snapshots=snapshots(0))
    assert dues(sharing(), state) == []
    assert dues(sharing(), replace(state, snapshots=snapshots(0, 1), ladder=under_way(0.0).ladder)) == [0.0]


def test_each_match_worker_pays():
    config = sharing()
    config = replace(config, workers=replace(config.workers, match=3))
    jobs = match_scheduler.next_matches(config, under_way(50.0, Batches(40.0, 1.0))).jobs
    assert [decode(job).due for job in jobs] == [50.0] * 3
    assert dues(config, under_way(79.0, Batches(50.0, 3 * 1.0))) == []
    assert dues(config, under_way(80.0, Batches(50.0, 3 * 1.0))) == [80.0] * 3


def test_groups_train_on_a_device_each():
    own = dict(checkpoints({"blue": 8, "red": 8, "blue-2": 8, "red-2": 8}, 60.0, MORE))
    state = under_way(0.0, Batches(100.0, 2.0), players=MORE, checkpoints=own, snapshots=snapshots(0, 1, players=MORE))
    assert state.trained(Schedule()) == 120.0  # players of a group learn at the same time
    assert state.trained(Schedule("leapfrog")) == 240.0  # or in turn
    assert dues(sharing(), state) == [120.0]


def test_when_training_is_over_matches_take_all_that_there_is():
    state = under_way(300.0, Batches(299.0, 50.0))
    assert dues(sharing(), state) == [None]
    assert dues(sharing(0.0), state) == [None]
    (turn,) = turn_scheduler.next_turns(sharing(), under_way(299.0)).jobs
    still = replace(state, jobs=(replace(turn, state="leased"),))  # the budget is spent but a turn is open
    assert dues(sharing(), still) == []


def test_in_a_deterministic_league_nothing_hangs_on_how_long_learning_took():
    config = replace(sharing(), deterministic=True, budget=configuration.Budget(steps=10**9))
    logs = []
    for seconds in (9.0, 250.0):
        assert dues(config, under_way(seconds)) == []
        state = under_way(seconds, snapshots=snapshots(0, 1, 16, 64, seconds=seconds / 64))
        over = replace(config, budget=configuration.Budget(steps=1))
        newest = next(s for s in state.snapshots if s.name == "blue@64")
        assert [s.name for s in reference_opponents(over, state, newest)] == ["blue@0", "pusher"]
        logs.append(pairs_of(match_scheduler.next_matches(over, state)))
    assert logs[0] == logs[1]
    assert logs[0]


def test_none_or_all_of_it():
    assert dues(sharing(0.0), under_way(0.0)) == []
    assert dues(sharing(0.0), under_way(250.0)) == []
    assert dues(sharing(1.0), under_way(250.0, Batches(249.0, 500.0))) == [250.0]


def test_another_way_of_counting_training_stops_no_matches():
    """From leapfrog to simultaneous, the group's time is no longer the sum of its players'."""
    assert dues(sharing(), under_way(150.0, Batches(280.0, 5.0))) == [150.0 - CREDIT]


def test_pairs_of_a_batch_set_aside_pay_as_well():
    state = under_way(200.0, Batches(190.0, 0.5))
    (batch,) = match_scheduler.next_matches(sharing(), state).jobs
    failed = replace(state, jobs=(replace(batch, state="failed"),))
    assert dues(sharing(), failed) == [195.0] * 4
    assert dues(sharing(), replace(failed, batches=Batches(195.0, 4.0))) == []


def test_what_a_batch_is_booked_to_does_not_make_it_another():
    (early,) = match_scheduler.next_matches(sharing(), under_way(50.0)).jobs
    (late,) = match_scheduler.next_matches(sharing(), under_way(200.0)).jobs
    assert (early.key, decode(early).seed) == (late.key, decode(late).seed)


def test_trials_that_may_end_a_stage_come_first_and_no_others_hold_them_up():
    frozen = snapshots(0, 1, 2, 4, 8, 16, 32, 64, players=PLAYERS[:1])
    alone = under_way(100.0, players=PLAYERS[:1], checkpoints=checkpoints(64, 100.0, PLAYERS[:1]), snapshots=frozen)
    config = sharing()
    deciding = replace(config, budget=configuration.Budget(success=0.9))
    alone = replace(alone, curves={"blue": RecentCurve(success=0.95)})
    tried = with_matches(alone, [match("blue@64", None, config.rating.episodes_per_pair)])
    assert pairs_of(match_scheduler.next_matches(config, alone)) == [(f"blue@{i}", None) for i in (64, 32, 16, 8)]
    assert pairs_of(match_scheduler.next_matches(deciding, alone)) == [("blue@64", None)]
    assert pairs_of(match_scheduler.next_matches(config, tried)) == [(f"blue@{i}", None) for i in (32, 16, 8, 4)]
    assert pairs_of(match_scheduler.next_matches(deciding, tried)) == []
    flat = replace(config, budget=configuration.Budget(plateau=6))
    assert pairs_of(match_scheduler.next_matches(flat, alone)) == [(f"blue@{i}", None) for i in (64, 32, 16, 8)]
    assert pairs_of(match_scheduler.next_matches(flat, tried)) == []
    over = replace(tried, checkpoints=checkpoints(64, 300.0, PLAYERS[:1]))
    over_config = replace(deciding, budget=configuration.Budget(success=0.9, training_time="5m"))
    assert ("blue@32", None) in pairs_of(match_scheduler.next_matches(over_config, over))


def test_trials_wait_until_training_succeeds_as_often_as_the_stage_asks():
    frozen = snapshots(0, 1, 2, players=PLAYERS[:1])
    config = replace(sharing(), budget=configuration.Budget(success=0.9))

    def dues_at(seconds, batches=None, budget=config.budget, **successes):
        state = under_way(seconds, batches, players=PLAYERS[:1], snapshots=frozen)
        curves = {name: RecentCurve(success=share) for name, share in successes.items()}
        state = replace(state, checkpoints=checkpoints(2, seconds, PLAYERS[:1]), curves=curves)
        return dues(replace(config, budget=budget), state)

    assert dues_at(30.0) == dues_at(30.0, blue=0.89) == []
    assert dues_at(30.0, blue=0.9) == [0.0]
    assert dues_at(119.0, blue=0.5) == []
    assert dues_at(120.0, blue=0.5) == [60.0]  # patience is over, and credit is a minute
    assert dues_at(179.0, Batches(60.0, 5.0), blue=0.5) == []
    assert dues_at(179.0, Batches(60.0, 5.0), blue=0.9) == [119.0]
    assert dues_at(60.0, budget=configuration.Budget(success=0.9, plateau=6), blue=0.5) == [0.0]
    assert dues_at(30.0, budget=configuration.Budget(reward=1.0), blue=0.5) == [0.0]


@pytest.mark.parametrize("ends", [{"score": 0.8, "against": ("idle",)}, {"plateau": 6}])
def test_the_first_batch_of_a_stage_that_ratings_end_waits_for_snapshots_that_could_end_it(ends):
    config = replace(sharing(), budget=configuration.Budget(**ends))

    def dues_at(seconds, iteration, batches=None, config=config):
        frozen = [i for i in (0, 1, 2, 4, 8, 16, 32, 64) if i <= iteration]
        state = under_way(seconds, batches, checkpoints=checkpoints(iteration, seconds), snapshots=snapshots(*frozen))
        return dues(config, state)

    assert dues_at(1.0, 1) == dues_at(20.0, 63) == dues_at(CREDIT - 0.1, 1) == []
    assert dues_at(20.0, 64) == [0.0]  # the second batch is due as if the first had been played at once
    assert dues_at(49.9, 200, Batches(0.0, 5.0)) == []
    assert dues_at(50.0, 200, Batches(0.0, 5.0)) == dues_at(50.0, 32, Batches(0.0, 5.0)) == [50.0]
    assert dues_at(CREDIT, 1) == [0.0]  # from now on waiting would cost time for rating
    assert dues_at(1.0, 1, config=sharing()) == [0.0]  # where ratings end nothing, people read them


def test_a_job_that_an_older_version_queued_is_still_understood():
    job = match_scheduler.next_matches(sharing(), under_way(50.0)).jobs[0]
    old = replace(job, payload={name: value for name, value in job.payload.items() if name != "due"})
    assert decode(old) == replace(decode(job), due=None)
    for odd in ({"pairs": [["a", "b"]]}, {**job.payload, "more": 1}):
        with pytest.raises(StorageError, match="is of no kind that this version knows"):
            decode(replace(job, payload=odd))
