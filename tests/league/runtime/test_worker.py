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
from matchmaking.schedule import Schedule
from storage.records import League, Player
from storage.store import Store
from tests.arenas.echo import EchoRules, EchoSettings

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


@pytest.mark.parametrize("kind", ["simultaneous", "leapfrog"])
def test_a_worker_tells_the_counts_that_the_budget_limits(kind, store):
    training = replace(CONFIG.training, schedule=Schedule(kind, period=2))
    config = replace(CONFIG, training=training)
    learner, found = worker(store, config), []
    planned = turn_scheduler.next_turns(config, LeagueState.of(store, LEAGUE))
    store.queue(planned.jobs, planned.phases)
    while claimed := claim(store):
        learner._run_job(*claimed)
        if (at := store.checkpoint(LEAGUE, "blue")) is not None and at.iteration:
            state = LeagueState.of(store, LEAGUE)
            (group,) = state.groups
            assert (learner.status["seconds"], learner.status["steps"]) == state.spent(group, training.schedule)
            found.append(learner.status["steps"] // (16 * 8))
    assert found[-1] == 7  # as many as the budget has
    assert learner.status["iteration"] == (3 if kind == "leapfrog" else 7)  # of red, whose turn it is, or of both


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


# More groups than workers ---------------------------------------------------------------------------------------------

PUPILS = replace(
    DEFAULT, league=LEAGUE, arena=EchoSettings(rules=EchoRules(delay=15)), budget=configuration.Budget(steps=10**6),
    training=replace(DEFAULT.training, worlds=16, rollout_length=4, iterations_per_turn=1),
    learner=replace(DEFAULT.learner, epochs=1, minibatches=1),
)  # fmt: skip


@pytest.fixture
def pupils(tmp_path):
    """A store with three players that learn alone, in an arena whose settings do not tell its longest episode."""
    (team,) = PUPILS.arena.build(engine="auto", worlds=16, threads=1).teams
    with Store.open(tmp_path / "pupils", create=True) as store:
        store.create_league(League(LEAGUE, ""))
        store.add_players([Player(LEAGUE, f"{team.name}-{g}", 0, "main", team.roster, group=g) for g in "123"])
        yield store


def test_workers_keep_most_worlds_of_more_groups_and_no_group_falls_behind(pupils):
    workers = [worker(pupils, PUPILS), worker(pupils, PUPILS)]
    workers[1].id += "b"
    planned = turn_scheduler.next_turns(PUPILS, LeagueState.of(pupils, LEAGUE))
    pupils.queue(planned.jobs, planned.phases)
    for _ in pupils.players(LEAGUE):  # the first turns make the players
        workers[0]._run_job(*workers[0].claim())
    held, spreads = [each.claim() for each in workers], []
    for number in range(80):  # each has a turn while the other one chooses
        at = number % 2
        workers[at]._run_job(*held[at])
        held[at] = workers[at].claim()
        iterations = [c.iteration for c in pupils.newest_checkpoints(LEAGUE).values()]
        spreads.append(max(iterations) - min(iterations))
    begun = [p.values["begun_anew"] for player in pupils.players(LEAGUE) for p in pupils.curves(LEAGUE, player.name)]
    assert len(begun) > 70
    assert 0 < sum(begun) < len(begun) / 5  # some: a group that waits too long is taken over
    assert max(spreads) <= 3 * 4  # longest episodes of 4 iterations
