"""Who sits where in a training turn."""

import jax.numpy as jnp
import numpy as np
import pytest

from league.config import presets
from league.snapshots.codec import add_scripts
from league.state.jobs import TrainingTurn
from league.training.matchups import Matchups
from storage.errors import StorageError
from storage.records import League, Player
from storage.store import Store

PRESENT = 4  # the number of a script that stands for the present players: told from any past one by it


@pytest.fixture(scope="module")
def arena():
    return presets.preset("duel").arena.build(engine="c", threads=1)


@pytest.fixture
def store(tmp_path, arena):
    with Store.open(tmp_path / "store", create=True) as store:
        store.create_league(League("tiny", ""))
        add_scripts(store, "tiny", arena, ("idle", "random", "pusher"))
        yield store


def turn(learners=("blue", "red"), past=None, present=("blue", "red")):
    return TrainingTurn("1", 0, learners, present, dict.fromkeys(present, ""), 1, past or {})


def matchups(store, arena, turn, present=1, worlds=100, learns_from=None):
    return Matchups(turn, present, worlds, store, "tiny", arena, learns_from)


def scripts(made):
    """Agent -> the script that sits in each group of worlds, counted from 0."""
    now = {"blue": [PRESENT - 1], "red": [PRESENT - 1]}
    return {agent: (stack_policies.script - 1).tolist() for agent, stack_policies in made.stacks(now, {}).items()}


def test_without_past_opponents_all_worlds_are_one_group_and_teach_all(store, arena):
    made = matchups(store, arena, turn())
    assert (made.groups, made.worlds) == (1, 100)
    assert made.worlds_of("blue") == made.worlds_of("red") == slice(None)
    assert made.past_share("blue") == 0


def test_opponents_are_named_group_by_group_and_those_that_rest_with_their_iteration(store, arena):
    past = {"blue": (("", "idle"), ("", "random")), "red": (("pusher", ""),)}
    iterations = {"blue": 7, "red": 9}
    both = matchups(store, arena, turn(past=past), present=2)
    assert both.opponents_of("blue", iterations) == ["red", "red", "idle", "random"]
    assert both.opponents_of("red", iterations) == ["blue", "blue", "pusher"]
    rests = matchups(store, arena, turn(("blue",), {"blue": past["blue"]}))
    assert rests.opponents_of("blue", iterations) == ["red@9", "idle", "random"]
    assert len(rests.opponents_of("blue", iterations)) * 33 == len(np.arange(rests.worlds)[rests.worlds_of("blue")])


def test_each_learner_has_groups_of_its_own_and_learns_from_no_others(store, arena):
    past = {"blue": (("", "idle"), ("", "random")), "red": (("pusher", ""), ("idle", ""))}
    made = matchups(store, arena, turn(past=past), present=2)
    assert (made.groups, made.worlds) == (6, 96)  # two present groups, two of blue's, two of red's
    number = {name: i for i, name in enumerate(arena.scripts())}
    now = PRESENT - 1
    assert scripts(made) == {
        "blue/0": [now] * 4 + [number["pusher"], number["idle"]],
        "red/0": [now, now, number["idle"], number["random"], now, now],
    }
    np.testing.assert_array_equal(made.worlds_of("blue"), np.arange(0, 64))
    np.testing.assert_array_equal(made.worlds_of("red"), np.r_[0:32, 64:96])
    assert made.past_share("blue") == made.past_share("red") == 0.5


def test_who_asks_for_fewer_present_groups_learns_from_the_first_of_them_alone(store, arena):
    past = {"blue": (("", "idle"),) * 3, "red": (("pusher", ""),)}
    made = matchups(store, arena, turn(past=past), 3, 70, {"blue": 1, "red": 3})
    assert (made.groups, made.worlds) == (7, 70)
    np.testing.assert_array_equal(made.worlds_of("blue"), np.r_[0:10, 30:60])
    np.testing.assert_array_equal(made.worlds_of("red"), np.r_[0:30, 60:70])
    assert (made.past_share("blue"), made.past_share("red")) == (0.75, 0.25)
    assert made.opponents_of("blue", {}) == ["red", "idle", "idle", "idle"]
    results = np.zeros((7, 2, 4))  # groups, teams, and won, drawn, lost, void
    results[:, 1, 0] = 10.0 ** np.arange(7)
    found = made.meetings(Player("tiny", "blue", 0, "main", "puck"), 5, results)
    assert [(m.opponent, m.wins) for m in found] == [("idle", 111_000), ("red", 1)]


def test_who_asks_for_no_present_group_learns_from_its_own_groups_alone(store, arena):
    past = {"blue": (("", "idle"),), "red": (("pusher", ""),)}
    made = matchups(store, arena, turn(past=past), 2, 40, {"blue": 0, "red": 2})
    np.testing.assert_array_equal(made.worlds_of("blue"), np.arange(20, 30))
    assert made.past_share("blue") == 1
    whole = matchups(store, arena, turn(past={"red": past["red"]}), 2, 30, {"red": 2})
    np.testing.assert_array_equal(whole.worlds_of("blue"), np.arange(20))  # without past opponents: from all
    assert whole.worlds_of("red") == slice(None)


def test_a_team_that_does_not_learn_plays_as_it_is(store, arena):
    made = matchups(store, arena, turn(("red",), {"red": (("pusher", ""),)}))
    assert made.groups == 2
    assert jnp.unique(jnp.array(scripts(made)["red/0"])).tolist() == [PRESENT - 1]
    assert made.worlds_of("red") == slice(None)


def test_who_rests_while_all_worlds_are_drawn_for_another_learns_from_none(store, arena):
    made = matchups(store, arena, turn(("blue",), {"blue": (("", "idle"), ("", ""))}), present=0)
    assert (made.teaches("blue"), made.teaches("red")) == (True, False)
    assert made.worlds_of("red").size == 0
    assert made.past_share("blue") == 0.5  # in the other half red sits as it is now


def test_worlds_whose_opponent_changed_are_told_and_no_others(store, arena):
    before = matchups(store, arena, turn(past={"blue": (("", "idle"), ("", "random")), "red": ()}), worlds=12)
    after = matchups(store, arena, turn(past={"blue": (("", "idle"), ("", "pusher")), "red": ()}), worlds=12)
    assert after.changed(before.assigned).tolist() == [False] * 8 + [True] * 4


def test_a_group_without_a_player_in_some_team_needs_past_ones_there(store, arena):
    alone = turn(("blue",), {"blue": (("", "idle"),)}, ("blue", ""))
    assert matchups(store, arena, alone, present=0).groups == 1
    with pytest.raises(StorageError, match="nobody to play against"):
        matchups(store, arena, turn(("blue",), {"blue": ()}, ("blue", "")))


def test_games_of_three_teams_are_counted_against_each_opponent_in_its_seat(tmp_path):
    arena = presets.preset("tag").arena.build(engine="c", threads=1)
    three = ("blue", "red", "green")
    past = {"blue": (("", "idle", "tagger"), ("", "tagger", "tagger"))}
    with Store.open(tmp_path / "store", create=True) as store:
        store.create_league(League("tiny", ""))
        add_scripts(store, "tiny", arena, ("idle", "tagger"))
        made = matchups(store, arena, turn(("blue",), past, three), present=1, worlds=9)
    assert made.assigned == [three, ("blue", "idle", "tagger"), ("blue", "tagger", "tagger")]
    results = np.zeros((3, 3, 4))  # groups, teams, and won, drawn, lost, void
    results[:, 1, 0], results[:, 2, 2] = (1, 2, 4), (8, 16, 32)
    found = made.meetings(Player("tiny", "blue", 0, "main", "puck"), 5, results)
    assert [(m.opponent, m.wins, m.losses) for m in found] == [
        ("green", 0, 8), ("idle", 2, 0), ("red", 1, 0), ("tagger", 4, 16 + 32),
    ]  # fmt: skip
