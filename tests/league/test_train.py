"""Turns of a small league in one process: who learns, what is written, what a restart changes."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from league import config as configuration
from league.lineup import Turn
from league.plan import Standing, next_turn
from league.train import Trainer
from matchmaking.opponents import Opponents
from matchmaking.schedule import Schedule
from storage import arrays
from storage.records import ArenaKey, League, Player
from storage.store import Store

LEAGUE = "duel"


def settings(schedule=Schedule(), opponents=Opponents()):  # noqa: B008  (frozen)
    config = configuration.duel()
    training = replace(config.training, worlds=16, rollout=8, turn=4, schedule=schedule, opponents=opponents)
    return replace(config, deterministic=True, training=training, budget=configuration.Budget())


@pytest.fixture(scope="module")
def arena():
    return configuration.duel().arena.build(engine="c")


@pytest.fixture
def store(tmp_path, arena):
    with Store.open(tmp_path / "store", create=True) as store:
        store.create_league(League(LEAGUE, ArenaKey("sumo-1v1", "0", "c"), ""))
        store.add_players([Player(LEAGUE, t.name, i, "main", t.roster) for i, t in enumerate(arena.teams)])
        yield store


def turns(store, config, arena, count):
    """Let one worker do the next turns as planned; the trainer afterwards."""
    trainer = Trainer(config, arena, store.players(LEAGUE))
    for _ in range(count):
        store.queue([job for job in [next_turn(config, Standing.of(store, LEAGUE))] if job])
        claimed = store.claim(LEAGUE, ["train"], "me", 60)
        assert claimed is not None
        lease, job = claimed
        turn = Turn.of(job.payload)
        for _ in trainer.turn(store, turn, lambda: False):
            pass
        trainer.commit(store, lease, turn)
    return trainer


def history(store):
    return [(c.player, c.iteration, c.digest) for c in store.checkpoints(LEAGUE)]


def test_simultaneously_both_learn_and_are_frozen_on_the_axis(store, arena):
    turns(store, settings(), arena, 4)
    assert [(player, iteration) for player, iteration, _ in history(store)] == [
        (player, iteration) for iteration in (0, 1, 2, 4) for player in ("blue", "red")
    ]
    assert len({digest for *_, digest in history(store)}) == 8
    assert [s.iteration for s in store.snapshots(LEAGUE, "red")] == [0, 1, 2, 4]
    assert store.checkpoint(LEAGUE, "blue").step == 4 * 16 * 8


def test_in_leapfrog_one_learns_while_the_other_stays_byte_for_byte(store, arena):
    turns(store, settings(Schedule("leapfrog", period=2)), arena, 6)
    assert [(player, iteration) for player, iteration, _ in history(store)] == [
        ("blue", 0), ("red", 0), ("blue", 1), ("blue", 2), ("red", 4), ("blue", 6), ("red", 8),
    ]  # fmt: skip
    turned = {}
    for player, iteration, digest in history(store):
        turned.setdefault(player, []).append((iteration, arrays.from_bytes(store.blobs.get(digest))))
    assert [iteration for iteration, _ in turned["red"]] == [0, 4, 8]
    weights = [state["actor.0.mean.weight"] for _, state in turned["blue"]]
    assert all((a != b).any() for a, b in pairwise(weights))


def test_a_frozen_opponent_never_changes(store, arena):
    trainer = turns(store, settings(Schedule("frozen", learner=1)), arena, 4)
    assert {player for player, iteration, _ in history(store) if iteration} == {"red"}
    start = next(d for player, iteration, d in history(store) if player == "blue")
    for name, array in arrays.from_bytes(store.blobs.get(start)).items():
        np.testing.assert_array_equal(trainer.learners[0].state()[name], array, err_msg=name)


def test_past_opponents_are_met_by_learners_that_learn_on(store, arena):
    config = settings(opponents=Opponents("uniform", past=0.5, groups=2))
    turns(store, config, arena, 4)
    assert store.checkpoint(LEAGUE, "blue").iteration == 4
    # six groups share 16 worlds: two each, so that 12 are simulated
    assert store.checkpoint(LEAGUE, "blue").step == (4 - 0) * 12 * 8


def test_a_worker_that_takes_over_goes_on_to_the_same_bytes(store, arena, tmp_path):
    turns(store, settings(), arena, 3)
    turns(store, settings(), arena, 2)  # a fresh trainer, as after a kill
    with Store.open(tmp_path / "other", create=True) as other:
        other.create_league(League(LEAGUE, ArenaKey("sumo-1v1", "0", "c"), ""))
        other.add_players(store.players(LEAGUE))
        turns(other, settings(), arena, 5)
        assert history(other) == history(store)


def test_a_spent_budget_freezes_what_was_learnt_last(store, arena):
    config = replace(settings(), budget=configuration.Budget(steps=5 * 16 * 8))
    turns(store, config, arena, 5)
    assert [s.iteration for s in store.snapshots(LEAGUE, "blue")] == [0, 1, 2, 4, 5]
    assert next_turn(config, Standing.of(store, LEAGUE)) is None
