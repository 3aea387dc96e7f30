"""Who sits where in a training turn."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from agents.policy import scripted
from league import config as configuration
from league.lineup import Lineup, Turn, present_groups
from league.policies import add_scripts
from matchmaking.opponents import Opponents
from storage.records import ArenaKey, League, Player
from storage.store import Store


@pytest.fixture(scope="module")
def arena():
    return configuration.duel().arena.build(engine="c", threads=1)


@pytest.fixture
def store(tmp_path, arena):
    with Store.open(tmp_path / "store", create=True) as store:
        store.create_league(League("tiny", ArenaKey("sumo-1v1", "0", "c"), ""))
        store.add_players([Player("tiny", t.name, i, "main", t.roster) for i, t in enumerate(arena.teams)])
        add_scripts(store, "tiny", arena, ("idle", "random", "pusher"))
        yield store


NOW = [[scripted(3)], [scripted(3)]]  # the present players, told from any past one by their script


def lineup(store, arena, turn, opponents, worlds=100):
    return Lineup(turn, opponents, worlds, store.players("tiny"), store, arena)


@pytest.mark.parametrize(
    ("past", "drawn", "present"), [(0.5, 2, 2), (0.25, 1, 3), (0.2, 2, 8), (1.0, 3, 0), (0.4, 2, 3)]
)
def test_past_opponents_get_their_share(past, drawn, present):
    assert present_groups(Opponents("uniform", past=past, groups=drawn), drawn) == present


def test_without_past_opponents_all_worlds_are_one_group_and_teach_all(store, arena):
    made = lineup(store, arena, Turn(0, 1, (0, 1), {"blue": [], "red": []}), Opponents())
    assert (made.groups, made.worlds) == (1, 100)
    assert made.worlds_of(0) == made.worlds_of(1) == slice(None)


def test_each_learner_has_groups_of_its_own_and_learns_from_no_others(store, arena):
    digest = {s.name: s.digest for s in store.snapshots("tiny")}
    past = {
        "blue": [{"red": digest["idle"]}, {"red": digest["random"]}],
        "red": [{"blue": digest["pusher"]}, {"blue": digest["idle"]}],
    }
    made = lineup(store, arena, Turn(0, 1, (0, 1), past), Opponents("uniform", past=0.5, groups=2))
    assert (made.groups, made.worlds) == (6, 96)  # two present groups, two of blue's, two of red's
    seated = made.policies(NOW)
    number = {name: i + 1 for i, name in enumerate(arena.scripts())}
    present = 4
    assert seated["blue/0"]["script"].tolist() == [present] * 4 + [number["pusher"], number["idle"]]
    assert seated["red/0"]["script"].tolist() == [
        present, present, number["idle"], number["random"], present, present,
    ]  # fmt: skip
    np.testing.assert_array_equal(made.worlds_of(0), np.arange(0, 64))
    np.testing.assert_array_equal(made.worlds_of(1), np.r_[0:32, 64:96])


def test_a_team_that_does_not_learn_plays_as_it_is(store, arena):
    digest = {s.name: s.digest for s in store.snapshots("tiny")}
    turn = Turn(0, 1, (1,), {"red": [{"blue": digest["pusher"]}]})
    made = lineup(store, arena, turn, replace(Opponents("uniform", past=0.5)))
    seated = made.policies(NOW)
    assert made.groups == 2
    assert jnp.unique(seated["red/0"]["script"]).tolist() == [4]
    assert made.worlds_of(1) == slice(None)
