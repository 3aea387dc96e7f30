"""What robots see in HARL-A's slots, by index, worked out by hand."""

import math
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from arenas.games.sumo import paper_observation
from arenas.games.sumo.match import GameState
from arenas.robots.anymal import REST_HEIGHT
from arenas.robots.leatherback import WHEEL_RADIUS
from tests.arenas.hooks import observing

UP = math.pi / 2
# blue/0, blue/1, red/0, red/1; blue/0 faces +y: ahead of it is +y, on its left is -x.
SCENE = [(1.0, 0.0, UP), (1.0, 1.0, 0.0), (-1.0, 0.0, math.pi), (1.0, -1.5, UP)]
LOWER = WHEEL_RADIUS - REST_HEIGHT  # m, where a rover's base is seen from an ANYmal's
RING = GameState(jnp.asarray(4.0))


def look(arena, physics):
    actions = {a.name: jnp.full(a.action_size, 0.25) for a in arena.agents}
    return {name: np.asarray(x) for name, x in observing(arena)(physics, RING, actions).items()}


def built(**changes):
    return replace(arenas.settings("sumo-by-team"), **changes).build(engine="c")


@pytest.fixture(scope="module")
def seen(by_team, stand):
    return look(by_team.arena, stand(by_team.arena, SCENE, velocity={0: (0.5, 1.0, 0.7), 2: (0.2, 0.3, 0.0)}))


def test_an_anymal_sees_56_numbers(seen):
    mine = seen["blue/0"]
    assert mine.shape == (56,)
    np.testing.assert_allclose(mine[:9], [1.0, -0.5, 0.0, 0.0, 0.0, 0.7, 0.0, 0.0, -1.0], atol=1e-6)
    np.testing.assert_allclose(mine[9:33], np.zeros(24), atol=1e-6)  # joints at rest
    np.testing.assert_allclose(mine[33:45], np.full(12, 0.25))  # last action
    np.testing.assert_allclose(mine[45:48], [-1.5, 0.0, LOWER], atol=1e-6)  # A: enemy 1
    np.testing.assert_allclose(mine[48:51], [1.0, 0.0, 0.0], atol=1e-6)  # B: team-mate
    np.testing.assert_allclose(mine[51:54], [0.0, 2.0, LOWER], atol=1e-6)  # C: enemy 0
    np.testing.assert_allclose(mine[54:], [math.hypot(1.0, REST_HEIGHT), 4.0], atol=1e-6)


def test_a_rover_sees_14_numbers_and_the_enemies_the_other_way_round(seen):
    mine = seen["red/0"]  # it faces -x
    assert mine.shape == (14,)
    np.testing.assert_allclose(mine[0:3], [-2.0, 0.0, -LOWER], atol=1e-6)  # A: enemy 0
    np.testing.assert_allclose(mine[3:6], [-2.0, 1.5, 0.0], atol=1e-6)  # B: team-mate
    np.testing.assert_allclose(mine[6:9], [-2.0, -1.0, -LOWER], atol=1e-6)  # C: enemy 1
    np.testing.assert_allclose(mine[9], math.hypot(1.0, WHEEL_RADIUS), atol=1e-6)
    np.testing.assert_allclose(mine[10:13], [-0.2, -0.3, 0.0], atol=1e-6)  # velocity
    np.testing.assert_allclose(mine[13], 4.0)


def test_slots_are_in_the_whole_base_frame(by_team, stand):
    """On its back, facing +x: left and up have changed sign."""
    poses = [(0.0, 0.0, 0.0), (1.0, 2.0, 0.0), (3.0, 0.0, 0.0), (0.0, -2.0, 0.0)]
    mine = look(by_team.arena, stand(by_team.arena, poses, flipped=(0,)))["blue/0"]
    np.testing.assert_allclose(mine[48:51], [1.0, -2.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(mine[45:48], [0.0, 2.0, -LOWER], atol=1e-5)
    np.testing.assert_allclose(mine[6:9], [0.0, 0.0, 1.0], atol=1e-6)  # down is where its back is


@pytest.mark.parametrize("buffer", [50, 100])
def test_the_buffer_is_zeros_at_the_end(by_team, stand, seen, buffer):
    arena = built(buffer=buffer)
    wider = look(arena, stand(arena, SCENE, velocity={0: (0.5, 1.0, 0.7), 2: (0.2, 0.3, 0.0)}))
    for name, before in seen.items():
        np.testing.assert_array_equal(wider[name], np.concatenate([before, np.zeros(buffer, np.float32)]))
    assert [a.observation_size for a in arena.agents] == [56 + buffer] * 2 + [14 + buffer] * 2


@pytest.mark.parametrize(("kind", "first"), [("anymal", 45), ("leatherback", 0), ("minitank", 0)])
def test_a_lone_enemy_is_in_slot_a_and_other_slots_are_empty(stand, kind, first):
    arena = built(blue=(kind,), red=(kind,))
    mine = look(arena, stand(arena, [(0.0, -1.0, 0.0), (2.0, 0.0, 0.0)]))["blue/0"]
    np.testing.assert_allclose(mine[first : first + 9], [2.0, 1.0, 0.0, *[0.0] * 6], atol=1e-6)


def test_who_has_no_slot_follows_in_the_tail(stand):
    """One ANYmal against a rover, an ANYmal and a tank."""
    arena = built(blue=("anymal",), red=("leatherback", "anymal", "minitank"), buffer=5)
    seen = look(arena, stand(arena, [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 0.0, 0.0), (3.0, 0.0, 0.0)]))
    assert {name: len(x) for name, x in seen.items()} == {"blue/0": 61, "red/0": 19, "red/1": 61, "red/2": 19}
    ahead = {"blue/0": seen["blue/0"][[45, 48, 51, 56]], "red/0": seen["red/0"][[0, 3, 6, 14]]}
    np.testing.assert_allclose(ahead["blue/0"], [2.0, 0.0, 1.0, 3.0], atol=1e-6)  # enemies 1, 0 and then 2
    np.testing.assert_allclose(ahead["red/0"], [-1.0, 1.0, 0.0, 2.0], atol=1e-6)  # enemy, team-mate, and the other
    np.testing.assert_allclose(seen["red/1"][[45, 48, 51, 56]], [-2.0, -1.0, 0.0, 1.0], atol=1e-6)
    np.testing.assert_array_equal(seen["blue/0"][59:], [0.0, 0.0])  # the buffer's rest
    assert paper_observation.size("anymal", extra=1, buffer=1) == 59
    assert paper_observation.size("leatherback", extra=2) == 20


def test_both_kinds_of_teams_see_alike_from_either_side(stand):
    """Within teams: ANYmal and rover each; what blue sees, red sees with the places exchanged."""
    arena = arenas.load("sumo-within-team", engine="c")
    seen = look(arena, stand(arena, SCENE))
    other = look(arena, stand(arena, SCENE[2:] + SCENE[:2]))
    for mine, yours in (("blue/0", "red/0"), ("blue/1", "red/1")):
        np.testing.assert_allclose(seen[mine], other[yours], atol=1e-6)
    assert {a.kind: a.observation_size for a in arena.agents} == {"anymal": 56, "leatherback": 14}
