"""Arenas as PettingZoo's environments: its own tests of them, and the ends of agents and episodes."""

from dataclasses import replace

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test, parallel_seed_test

import arenas
from arenas.errors import ArenaError

RACE = "tests/arenas/race.py:race"


@pytest.fixture(scope="module", autouse=True)
def race():
    """An environment that lives as long as these tests, so that others of its arena need not be compiled."""
    return arenas.pettingzoo(RACE)


@pytest.fixture(scope="module")
def hunt():
    """Three predators after two prey in an empty field."""
    settings = arenas.settings("pursuit")
    return arenas.pettingzoo(replace(settings, prey=2, rules=replace(settings.rules, side=2.5, obstacles=0)))


def passes_the_tests_of_pettingzoo(name):
    env = arenas.pettingzoo(name)
    parallel_api_test(env, num_cycles=110)
    parallel_seed_test(lambda: arenas.pettingzoo(name), num_cycles=10)
    env.reset(seed=1)
    assert env.state_space.contains(env.state())


@pytest.mark.parametrize("name", ["sumo-1v1", "rock-paper-scissors"])
def test_an_arena_passes_the_tests_of_pettingzoo(name):
    passes_the_tests_of_pettingzoo(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["soccer-1v1", "soccer-score-leatherback", "galaga-2v2", "pursuit"])
def test_other_arenas_pass_the_tests_of_pettingzoo(name):
    passes_the_tests_of_pettingzoo(name)


def test_an_arena_whose_agents_leave_passes_the_tests_of_pettingzoo(hunt):
    parallel_api_test(hunt, num_cycles=110)


def test_caught_prey_leaves_the_agents_and_the_rest_play_on(hunt):
    observations, _ = hunt.reset(seed=3)
    assert hunt.agents == ["predators/0", "predators/1", "predators/2", "prey/0", "prey/1"]
    chase = hunt.arena.scripts()["chaser"]["predator"]
    gone = []
    while hunt.agents:
        acting = list(hunt.agents)
        actions = {a: chase(observations[a], None) if a.startswith("predators") else np.zeros(2) for a in acting}
        observations, rewards, terminated, truncated, infos = hunt.step(actions)
        assert list(observations) == list(rewards) == list(terminated) == list(infos) == acting
        assert not any(truncated.values())
        assert hunt.agents == ([] if all(terminated.values()) else [a for a in acting if not terminated[a]])
        for prey in (a for a in acting if terminated[a] and hunt.agents):  # it pays for its capture and sees no more
            gone.append(prey)
            assert infos[prey]["outcome"] < 0
            assert not observations[prey].any()
            with pytest.raises(ArenaError, match=f"{prey} cannot act; those in the game are predators/0"):
                hunt.step({a: np.zeros(2) for a in acting})
    assert len(gone) == 1
    assert infos["predators/0"]["score"] == 1.0
    assert infos["predators/0"]["events"] == ["capture"]


def test_agents_of_a_game_of_turns_stay_to_its_end_and_say_who_is_on_turn():
    passes_the_tests_of_pettingzoo("kuhn-poker")
    env, rng, lengths = arenas.pettingzoo("kuhn-poker"), np.random.default_rng(0), set()
    for episode in range(30):
        _, infos = env.reset(seed=episode)
        decisions, on_turn = 0, [infos[name]["alive"] for name in env.possible_agents]
        while env.agents:
            assert env.agents == env.possible_agents
            assert sum(on_turn) == 1
            seen, rewards, terminated, truncated, infos = env.step(
                {name: rng.normal(size=2).astype(np.float32) for name in env.agents}
            )
            decisions += 1
            over = not env.agents
            assert [*terminated.values(), *truncated.values()] == [over, over, False, False]
            now = [infos[name]["alive"] for name in env.possible_agents]
            assert over or now == [not each for each in on_turn]  # in Kuhn poker both act in turn
            assert over or [bool(np.any(seen[name])) for name in env.possible_agents] == now
            on_turn = now
        lengths.add(decisions)
        won, lost = sorted(rewards.values(), reverse=True)
        assert won == -lost > 0
        assert sorted(infos[name]["score"] for name in infos) == [0.0, 1.0]
    assert lengths == {2, 3}


def test_rewards_weigh_the_dense_part_and_name_their_terms():
    env = arenas.pettingzoo(RACE, shaping=0.5)
    env.reset(seed=0)
    ahead = {"blue/0": np.array([1.0, 0.0]), "red/0": np.zeros(2)}
    for _ in range(3):
        _, rewards, _, _, infos = env.step(ahead)
    info = infos["blue/0"]
    assert set(info) == {"outcome", "shaping", "rewards", "shapings", "events"}
    assert info["shapings"] == {"approach": info["shaping"]}
    assert abs(info["shaping"]) > 0.01
    assert rewards["blue/0"] == pytest.approx(0.5 * info["shaping"])


def test_an_action_that_is_no_number_costs_its_team_the_void_episode():
    env = arenas.pettingzoo(RACE, void_penalty=2.0)
    before, _ = env.reset(seed=0)
    broken = {"blue/0": np.zeros(2), "red/0": np.array([np.nan, 0.0])}
    after, rewards, terminated, truncated, infos = env.step(broken)
    assert rewards == {"blue/0": 0.0, "red/0": -2.0}
    assert terminated == {"blue/0": False, "red/0": True}
    assert truncated == {"blue/0": True, "red/0": False}
    assert "actions" in infos["blue/0"].pop("void")
    assert infos["blue/0"] == {"outcome": 0.0, "shaping": 0.0}
    np.testing.assert_array_equal(after["blue/0"], before["blue/0"])
    assert env.agents == []


def test_a_seed_decides_the_episodes_that_follow_too():
    env = arenas.pettingzoo(RACE)
    first = [env.reset(seed=5)[0]["blue/0"], env.reset()[0]["blue/0"]]
    again = [env.reset(seed=5)[0]["blue/0"], env.reset()[0]["blue/0"]]
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first[0], first[1])


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (lambda: arenas.pettingzoo("sumo-1v2"), "unknown arena 'sumo-1v2': did you mean sumo-"),
        (lambda: arenas.pettingzoo(7), "7 is no arena: give a name"),
        (lambda: arenas.pettingzoo(RACE, render_mode="rgb_array"), "environments draw nothing"),
        (lambda: arenas.pettingzoo(RACE, shaping=-1), "shaping=-1: give a number of 0 or more"),
        (lambda: arenas.pettingzoo(RACE, action_limit=0), "action_limit=0: give a number above 0"),
        (lambda: arenas.pettingzoo(RACE).step({}), "no episode of .* is under way: call reset"),
        (lambda: arenas.pettingzoo(RACE).state(), "no episode of .* is under way: call reset"),
        (lambda: arenas.pettingzoo(RACE).reset(seed=-1), "seed=-1: give a whole number from 0"),
    ],
)
def test_bad_input_is_told_in_one_line(call, line):
    with pytest.raises(ArenaError, match=line) as told:
        call()
    assert "\n" not in str(told.value)


def test_bad_actions_are_told_in_one_line():
    env = arenas.pettingzoo(RACE)
    env.reset(seed=0)
    for actions, line in (
        (None, "no action of blue/0, red/0"),
        ({"blue/0": np.zeros(2)}, "no action of red/0: give one of each of blue/0, red/0"),
        ({"blue/0": np.zeros(2), "red/0": np.zeros(3)}, r"the action of red/0 has the shape \(3,\), .* \(2,\)"),
        ({"blue/0": np.zeros(2), "red/0": "left"}, "the action of red/0 is no array of numbers"),
    ):
        with pytest.raises(ArenaError, match=line):
            env.step(actions)


@pytest.mark.parametrize("call", [lambda: arenas.pettingzoo(RACE), lambda: arenas.vector(RACE, "blue", "random")])
def test_a_missing_package_is_named_with_its_command(call, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ArenaError, match=r"need the package .*: pip install 'robot-league\[envs\]'"):
        call()
