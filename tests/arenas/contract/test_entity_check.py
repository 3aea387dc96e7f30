"""The check of sets of entities: of pursuit, and of sets that are none."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from arenas.contract import entity_check
from arenas.contract.check_run import WORLDS, CheckRun
from arenas.description import Entities, entity_places
from arenas.games.pursuit import PursuitRules, PursuitSettings

SETTINGS = PursuitSettings("few", predators=2, prey=2, rules=PursuitRules(side=2.5, episode=1.0, obstacles=2))


@pytest.fixture(scope="module")
def run():
    return CheckRun(SETTINGS.build(engine="c", threads=1, worlds=WORLDS), jax.random.key(0))


def of(run, sets):
    """The check's finding if the first predator names these sets."""
    return entity_check.of_agent(run, replace(run.arena.agents[0], entities=sets))


def test_pursuits_sets_are_sets(run):
    assert entity_check.problem(run) == ""
    names = {agent.name: [each.name for each in agent.entities] for agent in run.arena.agents}
    assert names["predators/0"] == names["prey/1"] == ["pillars", "predators", "prey"]
    parts = run.arena.observation_parts("predators/0")
    prey = run.arena.agents[0].entities[-1]
    assert [part.size for part in parts] == [2, 2, 4, 2, 4, 4, 1]
    assert prey.places == ((10, 11, 14, 15), (12, 13, 16, 17))  # place and velocity of each


def test_a_set_that_a_script_does_not_take_as_one_is_found(run):
    wrong = (Entities("prey", ((10, 11), (14, 15))),)  # the place of one, and its velocity
    assert "acts otherwise, by " in of(run, wrong)


@pytest.mark.parametrize(
    ("index", "fault"),
    [
        (((0, 1), (2,)), "entities of the set x have [1, 2] numbers; they need equally many, 1 or more"),
        (((0, 1), (18, 19)), "entities name the place 19, and the observation has 19 numbers"),
        (((0, 1), (1, 2)), "the place 1 is in two entities"),
    ],
)
def test_places_that_cannot_be_are_told(run, index, fault):
    assert of(run, (Entities("x", index),)) == f"predators/0: {fault}"


def test_entities_change_places_and_nothing_else():
    seen = np.arange(14.0).reshape(2, 7)
    moved = entity_check.rotated(seen, [Entities("x", entity_places(1, 3, 2))])
    np.testing.assert_array_equal(moved[0], [0, 5, 6, 1, 2, 3, 4])
