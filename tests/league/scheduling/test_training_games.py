"""Training games become the win rates by which the next opponents are drawn; nothing else is remembered."""

from dataclasses import replace

import pytest

from agents.settings import Architecture
from league.config import experiment as configuration
from league.scheduling import turn_scheduler
from league.state.jobs import decode
from league.state.league_state import LeagueState
from matchmaking.opponents import Opponents
from matchmaking.schedule import Schedule
from storage.records import League
from storage.store import Store
from tests.league.turns import new_trainer

LEAGUE = "main"


def settings(kind="latest", schedule="simultaneous", **given):
    """A league that learns in no time: what matters here is who met whom."""
    config = configuration.default("rock-paper-scissors")
    training = replace(
        config.training, worlds=32, rollout_length=8, iterations_per_turn=2,
        opponents=Opponents(kind, groups=4, **given), schedule=Schedule(schedule),
    )  # fmt: skip
    learner = replace(config.learner, epochs=1, architecture=Architecture((4,)))
    return replace(
        config, deterministic=True, learner=learner, training=training, budget=configuration.Budget(steps=10**9)
    )


@pytest.fixture(scope="module")
def arena():
    return settings().arena.build()


def new_store(place, config, arena):
    from league.runtime.bootstrap import create

    store = Store.open(place, create=True)
    store.create_league(League(LEAGUE, ""))
    create(store, config, arena)
    return store


@pytest.fixture
def store(tmp_path, arena):
    with new_store(tmp_path / "store", settings(), arena) as store:
        yield store


def claim(store, config):
    planned = turn_scheduler.next_turns(config, LeagueState.of(store, LEAGUE))
    store.queue(planned.jobs, planned.phases)
    lease, job = store.claim(LEAGUE, ["train"], "me", 60)
    return lease, decode(job)


def turns(store, config, arena, count):
    trainer = new_trainer(config, arena, store)
    done = []
    for _ in range(count):
        lease, turn = claim(store, config)
        for _ in trainer.turn(store, turn, lambda: False):
            pass
        trainer.commit(store, lease, turn)
        done.append(turn)
    return done


def ends(store):
    return {p.name: store.checkpoint(LEAGUE, p.name).digest for p in store.players(LEAGUE)}


@pytest.mark.parametrize("schedule", ["simultaneous", "leapfrog"])
def test_every_episode_that_a_learner_learnt_from_is_counted_once(store, arena, schedule):
    turns(store, settings("uniform", schedule, past=0.5), arena, 4)
    for player in ("blue", "red"):
        games = [m for m in store.meetings(LEAGUE) if m.player == player]
        points = store.curves(LEAGUE, player)
        if schedule == "leapfrog" and player == "red":
            assert len(games) == len(points) == 0
            continue
        assert sum(m.wins + m.draws + m.losses for m in games) == sum(p.values["counted"] for p in points) > 100
        assert all(p.values["counted"] < p.values["episodes"] for p in points if p.values["begun_anew"])
        score = sum(m.wins + m.draws / 2 for m in games)
        assert score == pytest.approx(sum(p.values["score"] * p.values["counted"] for p in points))
        assert sum(m.draws for m in games) > 20  # a third of this game's, and nobody's loss
        assert {m.pool for m in games} > {0}
        assert all(m.chance == pytest.approx(1 / m.pool) for m in games if m.pool)


def test_games_are_told_with_the_opponent_that_was_met(store, arena):
    *_, turn = turns(store, settings("uniform", past=0.5), arena, 3)
    last = [m for m in store.meetings(LEAGUE) if m.player == "blue" and m.iteration == 2]
    assert {m.opponent for m in last} == {"red", *(red for _, red in turn.past["blue"])}


def test_a_turn_that_was_killed_leaves_no_games(store, arena):
    config = settings("pfsp")
    turns(store, config, arena, 2)
    before = store.meetings(LEAGUE)
    trainer = new_trainer(config, arena, store, 32)
    _, turn = claim(store, config)
    assert list(trainer.turn(store, turn, lambda: False))  # and then it is gone, before it commits
    assert store.meetings(LEAGUE) == before


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pfsp", "openai_five", "alphastar"])
def test_rules_draw_the_same_and_end_with_the_same_bytes_after_a_restart(store, arena, tmp_path, kind):
    config = settings(kind)
    whole = turns(store, config, arena, 5)
    with new_store(tmp_path / "other", config, arena) as other:
        halves = [turn for count in (2, 1, 2) for turn in turns(other, config, arena, count)]
        assert [(t.past, t.chances) for t in halves] == [(t.past, t.chances) for t in whole]
        assert ends(other) == ends(store)
        assert [replace(m, id=0) for m in other.meetings(LEAGUE)] == [replace(m, id=0) for m in store.meetings(LEAGUE)]


def test_a_script_can_be_the_victim(store, arena):
    turns(store, settings("fixed", "frozen", victim="rock"), arena, 4)
    assert {m.opponent for m in store.meetings(LEAGUE)} == {"rock"}
    assert {m.player for m in store.meetings(LEAGUE)} == {"blue"}
