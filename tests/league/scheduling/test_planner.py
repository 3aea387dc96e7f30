"""One planning pass: turns and matches together, and the time for rating that follows training."""

import time
from dataclasses import replace

from league.config import experiment as configuration
from league.scheduling import match_scheduler
from league.scheduling.match_scheduler import RatingTime, next_matches
from league.scheduling.planner import BEFORE_RATING, plan
from league.scheduling.turn_scheduler import next_turns
from tests.league.plans import checkpoints, league_state, snapshots, training

BUDGET = configuration.Budget(training_time="5m", rating_time="180s")
CONFIG = replace(training(), budget=BUDGET)


def league(seconds):
    return league_state(checkpoints=checkpoints(64, seconds=seconds), snapshots=snapshots(0, 16, 64, seconds=4.7))


def test_turns_and_matches_are_planned_together_while_players_learn():
    state = league(200.0)
    planned = plan(CONFIG, state, BEFORE_RATING)
    turns, matches = next_turns(CONFIG, state), next_matches(CONFIG, state)
    assert turns.jobs
    assert matches.jobs
    assert planned.jobs == [*turns.jobs, *matches.jobs]
    assert planned.phases == [*turns.phases]
    assert (planned.activity, planned.rating_time) == ("training", BEFORE_RATING)


def test_the_time_for_rating_begins_once_and_its_end_is_in_the_store():
    state, now = league(300.0), time.monotonic()
    begun = plan(CONFIG, state, BEFORE_RATING)
    assert begun.jobs == [*next_matches(CONFIG, state).jobs]
    assert begun.phases == [match_scheduler.rating_phase(CONFIG, state)]
    assert begun.activity == "rating"
    assert now + 180.0 <= begun.rating_time.until <= time.monotonic() + 180.0
    again = plan(CONFIG, state, begun.rating_time)
    assert (again.jobs, again.phases, again.rating_time) == (begun.jobs, [], begun.rating_time)
    late = plan(CONFIG, state, RatingTime(now - 1.0))
    assert (late.jobs, late.phases, late.activity) == ([], [match_scheduler.rating_over(CONFIG, state)], "done")
    more = plan(replace(CONFIG, budget=replace(BUDGET, training_time="10m")), state, begun.rating_time)
    assert (more.activity, more.rating_time) == ("training", BEFORE_RATING)


def test_rating_without_a_bound_does_not_end():
    config = replace(CONFIG, budget=replace(BUDGET, rating_time=None))
    assert not plan(config, league(300.0), BEFORE_RATING).rating_time.over()
