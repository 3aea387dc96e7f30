"""The plan is read off the store alone, so these tests hand it stores' contents as values."""

from dataclasses import replace

import pytest

from league import matches, plan
from league.config import experiment as configuration
from league.config import presets
from league.jobs import RatingMatch, TrainingTurn, decode
from league.measures import initial_opponents, yardsticks
from league.share import CREDIT
from league.standing import Batches, Standing
from matchmaking.ladder import Ladder
from matchmaking.opponents import Opponents
from matchmaking.schedule import Schedule
from storage.errors import StorageError
from storage.records import ArenaKey, Checkpoint, Job, Match, PairCounts, Phase, Player, Snapshot

KEY = ArenaKey("sumo-2v2", "0", "c")
PLAYERS = tuple(Player("quickstart", name, team, "main", "rover") for team, name in enumerate(("blue", "red")))
MORE = (*PLAYERS, *(replace(p, name=f"{p.name}-2", group="2") for p in PLAYERS))


def checkpoints(iteration, seconds=0.0, players=PLAYERS):
    if isinstance(iteration, int):
        iteration = {p.name: iteration for p in players}
    return {name: Checkpoint("quickstart", name, f"{name}:{i}", i * 8192, i, seconds) for name, i in iteration.items()}


def snapshots(*iterations: int, seconds: float = 1.0, players=PLAYERS) -> tuple[Snapshot, ...]:
    frozen = tuple(
        Snapshot(
            "quickstart", f"{p.name}@{i}", f"digest of {p.name}@{i}", p.roster, p.name, initial=i == 0, step=i * 8192,
            iteration=i, seconds=i * seconds,
        )
        for i in iterations
        for p in players
    )  # fmt: skip
    return (Snapshot("quickstart", "pusher", "p", "rover", script="pusher", origin="scripted"), *frozen)


def standing(matches=(), **given) -> Standing:
    empty = {"players": PLAYERS, "snapshots": (), "checkpoints": {}, "phases": {}, "jobs": ()}
    values = {**empty, **given}
    names = [s.name for s in values["snapshots"]]
    played = max((m.created for m in matches), default=0.0)
    ladder = Ladder(names, matches, [s.name for s in values["snapshots"] if s.initial])
    return Standing(**values, ladder=ladder, played=played)


def match(a: str, b: str | None, games: int = 128) -> Match:
    half = games // 2
    pairs = PairCounts(0, 0, half, 0, 0) if b else PairCounts()
    return Match("quickstart", KEY, a, b, half, 0, half, 0, half // 2, 0, half // 2, pairs, 1)


def training(**changes):
    base = presets.quickstart()
    return replace(base, training=replace(base.training, worlds=256, **changes))


def turns(config, state) -> list[TrainingTurn]:
    return [decode(job) for job in plan.next_turns(config, state).jobs]


def pairs_of(planned) -> list[tuple]:
    return [pair for job in planned.jobs for pair in decode(job).pairs]


# Training


def test_the_first_turn_only_makes_the_players():
    (turn,) = turns(training(), standing())
    assert (turn.iterations, turn.learners, turn.bases) == (0, ("blue", "red"), {"blue": "", "red": ""})


def test_turns_end_where_snapshots_are_due_and_never_last_longer_than_a_crash_may_cost():
    ends, at = [], 0
    while at < 80:
        (turn,) = turns(training(turn=16), standing(checkpoints=checkpoints(at)))
        at += turn.iterations
        ends.append(at)
    assert ends == [1, 2, 4, 8, 16, 32, 48, 64, 80]


@pytest.mark.parametrize("schedule", [Schedule("leapfrog", period=5), Schedule("leapfrog", period_steps=5 * 8192 - 1)])
def test_leapfrog_passes_on_after_what_the_learner_learnt_itself_and_the_store_holds_the_phase(schedule):
    config = training(turn=100, schedule=schedule)
    at, phases, seen = {"blue": 0, "red": 0}, {}, []
    while sum(at.values()) < 20:
        planned = plan.next_turns(config, standing(checkpoints=checkpoints(at), phases=phases))
        (phase,), (job,) = planned.phases, planned.jobs
        phases = {"1": phase}
        turn = decode(job)
        assert turn.phase == phase.number
        (learner,) = turn.learners
        at[learner] += turn.iterations
        seen += [learner] * turn.iterations
    assert seen == ["blue"] * 5 + ["red"] * 5 + ["blue"] * 5 + ["red"] * 5


@pytest.mark.parametrize("schedule", [Schedule("ladder", period=3), Schedule("ladder", period_steps=3 * 8192)])
def test_in_ladder_turns_end_with_the_phase_and_the_copies_are_no_learning_of_their_own(schedule):
    config = replace(training(turn=100, schedule=schedule), budget=configuration.Budget(steps=12 * 8192))
    at, phases, ends = 0, {}, []
    while at < 12:
        copied = at - at % 3  # what the other player has taken over by then
        state = standing(checkpoints=checkpoints({"blue": at, "red": copied}), phases=phases)
        planned = plan.next_turns(config, state)
        (phase,), (job,) = planned.phases, planned.jobs
        phases, turn = {"1": phase}, decode(job)
        assert (turn.learners, turn.phase) == (("blue",), at // 3)
        at += turn.iterations
        ends.append(at)
    assert ends == [1, 2, 3, 4, 6, 8, 9, 12]
    state = standing(checkpoints=checkpoints({"blue": 12, "red": 12}), phases=phases)
    assert plan.spent(config, state, "1") == (0.0, 12 * 8192)
    assert not turns(config, state)


def test_a_phase_by_steps_bounds_its_turns_where_the_number_of_worlds_is_set():
    at = checkpoints({"blue": 40, "red": 8})
    phase = Phase("quickstart", "1", 4, ("blue",), {"blue": 38, "red": 8}, {"step": 43 * 8192 - 100})
    state = standing(checkpoints=at, phases={"1": phase})
    for worlds, iterations in ((256, 3), (128, 6), (None, 16)):  # none: each machine has its own, and its trainer looks
        config = training(schedule=Schedule("leapfrog", period_steps=1))
        (turn,) = turns(replace(config, training=replace(config.training, worlds=worlds)), state)
        assert (turn.learners, turn.phase, turn.iterations) == (("blue",), 4, iterations)


def test_one_open_turn_for_each_group_and_none_when_its_budget_is_spent():
    config = training()
    state = standing(checkpoints=checkpoints(0))
    (job,) = plan.next_turns(config, state).jobs
    assert not turns(config, replace(state, jobs=(replace(job, state="leased"),)))
    assert not turns(config, standing(checkpoints=checkpoints(9, seconds=300.0)))
    assert turns(config, standing(checkpoints=checkpoints(9, seconds=299.0)))


def test_several_groups_have_turns_open_at_once_each_with_its_own_players_and_iterations():
    at = checkpoints({"blue": 4, "red": 4, "blue-2": 1, "red-2": 1})
    first, second = turns(training(), standing(players=MORE, checkpoints=at))
    assert (first.learners, second.learners) == (("blue", "red"), ("blue-2", "red-2"))
    assert (first.iterations, second.iterations) == (4, 1)
    assert set(first.bases) == {"blue", "red"}


def test_a_turn_set_aside_stops_its_own_group_and_no_other():
    config, at = training(), checkpoints(4, players=MORE)
    state = standing(players=MORE, checkpoints=at)
    first, second = plan.next_turns(config, state).jobs
    state = replace(state, jobs=(replace(first, state="failed"),))
    assert [turn.group for turn in turns(config, state)] == ["2"]
    assert not plan.trained_enough(config, state)
    both = replace(state, jobs=tuple(replace(job, state="failed") for job in (first, second)))
    assert plan.trained_enough(config, both)


def test_a_turn_that_was_gone_back_from_is_another_job_with_other_dice():
    config, at = training(), checkpoints(4)
    (before,) = plan.next_turns(config, standing(checkpoints=at)).jobs
    back = (replace(PLAYERS[0], setbacks=1), PLAYERS[1])
    (after,) = plan.next_turns(config, standing(players=back, checkpoints=at)).jobs
    assert decode(before).dice == 0
    assert decode(after).dice == 1
    assert before.key != after.key


def test_a_paused_player_sits_on_and_learns_no_more():
    paused = (replace(PLAYERS[0], paused="it diverged twice"), PLAYERS[1])
    (turn,) = turns(training(), standing(players=paused, checkpoints=checkpoints(4)))
    assert turn.learners == ("red",)
    assert turn.present == ("blue", "red")
    none = tuple(replace(p, paused="it diverged twice") for p in PLAYERS)
    assert plan.trained_enough(training(), standing(players=none, checkpoints=checkpoints(4)))


def test_a_budget_in_steps_is_met_within_one_iteration():
    config = replace(training(turn=100), budget=configuration.Budget(steps=10 * 8192 + 1))
    (turn,) = turns(config, standing(checkpoints=checkpoints(8)))
    assert turn.iterations == 3
    assert not turns(config, standing(checkpoints=checkpoints(11)))


def test_past_opponents_are_drawn_for_each_learner_from_the_others_and_by_the_seed():
    config = training(opponents=Opponents("uniform", past=0.5, groups=6))
    state = standing(checkpoints=checkpoints(4), snapshots=snapshots(0, 1, 2, 4))
    (turn,) = turns(config, state)
    assert set(turn.past) == {"blue", "red"}
    assert len(turn.past["blue"]) == 3
    assert all(own == "" and other.startswith("red@") for own, other in turn.past["blue"])
    assert turns(config, state)[0].past == turn.past
    others = [turns(replace(config, seed=s), state)[0].past for s in range(2, 8)]
    assert any(other != turn.past for other in others)


def test_past_opponents_come_from_every_player_of_the_other_team():
    config = training(opponents=Opponents("uniform", past=0.9, groups=16))
    state = standing(
        players=MORE, checkpoints=checkpoints(4, players=MORE), snapshots=snapshots(0, 1, 2, 4, players=MORE)
    )
    met = {name.partition("@")[0] for turn in turns(config, state) for _, name in turn.past.get(turn.learners[0], ())}
    assert met == {"red", "red-2"}


# Rating


def test_a_new_snapshot_first_meets_its_own_initial_one():
    state = standing(checkpoints=checkpoints(1), snapshots=snapshots(0, 1))
    pairs = pairs_of(matches.next_matches(training(), state))
    assert {("blue@1", "blue@0"), ("red@1", "red@0")} <= set(pairs)
    assert all(a != b for a, b in pairs)


def test_one_batch_of_matches_at_a_time():
    open_job = Job("quickstart", RatingMatch.kind, "match:0", state="queued")
    state = standing(checkpoints=checkpoints(0), snapshots=snapshots(0), jobs=(open_job,))
    assert matches.next_matches(training(), state) == plan.Plan()


def test_when_training_is_over_the_newest_meet_all_yardsticks_until_their_quota():
    config = training()
    state = standing(checkpoints=checkpoints(64, seconds=300.0), snapshots=snapshots(0, 1, 16, 64, seconds=4.7))
    newest = {s.name: s for s in state.snapshots}
    for name in ("blue", "red"):
        found = [s.name for s in yardsticks(config, state, newest[f"{name}@64"])]
        assert found == [f"{name}@0", f"{name}@16", "pusher"]
    played: list[Match] = []
    for _ in range(40):
        pairs = pairs_of(matches.next_matches(config, _with(state, played)))
        if not pairs or not all(a in ("blue@64", "red@64") for a, _ in pairs):
            break
        played += [match(a, b) for a, b in pairs]
    met = {}
    for m in played:
        met[m.a, m.b] = met.get((m.a, m.b), 0) + m.wins + m.losses
    wanted = {(f"{p}@64", o) for p in ("blue", "red") for o in (f"{p}@0", f"{p}@16", "pusher")}
    assert met == dict.fromkeys(wanted, config.rating.final_quota)


def test_rating_was_cut_short_while_a_newest_snapshot_lacks_its_quota_against_a_yardstick_or_alone():
    config, newest = training(), ("blue@16", "red@16")
    state = standing(snapshots=snapshots(0, 16))
    assert matches.cut_short(config, state)
    met = [match(a, b) for a in newest for b in (a.replace("16", "0"), "pusher")]
    assert matches.cut_short(config, _with(state, met[:-1]))
    assert not matches.cut_short(config, _with(state, met))
    alone = standing(players=PLAYERS[:1], snapshots=snapshots(0, 16, players=PLAYERS[:1]))
    assert matches.cut_short(config, alone)
    assert matches.cut_short(config, _with(alone, [match("blue@16", None, config.rating.quota - 2)]))
    assert not matches.cut_short(config, _with(alone, [match("blue@16", None, config.rating.quota)]))


def _with(state: Standing, played) -> Standing:
    names = [s.name for s in state.snapshots]
    return replace(state, ladder=Ladder(names, tuple(played), [s.name for s in state.snapshots if s.initial]))


def test_with_unlike_rosters_only_opponents_can_meet_and_initial_is_the_other_side():
    players = tuple(replace(p, roster=f"roster {p.name}") for p in PLAYERS)
    frozen = tuple(s for s in snapshots(0, 1, players=players) if s.player)
    state = standing(players=players, checkpoints=checkpoints(1), snapshots=frozen)
    newest = next(s for s in frozen if s.name == "blue@1")
    assert [s.name for s in initial_opponents(newest, frozen, players)] == ["red@0"]
    for a, b in pairs_of(matches.next_matches(training(), state)):
        assert {a.partition("@")[0], b.partition("@")[0]} == {"blue", "red"}


@pytest.mark.parametrize("workers", [1, 3])
def test_each_match_worker_gets_a_batch_of_its_own(workers):
    config = training()
    config = replace(config, workers=replace(config.workers, match=workers))
    state = standing(checkpoints=checkpoints(64), snapshots=snapshots(0, 1, 2, 4, 8, 16, 32, 64))
    jobs = matches.next_matches(config, state).jobs
    assert len({job.key for job in jobs}) == workers
    pairs = [tuple(sorted(pair)) for job in jobs for pair in decode(job).pairs]
    assert len(set(pairs)) == len(pairs) == workers * config.rating.pairings


def test_the_pairs_of_a_batch_set_aside_are_tried_alone_and_what_fails_alone_is_left_out():
    config = training()
    state = standing(checkpoints=checkpoints(4), snapshots=snapshots(0, 1, 2, 4))
    (batch,) = matches.next_matches(config, state).jobs
    pairs = decode(batch).pairs
    state = replace(state, jobs=(replace(batch, state="failed"),))
    alone = matches.next_matches(config, state).jobs
    assert [decode(job).pairs for job in alone] == [(pair,) for pair in pairs]
    bad, *good = alone
    played = [match(*decode(job).pairs[0]) for job in good]
    after = replace(_with(state, played), jobs=(*state.jobs, replace(bad, state="failed")))
    again = pairs_of(matches.next_matches(config, after))
    assert again
    assert decode(bad).pairs[0] not in again


def test_the_key_of_a_batch_follows_what_was_played_and_not_how_many_rows_there_are():
    config = training()
    state = standing(checkpoints=checkpoints(1), snapshots=snapshots(0, 1))
    (first,) = matches.next_matches(config, state).jobs
    assert matches.next_matches(config, replace(state, jobs=(replace(first, state="done"),))).jobs[0].key == first.key
    later = _with(state, [match(a, b) for a, b in decode(first).pairs])
    assert matches.next_matches(config, later).jobs[0].key != first.key


def test_time_to_rate_goes_on_where_a_restart_left_it_and_begins_anew_after_more_training():
    config = replace(training(), budget=configuration.Budget(train="5m", rate="180s"))
    state = standing(checkpoints=checkpoints(64))
    phase = matches.rating_phase(config, state)
    assert phase.until["seconds"] == 180.0
    kept = {matches.RATING: replace(phase, created=1000.0)}
    played = [replace(match("blue@64", "blue@0"), created=1100.0)]
    state = standing(matches=played, checkpoints=checkpoints(64), snapshots=snapshots(0, 64), phases=kept)
    after = matches.rating_phase(config, state)
    assert (after.number, after.until["seconds"]) == (1, 80.0)
    assert matches.rating_phase(config, replace(state, checkpoints=checkpoints(65))).until["seconds"] == 180.0


def test_phases_and_jobs_survive_the_stores_json():
    phase = Phase("quickstart", "1", 0, ("blue",), {"blue": 0}, {"iterations": 5})
    config = training(schedule=Schedule("leapfrog", period=5))
    (turn,) = turns(config, standing(checkpoints=checkpoints(0), phases={"1": phase}))
    assert turn.learners == ("blue",)
    task = RatingMatch((("a", "b"), ("c", None)), 7)
    import json

    from league.jobs import encode

    job = encode("quickstart", task, "x")
    assert decode(replace(job, payload=json.loads(json.dumps(job.payload)))) == task


# The share of rating


def sharing(share=0.1, **changes):
    base = training(**changes)
    return replace(base, rating=replace(base.rating, share=share))


def under_way(seconds: float, last: Batches | None = None, **given) -> Standing:
    """A league that has been trained for so long, in which there is much to be rated."""
    frozen = snapshots(0, 1, 2, 4, 8, 16, 32, 64)
    return standing(**{"checkpoints": checkpoints(64, seconds), "snapshots": frozen, "batches": last, **given})


def dues(config, state) -> list[float | None]:
    return [decode(job).due for job in matches.next_matches(config, state).jobs]


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
    config, last, rated = sharing(share, turn=16), None, 0.0
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
    jobs = matches.next_matches(config, under_way(50.0, Batches(40.0, 1.0))).jobs
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
    (turn,) = plan.next_turns(sharing(), under_way(299.0)).jobs
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
        assert [s.name for s in yardsticks(over, state, newest)] == ["blue@0", "pusher"]
        logs.append(pairs_of(matches.next_matches(over, state)))
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
    (batch,) = matches.next_matches(sharing(), state).jobs
    failed = replace(state, jobs=(replace(batch, state="failed"),))
    assert dues(sharing(), failed) == [195.0] * 4
    assert dues(sharing(), replace(failed, batches=Batches(195.0, 4.0))) == []


def test_what_a_batch_is_booked_to_does_not_make_it_another():
    (early,) = matches.next_matches(sharing(), under_way(50.0)).jobs
    (late,) = matches.next_matches(sharing(), under_way(200.0)).jobs
    assert (early.key, decode(early).seed) == (late.key, decode(late).seed)


def test_trials_that_may_end_a_stage_come_first_and_no_others_hold_them_up():
    frozen = snapshots(0, 1, 2, 4, 8, 16, 32, 64, players=PLAYERS[:1])
    alone = under_way(100.0, players=PLAYERS[:1], checkpoints=checkpoints(64, 100.0, PLAYERS[:1]), snapshots=frozen)
    config = sharing()
    deciding = replace(config, budget=configuration.Budget(success=0.9))
    tried = _with(alone, [match("blue@64", None, config.rating.quota)])
    for each in (config, deciding):
        assert pairs_of(matches.next_matches(each, alone)) == [(f"blue@{i}", None) for i in (64, 32, 16, 8)]
    assert pairs_of(matches.next_matches(config, tried)) == [(f"blue@{i}", None) for i in (32, 16, 8, 4)]
    assert pairs_of(matches.next_matches(deciding, tried)) == []
    over = replace(tried, checkpoints=checkpoints(64, 300.0, PLAYERS[:1]))
    over_config = replace(deciding, budget=configuration.Budget(success=0.9, train="5m"))
    assert ("blue@32", None) in pairs_of(matches.next_matches(over_config, over))


def test_a_job_that_an_older_version_queued_is_still_understood():
    job = matches.next_matches(sharing(), under_way(50.0)).jobs[0]
    old = replace(job, payload={name: value for name, value in job.payload.items() if name != "due"})
    assert decode(old) == replace(decode(job), due=None)
    for odd in ({"pairs": [["a", "b"]]}, {**job.payload, "more": 1}):
        with pytest.raises(StorageError, match="is of no kind that this version knows"):
            decode(replace(job, payload=odd))
