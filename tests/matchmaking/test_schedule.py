from dataclasses import replace

import pytest

from matchmaking.schedule import LearningCounts, Schedule, first_phase, next_due, next_phase, phase_score, remaining

TEAMS = {0: "blue", 1: "red", 2: "gold"}


def learnt(blue=0, red=0, gold=0):
    """So many iterations of 100 steps."""
    return {name: LearningCounts(n, 100 * n) for name, n in (("blue", blue), ("red", red), ("gold", gold))}


def begin(schedule, available=TEAMS, at=0):
    return first_phase(schedule, "cup", "1", available, learnt(at, at, at))


def live(schedule, rounds, available=TEAMS, phase=None, at=None):
    """The learners of each iteration, all of them learning by their own counts, 100 steps each time."""
    at = learnt() if at is None else at
    phase, seen = phase or first_phase(schedule, "cup", "1", available, at), []
    for _ in range(rounds):
        phase = next_phase(schedule, phase, available, at) or phase
        seen.append("+".join(phase.learners))
        at |= {name: LearningCounts(at[name].iterations + 1, at[name].steps + 100) for name in phase.learners}
    return seen, phase


def test_leapfrog_takes_turns_by_the_learners_own_iterations():
    schedule = Schedule("leapfrog", period=2, learner=1)
    seen, phase = live(schedule, 8)
    assert seen == ["red", "red", "gold", "gold", "blue", "blue", "red", "red"]
    assert (phase.number, phase.until) == (3, {"iterations": 2})
    assert phase.since == {"blue": 2, "red": 2, "gold": 2}
    assert remaining(phase, learnt(red=3)) == 1


def test_a_phase_counts_from_where_its_learner_stood():
    schedule = Schedule("leapfrog", period=5)
    phase = begin(schedule, at=37)
    assert next_phase(schedule, phase, TEAMS, learnt(41, 90)) is None
    after = next_phase(schedule, phase, TEAMS, learnt(42, 90))
    assert after is not None
    assert (after.learners, after.since["red"]) == (("red",), 90)


def test_by_steps_a_turn_ends_with_the_iteration_that_reaches_them_and_the_next_counts_from_nothing():
    schedule = Schedule("leapfrog", period=1, period_steps=250)
    seen, phase = live(schedule, 10)
    assert seen == ["blue"] * 3 + ["red"] * 3 + ["gold"] * 3 + ["blue"]
    assert (phase.number, phase.until) == (3, {"step": 550})  # of blue's own, which has had 300
    assert remaining(phase, {"blue": LearningCounts(4, 400), "red": LearningCounts(99, 9900)}) == 150
    assert live(replace(schedule, period_steps=300), 7)[0] == ["blue"] * 3 + ["red"] * 3 + ["gold"]


def test_a_turn_ends_when_its_learner_surely_scores_enough_or_at_its_cap():
    schedule = Schedule("leapfrog", period=5, until_score=0.7)
    phase = begin(schedule)
    assert phase.until == {"iterations": 5, "score": 0.7}
    assert next_phase(schedule, phase, TEAMS, {**learnt(blue=2), "blue": LearningCounts(2, 200, low=0.7)}) is None
    after = next_phase(schedule, phase, TEAMS, {**learnt(blue=2), "blue": LearningCounts(2, 200, low=0.71)})
    assert after is not None
    assert (after.learners, after.until) == (("red",), {"iterations": 5, "score": 0.7})
    capped = next_phase(schedule, phase, TEAMS, learnt(blue=5))
    assert capped is not None
    assert capped.learners == ("red",)
    steps = begin(replace(schedule, period_steps=300), at=1)
    assert steps.until == {"step": 400, "score": 0.7}
    assert [remaining(steps, {"blue": LearningCounts(3, 300, low)}) for low in (0.6, 0.8)] == [100, 0]


def test_a_turns_score_is_that_of_its_newest_500_episodes_and_says_how_sure_it_is():
    assert phase_score([(400, 0.1), (300, 0.8), (200, 0.7)])[::3] == (0.76, 500)
    assert phase_score([(300, 0.8), (199, 0.7), (1, 0.0)])[3] == 500
    few, many = phase_score([(10, 0.9)]), phase_score([(500, 0.9)])
    assert few.low < 0.7 < many.low < 0.9  # Wilson's: 0.596 and 0.871
    assert (few.low, many.low) == pytest.approx((0.5958, 0.8706), abs=1e-3)
    assert phase_score([])[1:4] == (0.0, 1.0, 0)


def test_a_turn_that_has_begun_ends_as_it_was_meant_to_when_it_began():
    by_steps, by_iterations = Schedule("leapfrog", period_steps=250), Schedule("leapfrog", period=2)
    phase = begin(by_steps)
    assert next_phase(by_iterations, phase, TEAMS, learnt(blue=2)) is None
    after = next_phase(by_iterations, phase, TEAMS, learnt(blue=3))
    assert after is not None
    assert (after.learners, after.until) == (("red",), {"iterations": 2})


def test_by_steps_a_player_that_went_back_learns_what_it_lost_again():
    schedule = Schedule("leapfrog", period_steps=400)
    phase = begin(schedule, at=10)
    assert remaining(phase, learnt(blue=8)) == 600
    assert next_phase(schedule, phase, TEAMS, learnt(blue=13)) is None


@pytest.mark.parametrize("period", [{"period": 2}, {"period": 9, "period_steps": 150}])
def test_in_ladder_one_team_learns_and_a_phase_ends_after_each_period(period):
    schedule = Schedule("ladder", learner=1, **period)
    seen, phase = live(schedule, 5)
    assert seen == ["red"] * 5
    assert (phase.number, phase.since["red"]) == (2, 4)
    assert remaining(phase, learnt(red=5)) in (1, 50)
    idle = next_phase(schedule, phase, {0: "blue", 2: "gold"}, learnt(red=5))
    assert idle is not None
    assert (idle.learners, idle.until) == ((), {})
    assert next_phase(schedule, idle, {0: "blue", 2: "gold"}, learnt(red=5)) is None
    again = next_phase(schedule, idle, TEAMS, learnt(red=5))
    assert again is not None
    assert (again.learners, again.since["red"]) == (("red",), 5)


def test_ladder_cuts_another_teams_turn_and_lets_its_own_learner_finish():
    leaping, ladder = begin(Schedule("leapfrog", period=4)), Schedule("ladder", period=2, learner=1)
    cut = next_phase(ladder, leaping, TEAMS, learnt(blue=1))
    assert cut is not None
    assert (cut.learners, cut.until) == (("red",), {"iterations": 2})
    assert next_phase(replace(ladder, learner=0), leaping, TEAMS, learnt(blue=1)) is None


def test_simultaneous_and_frozen_never_change():
    for schedule, learners in ((Schedule(), "blue+red+gold"), (Schedule("frozen", learner=1), "red")):
        seen, phase = live(schedule, 99)
        assert set(seen) == {learners}
        assert (phase.number, phase.until, remaining(phase, {})) == (0, {}, None)


def test_who_is_paused_never_learns_and_the_phase_passes_on():
    schedule = Schedule("leapfrog", period=2)
    at = learnt()
    _, phase = live(schedule, 3, at=at)
    assert phase.learners == ("red",)  # after one of its two iterations
    available = {0: "blue", 2: "gold"}
    seen, phase = live(schedule, 5, available, phase, at)
    assert seen == ["gold", "gold", "blue", "blue", "gold"]
    seen, phase = live(schedule, 7, TEAMS, phase, at)
    assert seen == ["gold", "blue", "blue", "red", "red", "gold", "gold"]
    assert begin(schedule, available={1: "red", 2: "gold"}).learners == ("red",)


@pytest.mark.parametrize("schedule", [Schedule(), Schedule("leapfrog"), Schedule("ladder"), Schedule("frozen")])
def test_where_nobody_can_learn_the_phase_waits_for_somebody(schedule):
    resting = next_phase(schedule, begin(schedule), {}, learnt(1, 1, 1))
    assert resting is not None
    assert resting.learners == ()
    assert next_phase(schedule, resting, {}, learnt(1, 1, 1)) is None
    awake = next_phase(schedule, resting, TEAMS, learnt(1, 1, 1))
    assert awake is not None
    assert (awake.number, awake.learners) == (2, begin(schedule).learners)


def test_other_settings_begin_another_phase():
    leaping, at = begin(Schedule("leapfrog")), learnt(3, 3, 3)
    together = next_phase(Schedule(), leaping, TEAMS, at)
    assert together is not None
    assert (together.number, together.learners, together.until) == (1, ("blue", "red", "gold"), {})
    again = next_phase(Schedule("leapfrog", learner=2), together, TEAMS, at)
    assert again is not None
    assert again.learners == ("gold",)


def test_a_player_that_went_back_learns_what_it_lost_again():
    schedule = Schedule("leapfrog", period=4)
    phase = begin(schedule, at=10)
    assert remaining(phase, learnt(blue=8)) == 6
    assert next_phase(schedule, phase, TEAMS, learnt(8, 10, 10)) is None


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"kind": "stairs"}, "leapfrog, ladder, frozen"),
        ({"period": 0}, "period"),
        ({"period_steps": 0}, "period_steps is 0"),
        ({"learner": -1}, "team"),
    ],
)
def test_schedules_that_cannot_be_meant_are_refused(fields, says):
    with pytest.raises(ValueError, match=says):
        Schedule(**fields)


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
