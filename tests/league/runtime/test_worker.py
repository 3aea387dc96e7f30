"""A worker alone with a store: nobody manages the league, and the matches are somebody else's."""

import os
import threading
from dataclasses import replace

import pytest

from league.config import experiment as configuration
from league.config.run_spec import RunSpec
from league.runtime.worker import Worker
from league.runtime.worker_process import WorkerSpec
from league.scheduling import turn_scheduler
from league.state.league_state import LeagueState
from storage.records import League, Player
from storage.store import Store

LEAGUE = "small"
DEFAULT = configuration.default("rock-paper-scissors")
CONFIG = replace(
    DEFAULT, league=LEAGUE, budget=configuration.Budget(steps=7 * 16 * 8),
    training=replace(DEFAULT.training, worlds=16, rollout_length=8, iterations_per_turn=4),
)  # fmt: skip


@pytest.fixture
def store(tmp_path):
    arena = CONFIG.arena.build(engine="auto", worlds=16, threads=1)
    with Store.open(tmp_path / "store", create=True) as store:
        store.create_league(League(LEAGUE, ""))
        store.add_players([Player(LEAGUE, t.name, i, "main", t.roster) for i, t in enumerate(arena.teams)])
        yield store


def worker(store: Store) -> Worker:
    spec = WorkerSpec(RunSpec(store.where, None, ""), ("train",), 0, os.getppid())
    return Worker(store, CONFIG, spec, threading.Event())


def asked(store: Store) -> int:
    """Ask the plan as a manager would; how many jobs that were not there yet it wants."""
    planned = turn_scheduler.next_turns(CONFIG, LeagueState.of(store, LEAGUE))
    return store.queue(planned.jobs, planned.phases)


def claim(store: Store):
    return store.claim(LEAGUE, ["train"], "me", 60)


def test_one_turn_follows_the_other_without_a_manager_and_one_that_asks_as_well_queues_none_twice(store):
    learner = worker(store)
    assert asked(store) == 1
    ends = []
    while claimed := claim(store):
        learner._run_job(*claimed)
        assert asked(store) == 0
        assert len(store.jobs(LEAGUE, "queued")) <= 1
        ends.append(store.checkpoint(LEAGUE, "blue").iteration)
    assert ends == [0, 1, 2, 4, 7]  # at the last one its budget is spent
    assert {job.state for job in store.jobs(LEAGUE)} == {"done"}


def test_a_worker_that_was_told_to_stop_asks_for_nothing_more(store):
    learner = worker(store)
    asked(store)
    learner.stopping.set()
    learner._run_job(*claim(store))
    assert [job.state for job in store.jobs(LEAGUE)] == ["done"]
    assert asked(store) == 1
