"""A policy whose opponent is frozen in its observation: who is masked in which world, and what it then sees."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import arenas
from agents.rollout.rollout import make_play, scripts_for
from arenas.description import Part
from arenas.errors import ArenaError
from league.commands.play.attack_report import Attacked, text_of_several
from league.config import experiment, presets
from league.config.schema import ConfigError
from league.matches.adhoc_matches import pairing
from league.matches.exploitability import Attack, finding, measure, measure_masked
from league.matches.masking import mask_opponents, opponent_numbers
from league.queries.query import Open
from league.snapshots.codec import add_scripts, seat
from storage.records import League, Player
from storage.store import Store
from tests.arenas.race import Race, RaceRules, RaceSettings


class Chase(Race):
    """A race whose script `chaser` thrusts towards the other puck, the last two numbers that it sees."""

    def observation_parts(self, agent):
        return (Part("velocity", 2), Part("flag", 2), Part("other", 2, opponent=True))

    def game_scripts(self):
        return {"chaser": {"puck": lambda observation, key: observation[4:6]}}


@pytest.fixture(scope="module")
def chase():
    return Chase(RaceSettings(rules=RaceRules(episode=1.0)), engine="c", threads=1)


def test_the_masked_team_of_each_group_sees_the_opponent_as_it_was_and_all_else_as_it_is(chase):
    number = list(scripts_for(chase, "puck")).index("chaser")
    stacks = seat(chase.teams, [[[number]], [[number]]])
    frozen = mask_opponents(chase, (0, 1), each=2)
    assert {name: mask.tolist() for name, mask in frozen.items()} == {
        "blue/0": [[False] * 4 + [True] * 2] * 2 + [[False] * 6] * 2,
        "red/0": [[False] * 6] * 2 + [[False] * 4 + [True] * 2] * 2,
    }
    keys = jax.random.split(jax.random.key(0), 4)
    play = make_play(chase, recorded=(0, 1, 2, 3), frozen=frozen)
    actions = {name: np.asarray(a) for name, a in play(stacks, keys).actions.items()}  # (T, 4, 2)
    for name, masked in (("blue/0", [0, 1]), ("red/0", [2, 3])):
        still = (actions[name] == actions[name][0]).all(axis=(0, 2))
        assert np.flatnonzero(still).tolist() == masked
    plain = make_play(chase, recorded=(0, 1, 2, 3))(stacks, keys)
    assert not np.array_equal(plain.actions["blue/0"][1:, :2], actions["blue/0"][1:, :2])
    np.testing.assert_array_equal(plain.actions["blue/0"][0], actions["blue/0"][0])


def test_an_arena_that_does_not_say_which_numbers_are_the_opponents_is_refused_in_one_line():
    with pytest.raises(ConfigError, match=r"arena race does not say which numbers of blue/0's observation are") as told:
        opponent_numbers(RaceSettings().build(engine="c", threads=1), "blue/0")
    assert "\n" not in str(told.value)


@pytest.mark.slow
def test_a_victim_that_needs_to_see_its_opponent_wins_less_without(tmp_path):
    config = presets.preset("duel")
    config = replace(config, rating=replace(config.rating, record=False))
    arena = config.arena.build(engine="c", threads=1)
    with Store.open(tmp_path / "store", create=True) as store:
        store.create_league(League("duel", experiment.dumps(config)))
        store.add_players([Player("duel", t.name, i, "main", t.roster) for i, t in enumerate(arena.teams)])
        add_scripts(store, "duel", arena, None)
        found = pairing(Open(store), "idle", "pusher")
        match = measure(found, 16)
        masked = measure_masked(found, 16)
        assert sum(masked) == match.wins + match.draws + match.losses == 16
        assert masked[0] < match.losses  # the pusher is B
        assert [m.purpose for m in store.matches("duel")] == ["exploit"]
        seen = {"unmasked": (match.losses, match.draws, match.wins), "masked": masked}
        found_hole = finding(found, match)
        attacks = [
            Attacked(Attack(found.players[1], replace(config, seed=seed), "idle"), found, ("idle",), found_hole, seen)
            for seed in (1, 2)
        ]
        report = text_of_several(attacks, found_hole)
    rows = [line.split() for line in report.splitlines() if "masked " in line]
    assert [row[-4] for row in rows] == ["unmasked", "masked"] * 2
    for row in rows:
        assert row[-3:] == [f"{100 * count / 16:.1f}" for count in seen[row[-4]]]
    assert "columns are too few" not in report


@pytest.mark.parametrize(
    ("name", "numbers"), [("sumo-1v1", 9), ("sumo-by-team", 6), ("soccer-2v2", 6), ("pursuit", 4), ("run-to-goal", 20)]
)
def test_arenas_say_which_numbers_are_the_opponents(name, numbers):
    try:
        arena = arenas.load(name, engine="c", threads=1)
    except ArenaError as error:  # a body that comes in a wheel
        pytest.skip(str(error))
    assert opponent_numbers(arena, arena.agents[0].name).sum() == numbers
