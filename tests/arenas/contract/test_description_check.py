"""What arenas say about themselves is what they do, and the examination notices where it is not."""

import re
from dataclasses import dataclass, replace

import jax
import numpy as np
import pytest

import arenas
from arenas.arena_settings import Timing
from arenas.contract.check import DESCRIPTION, check_arena
from arenas.contract.check_run import CheckRun
from arenas.contract.description_check import check_description
from arenas.description import AgentOutline, Legend, Outline, Part, with_indices
from arenas.robots.puck import PUCK
from tests.arenas.race import Race, RaceRules, RaceSettings

RACE = RaceSettings(rules=RaceRules(episode=1.0))


class Described(Race):
    def observation_parts(self, agent):
        return (Part("velocity", 2, "m/s"), Part("flag", 2, "m"), Part("other", 2, "m"))

    def legend(self):
        return Legend("the first at the flag", {"lead": "the first"}, {"approach": ""}, {"arrival": "at the flag"})


class Short(Described):
    def observation_parts(self, agent):
        return super().observation_parts(agent)[:2]


class Twice(Described):
    def observation_parts(self, agent):
        return (Part("flag", 3), Part("flag", 3))


class Empty(Described):
    def observation_parts(self, agent):
        return (*super().observation_parts(agent), Part("nothing", 0))


class Misnamed(Described):
    def legend(self):
        return replace(super().legend(), shapings={"aproach": ""})


class Silent(Described):
    def legend(self):
        return replace(super().legend(), events={})


WRONG = [
    (Short, r"observation_parts of blue/0 have 4 numbers, there are 6"),
    (Twice, r"observation_parts of blue/0 need unique names: 'flag'"),
    (Empty, r"observation_parts of blue/0 have the part nothing, which has no numbers"),
    (Misnamed, r"the legend has shapings \['aproach'\], the verdict has \['approach'\]"),
    (Silent, r"the legend has events \[\], the verdict has \['arrival'\]"),
]


def check_run(arena):
    return CheckRun(arena(RACE, engine="c"), jax.random.key(0))


@pytest.mark.parametrize("arena", [Race, Described])
def test_an_arena_may_say_nothing_or_all(arena):
    assert check_description(check_run(arena)) == ""


@pytest.mark.parametrize(("arena", "problem"), WRONG)
def test_wrong_words_are_noticed(arena, problem):
    assert re.search(problem, check_description(check_run(arena)))


def test_robots_whose_words_do_not_fit_are_noticed():
    class Boastful(Race):
        def __init__(self, settings, **where):
            super().__init__(settings, **where)
            self.robots = dict.fromkeys(self.robots, replace(PUCK, action_parts=(Part("thrust", 3),)))

    assert check_description(check_run(Boastful)) == "action_parts of puck have 3 numbers, there are 2"


@dataclass(frozen=True)
class Boast(RaceSettings):
    sees: int = 6
    interval: int = 5

    def outline(self):
        seats = (AgentOutline("puck", self.sees, 2),)
        return Outline("a race", {"blue": seats, "red": seats}, Timing(0.01, 2, self.interval, self.rules.episode))


def test_an_outline_that_is_not_the_arena_is_noticed():
    described = check_run(Described)
    assert check_description(described, Boast(rules=RACE.rules)) == ""
    assert "outline has the teams" in check_description(described, Boast(rules=RACE.rules, sees=7))
    assert "outline has Timing" in check_description(described, Boast(rules=RACE.rules, interval=4))


def test_it_is_a_promise_of_the_contract():
    found = {result.name: result for result in check_arena(Short(RACE, engine="c"))}
    assert not found[DESCRIPTION].ok
    assert "have 4 numbers" in found[DESCRIPTION].detail


def test_places_among_the_numbers():
    parts = (Part("a", 1), Part("b", 3), Part("c", 2))
    assert [(place, part.name) for place, part in with_indices(parts)] == [("0", "a"), ("1-3", "b"), ("4-5", "c")]


# What the numbers of an observation are, by the names of their parts -------------------------------------------------


def start(name):
    """An arena, a fresh world and, by agent, its numbers by the names of their parts."""
    arena = arenas.load(name, engine="c", threads=1)
    state = jax.jit(arena.reset)(jax.random.key(3))
    seen = {}
    for agent in arena.agents:
        parts = arena.observation_parts(agent.name)
        ends = np.cumsum([part.size for part in parts])
        values = np.split(np.asarray(state.observations[agent.name]), ends[:-1])
        seen[agent.name] = {part.name: value for part, value in zip(parts, values, strict=True)}
    return arena, state, seen


def places(arena, state):
    return {name: np.asarray(state.physics.qpos[at.qpos : at.qpos + 3]) for name, at in arena.scene.agents.items()}


def apart(a, b):
    return pytest.approx(float(np.linalg.norm(a - b)), rel=1e-4)


def test_the_names_of_a_rich_observation_are_of_those_numbers():
    arena, state, seen = start("sumo-2v2")
    at, mine = places(arena, state), seen["blue/1"]
    assert mine["radius"] == pytest.approx(float(state.game.radius))
    assert mine["margin"] == pytest.approx(float(state.game.radius) - np.linalg.norm(at["blue/1"][:2]), abs=1e-5)
    assert np.linalg.norm(mine["centre"]) * mine["radius"] == pytest.approx(np.linalg.norm(at["blue/1"][:2]), abs=1e-5)
    assert (mine["up"], mine["time"]) == (pytest.approx(1.0), 0.0)
    for who, agent in (("team-mate", "blue/0"), ("enemy 0", "red/0"), ("enemy 1", "red/1")):
        assert np.linalg.norm(mine[f"{who}'s position"]) == apart(at[agent][:2], at["blue/1"][:2])
        assert np.linalg.norm(mine[f"{who}'s bearing"]) == pytest.approx(1.0, abs=1e-5)
        assert np.linalg.norm(mine[f"{who}'s heading"]) == pytest.approx(1.0, abs=1e-5)
        assert mine[f"{who}'s margin"] == pytest.approx(seen[agent]["margin"], abs=1e-5)


@pytest.mark.parametrize(
    ("agent", "slots"), [("blue/0", "enemy 1, team-mate, enemy 0"), ("red/1", "enemy 0, team-mate, enemy 1")]
)
def test_the_names_of_slots_are_of_those_numbers(agent, slots):
    arena, state, seen = start("sumo-by-team")
    at, mine = places(arena, state), seen[agent]
    meanings = [p.meaning for p in arena.observation_parts(agent) if p.name.startswith("slot ")]
    assert [meaning.partition(":")[0] for meaning in meanings] == slots.split(", ")
    own, other = ("blue", "red") if agent.startswith("blue") else ("red", "blue")
    mate = f"{own}/{1 - int(agent[-1])}"
    who = {"team-mate": mate, "enemy 0": f"{other}/0", "enemy 1": f"{other}/1"}
    for slot, what in zip("ABC", slots.split(", "), strict=True):
        assert np.linalg.norm(mine[f"slot {slot}"]) == apart(at[who[what]], at[agent])
    assert mine["distance"] == pytest.approx(float(np.linalg.norm(at[agent])), rel=1e-4)
    assert mine["radius"] == pytest.approx(float(state.game.radius))


def test_the_names_of_what_a_robot_feels_are_of_those_numbers():
    arena, state, seen = start("anymal-walk")
    goal = np.append(np.asarray(state.game.goal), 0.25)
    mine = seen["blue/0"]
    assert mine["down"] == pytest.approx([0.0, 0.0, -1.0], abs=1e-6)
    assert np.linalg.norm(mine["slot A"]) == apart(goal, places(arena, state)["blue/0"])
    assert [float(np.abs(mine[name]).max()) for name in ("velocity", "rates", "joint speeds", "last action")] == [0] * 4
    assert mine["joint angles"] == pytest.approx(np.zeros(12), abs=1e-6)
    stepped = jax.jit(arena.step)(state, {"blue/0": jax.numpy.arange(12) / 100.0})
    first = sum(part.size for part in arena.observation_parts("blue/0")[:5])
    assert stepped.observations["blue/0"][first : first + 12] == pytest.approx(np.arange(12) / 100)


def test_block_push_has_blocks_in_its_slots():
    arena, state, seen = start("block-push-leatherback")
    at, qpos = places(arena, state), np.asarray(state.physics.qpos)
    blocks = {name: qpos[(i := arena.scene.props[f"block-{name}"].qpos) : i + 3] for name in ("blue", "red")}
    mine = seen["red/0"]
    assert np.linalg.norm(mine["slot A"]) == apart(blocks["red"], at["red/0"])
    assert np.linalg.norm(mine["slot B"]) == apart(at["blue/0"], at["red/0"])
    assert np.linalg.norm(mine["slot C"]) == apart(blocks["blue"], at["red/0"])
