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
from league.state.jobs import RatingMatch, encode
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


def worker(store: Store, config: configuration.Config = CONFIG, kind: str = "train") -> Worker:
    spec = WorkerSpec(RunSpec(store.where, None, ""), (kind,), 0, os.getppid())
    return Worker(store, config, spec, threading.Event())


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
        assert ends[-1] == 0 or learner.status["iteration_seconds"] > 0
    assert ends == [0, 1, 2, 4, 7]  # at the last one its budget is spent
    assert {job.state for job in store.jobs(LEAGUE)} == {"done"}


def test_a_worker_that_was_told_to_stop_asks_for_nothing_more(store):
    learner = worker(store)
    asked(store)
    learner.stopping.set()
    learner._run_job(*claim(store))
    assert [job.state for job in store.jobs(LEAGUE)] == ["done"]
    assert asked(store) == 1


@pytest.mark.parametrize("score", [0.9, None])
def test_matches_that_end_training_are_compiled_once_when_players_have_learnt(score, store):
    config = replace(
        CONFIG, budget=replace(CONFIG.budget, score=score), rating=replace(CONFIG.rating, worlds=16, pairings=2)
    )
    learner, player = worker(store), worker(store, config, "match")
    asked(store)
    learner._run_job(*claim(store))
    player._rating.compile_early()
    assert player._rating._evaluator is None  # nobody has learnt yet
    learner._run_job(*claim(store))
    player._rating.compile_early()
    made = player._rating._evaluator
    assert (made is not None) == (score is not None)
    task = RatingMatch((("blue@0", "red@1"), ("blue@0", "red@0")), 5)
    store.queue([encode(LEAGUE, task, ["a", "batch"])])
    player._run_job(*store.claim(LEAGUE, ["match"], "me", 60))
    assert {job.state for job in store.jobs(LEAGUE) if job.kind == "match"} == {"done"}
    evaluator = player._rating._evaluator
    assert evaluator is not None
    assert evaluator is (made or evaluator)
    assert evaluator._play is not None
    assert len(evaluator._play._ready) == 1


def test_a_worker_that_plays_says_nothing_of_the_turn_that_it_trained_before(store):
    config = replace(CONFIG, rating=replace(CONFIG.rating, worlds=16, pairings=1))
    spec = WorkerSpec(RunSpec(store.where, None, ""), ("train", "match"), 0, os.getppid())
    both = Worker(store, config, spec, threading.Event())

    def plays(name: str) -> None:
        store.queue([encode(LEAGUE, RatingMatch((("blue@0", "red@0"),), 5), [name])])
        both._run_job(*store.claim(LEAGUE, ["match"], "me", 60))
        assert set(both.status) == {"doing", "pairs", "steps_per_second"}

    asked(store)
    both._run_job(*claim(store))  # the first snapshots
    plays("compiled first")
    both._run_job(*claim(store))
    assert both.status["learners"] == ["blue", "red"]
    plays("right after a turn")
