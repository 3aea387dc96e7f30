"""Training turns: the plan is read off the store alone, so these tests hand it stores' contents as values."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from league.config import experiment as configuration
from league.scheduling import turn_scheduler
from league.scheduling.training_progress import trained_enough
from league.state.jobs import RatingMatch, decode
from league.state.league_state import LeagueState
from matchmaking.opponents import Opponents
from matchmaking.schedule import Schedule
from storage.records import Phase
from tests.league.plans import MORE, PLAYERS, checkpoints, league_state, snapshots, training, turns


def test_the_first_turn_only_makes_the_players():
    (turn,) = turns(training(), league_state())
    assert (turn.iterations, turn.learners, turn.bases) == (0, ("blue", "red"), {"blue": "", "red": ""})


def test_turns_end_where_snapshots_are_due_and_never_last_longer_than_a_crash_may_cost():
    ends, at = [], 0
    while at < 80:
        (turn,) = turns(training(iterations_per_turn=16), league_state(checkpoints=checkpoints(at)))
        at += turn.iterations
        ends.append(at)
    assert ends == [1, 2, 4, 8, 16, 32, 48, 64, 80]


def assigned(iterations, known=20, **rule) -> np.ndarray:
    """Which of `known` snapshots of red each of blue's eight groups meets in turns that begin at these iterations."""
    config = training(iterations_per_turn=1, opponents=Opponents("uniform", **rule))
    there = snapshots(*range(known))
    plans = (turns(config, league_state(checkpoints=checkpoints(at), snapshots=there)) for at in iterations)
    return np.array([[int(seats[1].partition("@")[2]) for seats in turn.past["blue"]] for (turn,) in plans])


def test_groups_keep_their_opponents_for_some_episodes_and_change_one_after_the_other():
    met = assigned(range(100, 152))  # 4 episodes of 100 decisions are 13 iterations of 32
    changed = met[1:] != met[:-1]
    assert changed.sum(1).max() == 1
    assert 20 < changed.sum() <= 4 * 8  # 4 periods of 8 groups; a new period may draw the same one
    begins = [k for k in range(52) if (100 + k) % 13 == 0]  # those of the first group
    assert {k + 1 for k in np.flatnonzero(changed[:, 0])} <= set(begins)
    each_turn = assigned(range(100, 104), episodes=0)
    assert (each_turn[1:] != each_turn[:-1]).mean() > 0.8


def test_an_arena_that_does_not_tell_how_long_its_episodes_are_has_a_thousand_decisions():
    config = training(iterations_per_turn=1, opponents=Opponents("uniform"))
    there = snapshots(*range(20))
    for arena in (SimpleNamespace(name="guest"), SimpleNamespace(name="guest", timing=0.02)):
        config = replace(config, arena=arena)
        plans = (turns(config, league_state(checkpoints=checkpoints(at), snapshots=there)) for at in range(125, 251))
        met = np.array([turn.past["blue"] for (turn,) in plans])[:, 0, 1]  # of the first group
        assert len(set(met[:125])) == 1  # 4,000 decisions are 125 iterations of 32
        assert met[125] != met[0]


def test_a_new_snapshot_takes_few_groups_from_the_others():
    before, after = assigned(range(100, 800, 13)), assigned(range(100, 800, 13), known=21)
    assert (before == after)[after < 20].all()
    assert (after == 20).mean() == pytest.approx(1 / 21, abs=0.03)


@pytest.mark.parametrize("schedule", [Schedule("leapfrog", period=5), Schedule("leapfrog", period_steps=5 * 8192 - 1)])
def test_leapfrog_passes_on_after_what_the_learner_learnt_itself_and_the_store_holds_the_phase(schedule):
    config = training(iterations_per_turn=100, schedule=schedule)
    at, phases, seen = {"blue": 0, "red": 0}, {}, []
    while sum(at.values()) < 20:
        planned = turn_scheduler.next_turns(config, league_state(checkpoints=checkpoints(at), phases=phases))
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
    config = replace(training(iterations_per_turn=100, schedule=schedule), budget=configuration.Budget(steps=12 * 8192))
    at, phases, ends = 0, {}, []
    while at < 12:
        copied = at - at % 3  # what the other player has taken over by then
        state = league_state(checkpoints=checkpoints({"blue": at, "red": copied}), phases=phases)
        planned = turn_scheduler.next_turns(config, state)
        (phase,), (job,) = planned.phases, planned.jobs
        phases, turn = {"1": phase}, decode(job)
        assert (turn.learners, turn.phase) == (("blue",), at // 3)
        at += turn.iterations
        ends.append(at)
    assert ends == [1, 2, 3, 4, 6, 8, 9, 12]
    state = league_state(checkpoints=checkpoints({"blue": 12, "red": 12}), phases=phases)
    assert state.spent("1", config.training.schedule) == (0.0, 12 * 8192)
    assert not turns(config, state)


def test_a_phase_by_steps_bounds_its_turns_where_the_number_of_worlds_is_set():
    at = checkpoints({"blue": 40, "red": 8})
    phase = Phase("quickstart", "1", 4, ("blue",), {"blue": 38, "red": 8}, {"step": 43 * 8192 - 100})
    state = league_state(checkpoints=at, phases={"1": phase})
    for worlds, iterations in ((256, 3), (128, 6), (None, 16)):  # none: each machine has its own, and its trainer looks
        config = training(schedule=Schedule("leapfrog", period_steps=1))
        (turn,) = turns(replace(config, training=replace(config.training, worlds=worlds)), state)
        assert (turn.learners, turn.phase, turn.iterations) == (("blue",), 4, iterations)


def test_one_open_turn_for_each_group_and_none_when_its_budget_is_spent():
    config = training()
    state = league_state(checkpoints=checkpoints(0))
    (job,) = turn_scheduler.next_turns(config, state).jobs
    assert not turns(config, replace(state, jobs=(replace(job, state="leased"),)))
    assert not turns(config, league_state(checkpoints=checkpoints(9, seconds=300.0)))
    assert turns(config, league_state(checkpoints=checkpoints(9, seconds=299.0)))


def test_several_groups_have_turns_open_at_once_each_with_its_own_players_and_iterations():
    at = checkpoints({"blue": 4, "red": 4, "blue-2": 1, "red-2": 1})
    first, second = turns(training(), league_state(players=MORE, checkpoints=at))
    assert (first.learners, second.learners) == (("blue", "red"), ("blue-2", "red-2"))
    assert (first.iterations, second.iterations) == (4, 1)
    assert set(first.bases) == {"blue", "red"}


def test_a_turn_set_aside_stops_its_own_group_and_no_other():
    config, at = training(), checkpoints(4, players=MORE)
    state = league_state(players=MORE, checkpoints=at)
    first, second = turn_scheduler.next_turns(config, state).jobs
    state = replace(state, jobs=(replace(first, state="failed"),))
    assert [turn.group for turn in turns(config, state)] == ["2"]
    assert not trained_enough(config, state)
    both = replace(state, jobs=tuple(replace(job, state="failed") for job in (first, second)))
    assert trained_enough(config, both)


def test_a_turn_that_was_gone_back_from_is_another_job_with_other_dice():
    config, at = training(), checkpoints(4)
    (before,) = turn_scheduler.next_turns(config, league_state(checkpoints=at)).jobs
    back = (replace(PLAYERS[0], setbacks=1), PLAYERS[1])
    (after,) = turn_scheduler.next_turns(config, league_state(players=back, checkpoints=at)).jobs
    assert decode(before).retry == 0
    assert decode(after).retry == 1
    assert before.key != after.key


def test_a_paused_player_sits_on_and_learns_no_more():
    paused = (replace(PLAYERS[0], paused="it diverged twice"), PLAYERS[1])
    (turn,) = turns(training(), league_state(players=paused, checkpoints=checkpoints(4)))
    assert turn.learners == ("red",)
    assert turn.present == ("blue", "red")
    none = tuple(replace(p, paused="it diverged twice") for p in PLAYERS)
    assert trained_enough(training(), league_state(players=none, checkpoints=checkpoints(4)))


def test_setbacks_of_a_paused_player_repeat_no_turn_of_others_until_it_is_resumed():
    at = checkpoints(4)
    paused = (replace(PLAYERS[0], setbacks=2, paused="it diverged twice"), PLAYERS[1])
    (turn,) = turns(training(), league_state(players=paused, checkpoints=at))
    assert (turn.learners, turn.retry) == (("red",), 0)
    resumed = (replace(paused[0], paused=None), PLAYERS[1])
    (turn,) = turns(training(), league_state(players=resumed, checkpoints=at))
    assert (turn.learners, turn.retry) == (("blue", "red"), 2)


def test_turns_before_and_after_a_pause_are_other_jobs_even_where_the_same_player_learns():
    config, at = training(schedule=Schedule("leapfrog", period=100)), checkpoints(4)
    keys = []
    for setbacks, reason in ((0, None), (1, None), (2, "its critic diverged twice"), (2, None)):  # red rests
        players = (PLAYERS[0], replace(PLAYERS[1], setbacks=setbacks, paused=reason))
        (job,) = turn_scheduler.next_turns(config, league_state(players=players, checkpoints=at)).jobs
        assert decode(job).learners == ("blue",)
        keys.append(job.key)
    assert len(set(keys[:3])) == 3
    assert keys[3] not in keys[:2]


def test_a_budget_in_steps_is_met_within_one_iteration():
    config = replace(training(iterations_per_turn=100), budget=configuration.Budget(steps=10 * 8192 + 1))
    (turn,) = turns(config, league_state(checkpoints=checkpoints(8)))
    assert turn.iterations == 3
    assert not turns(config, league_state(checkpoints=checkpoints(11)))


def test_past_opponents_are_drawn_for_each_learner_from_the_others_and_by_the_seed():
    config = training(opponents=Opponents("uniform", past=0.5, groups=6))
    state = league_state(checkpoints=checkpoints(4), snapshots=snapshots(0, 1, 2, 4))
    (turn,) = turns(config, state)
    assert set(turn.past) == {"blue", "red"}
    assert len(turn.past["blue"]) == 3
    assert all(own == "" and other.startswith("red@") for own, other in turn.past["blue"])
    assert turns(config, state)[0].past == turn.past
    others = [turns(replace(config, seed=s), state)[0].past for s in range(2, 8)]
    assert any(other != turn.past for other in others)


def test_past_opponents_come_from_every_player_of_the_other_team():
    config = training(opponents=Opponents("uniform", past=0.9, groups=16))
    state = league_state(
        players=MORE, checkpoints=checkpoints(4, players=MORE), snapshots=snapshots(0, 1, 2, 4, players=MORE)
    )
    met = {name.partition("@")[0] for turn in turns(config, state) for _, name in turn.past.get(turn.learners[0], ())}
    assert met == {"red", "red-2"}


def test_phases_and_jobs_survive_the_stores_json():
    phase = Phase("quickstart", "1", 0, ("blue",), {"blue": 0}, {"iterations": 5})
    config = training(schedule=Schedule("leapfrog", period=5))
    (turn,) = turns(config, league_state(checkpoints=checkpoints(0), phases={"1": phase}))
    assert turn.learners == ("blue",)
    task = RatingMatch((("a", "b"), ("c", None)), 7)
    import json

    from league.state.jobs import encode

    job = encode("quickstart", task, "x")
    assert decode(replace(job, payload=json.loads(json.dumps(job.payload)))) == task


# The turn that a worker goes on with --------------------------------------------------------------------------------

THREE = tuple(replace(p, name=f"{p.name}-{group}", group=group) for p in PLAYERS for group in "123")
DECISIONS = 320  # of the longest episode: 10 iterations of 32


def waiting(at: dict[str, int], **changes) -> tuple[configuration.Config, LeagueState, dict[str, str]]:
    """Settings, a league whose groups are at these iterations and all wait for a turn, and the keys of the turns.

    A turn of a fourth group is under way.
    """
    config = training(iterations_per_turn=4, **changes)
    newest = checkpoints({p.name: at[p.group] for p in THREE}, players=THREE)
    state = league_state(players=THREE, checkpoints=newest)
    jobs = turn_scheduler.next_turns(config, state).jobs
    elsewhere = replace(jobs[0], key="elsewhere", payload={**jobs[0].payload, "group": "4"}, state="leased")
    return config, replace(state, jobs=(elsewhere, *jobs)), {decode(job).group: job.key for job in jobs}


def continued(at: dict[str, int], own: str, **changes) -> str | None:
    """The group with which a worker goes on that has done the last turn of the groups `own`."""
    config, state, keys = waiting(at, **changes)
    kept = {g: {p.name: state.checkpoints[p.name].digest for p in THREE if p.group == g} for g in own}
    chosen = turn_scheduler.continued_turn(config, state, (), kept, DECISIONS)
    queued = state.jobs[1:]
    assert chosen == turn_scheduler.continued_turn(config, replace(state, jobs=state.jobs[:1]), queued, kept, DECISIONS)
    return next((group for group, key in keys.items() if key == chosen), None)


@pytest.mark.parametrize(
    ("at", "own", "group"),
    [
        ((100, 100, 100), "2", "2"),
        ((100, 100, 99), "13", "3"),  # the least trained of its own
        ((100, 119, 110), "2", "2"),
        ((100, 120, 110), "2", None),  # two longest episodes ahead of one that waits
        ((100, 120, 110), "12", "1"),
        ((100, 120, 100), "12", "1"),  # the other one is no reason to leave this one
        ((100, 81, 120), "2", "2"),
        ((100, 60, 90), "2", None),  # four behind: a faster worker may take it
        ((100, 100, 100), "", None),
    ],
)
def test_a_worker_goes_on_with_the_least_trained_of_its_groups_while_no_other_lags(at, own, group):
    assert continued(dict(zip("123", at, strict=True)), own) == group


def test_groups_whose_players_learn_in_turn_are_as_far_as_their_players_together():
    at = {"1": 100, "2": 109, "3": 100}
    assert continued(at, "2") == "2"
    leapfrog = Schedule("leapfrog", period=1000)
    assert continued(at, "2", schedule=leapfrog) == "2"
    assert continued({**at, "2": 110}, "2") == "2"
    assert continued({**at, "2": 110}, "2", schedule=leapfrog) is None


def test_longer_turns_than_episodes_are_the_measure():
    config, state, keys = waiting({"1": 100, "2": 107, "3": 100})
    kept = {"2": {p.name: state.checkpoints[p.name].digest for p in THREE if p.group == "2"}}
    assert turn_scheduler.continued_turn(config, state, (), kept, longest=1) == keys["2"]
    assert turn_scheduler.continued_turn(training(iterations_per_turn=3), state, (), kept, longest=1) is None


def test_a_worker_prefers_no_turn_whose_players_another_one_has_trained_since_and_none_where_none_can_be_lost():
    config, state, keys = waiting({"1": 100, "2": 100, "3": 100})
    kept = {"2": {p.name: state.checkpoints[p.name].digest for p in THREE if p.group == "2"}}
    assert turn_scheduler.continued_turn(config, state, (), kept, DECISIONS) == keys["2"]
    before = {"2": {**kept["2"], "red-2": "an earlier one"}}
    assert turn_scheduler.continued_turn(config, state, (), before, DECISIONS) is None
    alone = replace(state, jobs=state.jobs[1:])
    assert turn_scheduler.continued_turn(config, alone, (), kept, DECISIONS) is None
    fixed = replace(config, deterministic=True, budget=configuration.Budget(steps=10**9))
    assert turn_scheduler.continued_turn(fixed, state, (), kept, DECISIONS) is None
