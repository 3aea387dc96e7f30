"""Plan a league's next jobs, of training and of rating: a function of its settings, its state and the clock.

The manager calls it after every change of the league. It measures the training progress once, for both schedulers.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

from league.config.experiment import Config
from league.scheduling.match_scheduler import RatingTime, plan_rating
from league.scheduling.training_progress import measure
from league.scheduling.turn_scheduler import next_turns
from league.state.league_state import LeagueState
from storage.records import Job, Phase

BEFORE_RATING = RatingTime()


class Planned(NamedTuple):
    """Rows to add to the store in one transaction, and what the league does."""

    jobs: Sequence[Job]
    phases: Sequence[Phase]  # of schedules, and of the rating that follows training
    activity: Literal["training", "rating", "done"]
    rating_time: RatingTime  # from now on


def plan(config: Config, state: LeagueState, rating_time: RatingTime) -> Planned:
    """Return the league's next jobs; the time for rating begins with the end of training."""
    progress = measure(config, state)
    turns = next_turns(config, state, progress)
    training = bool(turns.jobs or turns.awaited or progress.open)
    matches, rating_time, rating = plan_rating(config, state, progress, training, rating_time, turns.awaited)
    activity = "training" if training else "rating" if rating else "done"
    return Planned([*turns.jobs, *matches.jobs], [*turns.phases, *matches.phases], activity, rating_time)
