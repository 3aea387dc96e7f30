"""What soccer's robots see, by index, worked out by hand."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from arenas.games.soccer.drill import GameState as Asked
from arenas.games.soccer.match import GameState
from arenas.robots.anymal import REST_HEIGHT
from arenas.robots.leatherback import WHEEL_RADIUS
from tests.arenas.hooks import observing
from tests.arenas.kickoff import put

UP = math.pi / 2
NOBODY = GameState(jnp.zeros(2, bool))
# blue/0 faces +y: ahead of it is +y, on its left is -x. red/0 faces -x: ahead is -x, on its left is -y.
POSES = [(1.0, 0.0, UP), (1.0, 1.0, 0.0), (-2.0, 1.0, math.pi), (4.0, -3.0, UP)]
BALL, ROLLS = (1.0, 2.0), (0.5, 0.0)
LOWER = WHEEL_RADIUS - REST_HEIGHT  # m, where a rover's base is seen from an ANYmal's


def look(arena, physics, game=NOBODY):
    actions = {a.name: jnp.full(a.action_size, 0.25) for a in arena.agents}
    return {name: np.asarray(x) for name, x in observing(arena)(physics, game, actions).items()}


@pytest.fixture(scope="module")
def seen():
    arena = arenas.load("soccer-2v2", engine="c")
    return look(arena, put(arena, POSES, BALL, ROLLS, moves={0: (0.0, 1.0), 2: (-0.2, 0.3)}))


def test_an_anymal_sees_66_numbers(seen):
    mine = seen["blue/0"]
    assert mine.shape == (66,)
    np.testing.assert_allclose(mine[:9], [1.0, 0, 0, 0, 0, 0, 0, 0, -1.0], atol=1e-6)
    np.testing.assert_allclose(mine[33:45], np.full(12, 0.25))  # last action
    np.testing.assert_allclose(mine[45:48], [2.0, 0.0, 0.11 - REST_HEIGHT], atol=1e-5)
    np.testing.assert_allclose(mine[48:51], [-1.0, -0.5, 0.0], atol=1e-5)  # the ball's velocity less its own
    np.testing.assert_allclose(mine[51:54], [0.0, -8.25, 0.05 - REST_HEIGHT], atol=1e-5)  # blue plays at +x
    np.testing.assert_allclose(mine[54:57], [0.0, 10.25, 0.05 - REST_HEIGHT], atol=1e-5)
    np.testing.assert_allclose(mine[57:60], [1.0, 0.0, 0.0], atol=1e-5)  # team-mate
    np.testing.assert_allclose(mine[60:63], [1.0, 3.0, LOWER], atol=1e-5)  # enemy 0
    np.testing.assert_allclose(mine[63:66], [-3.0, -3.0, LOWER], atol=1e-5)  # enemy 1


def test_a_rover_sees_24_numbers_and_plays_the_other_way(seen):
    mine = seen["red/0"]
    assert mine.shape == (24,)
    np.testing.assert_allclose(mine[0:3], [0.2, -0.3, 0.0], atol=1e-5)  # its own velocity
    np.testing.assert_allclose(mine[3:6], [-3.0, -1.0, 0.11 - WHEEL_RADIUS], atol=1e-5)
    np.testing.assert_allclose(mine[6:9], [-0.7, 0.3, 0.0], atol=1e-5)
    np.testing.assert_allclose(mine[9:12], [7.25, 1.0, 0.05 - WHEEL_RADIUS], atol=1e-5)  # red plays at -x
    np.testing.assert_allclose(mine[12:15], [-11.25, 1.0, 0.05 - WHEEL_RADIUS], atol=1e-5)
    np.testing.assert_allclose(mine[15:18], [-6.0, 4.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(mine[18:21], [-3.0, 1.0, -LOWER], atol=1e-5)
    np.testing.assert_allclose(mine[21:24], [-3.0, 0.0, -LOWER], atol=1e-5)


def test_one_against_one_leaves_team_mate_and_second_enemy_zero():
    arena = arenas.load("soccer-1v1", engine="c")
    seen = look(arena, put(arena, [POSES[0], POSES[2]], BALL, ROLLS))
    assert {name: len(x) for name, x in seen.items()} == {"blue/0": 66, "red/0": 24}
    for mine, first in ((seen["blue/0"], 57), (seen["red/0"], 15)):
        np.testing.assert_array_equal(mine[first : first + 3], 0.0)
        assert np.abs(mine[first + 3 : first + 6]).max() > 1
        np.testing.assert_array_equal(mine[first + 6 : first + 9], 0.0)


def test_who_has_no_place_follows_in_the_tail_and_the_buffer_after():
    settings = replace(arenas.settings("soccer-1v1"), blue=("leatherback",) * 3, red=("leatherback",), buffer=5)
    arena = settings.build(engine="c")
    seen = look(arena, put(arena, [(0.0, y, 0.0) for y in (0.0, 1.0, 2.0, -1.0)]))
    assert {name: len(x) for name, x in seen.items()} == dict.fromkeys(("blue/0", "blue/1", "blue/2", "red/0"), 29)
    np.testing.assert_allclose(seen["blue/0"][[16, 19, 22, 25]], [1.0, -1.0, 0.0, 2.0], atol=1e-6)
    np.testing.assert_allclose(seen["red/0"][[16, 19, 22, 25]], [0.0, 1.0, 2.0, 3.0], atol=1e-6)
    for mine in seen.values():
        np.testing.assert_array_equal(mine[27:], 0.0)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(("name", "first"), [("soccer-score", 45), ("soccer-score-leatherback", 3)])
def test_alone_it_sees_the_goal_that_is_asked_for_and_nobody(name, first, side):
    arena = arenas.load(name, engine="c")
    mine = look(arena, put(arena, [(1.0, 0.0, 0.0)], BALL), Asked(jnp.asarray(side)))["blue/0"]
    np.testing.assert_allclose(mine[first : first + 2], [0.0, 2.0], atol=1e-6)
    np.testing.assert_allclose(mine[[first + 6, first + 9]], [9.25 * side - 1.0, -9.25 * side - 1.0], atol=1e-5)
    np.testing.assert_array_equal(mine[first + 12 :], np.zeros(9))


def test_the_walk_shows_its_point_where_the_ball_will_be():
    arena = arenas.load("soccer-walk", engine="c")
    start = arena.reset(jax.random.key(0))
    asked = start.game._replace(goal=jnp.array([2.0, 1.0]))
    mine = np.asarray(observing(arena)(start.physics, asked, start.actions)["blue/0"])
    assert mine.shape == (66,)
    assert np.linalg.norm(mine[45:47]) == pytest.approx(math.hypot(2.0, 1.0), rel=1e-5)
    assert mine[47] == pytest.approx(0.25 - REST_HEIGHT, abs=1e-5)
    np.testing.assert_array_equal(mine[48:], 0.0)


def test_stages_and_matches_see_alike_so_that_a_policy_goes_on():
    sizes = {
        name: {a.kind: a.observation_size for a in arenas.load(name, engine="c").agents}
        for name in arenas.names()
        if name.startswith("soccer")
    }
    assert all(kinds.items() <= {"anymal": 66, "leatherback": 24}.items() for kinds in sizes.values())
    assert len(sizes) == 7
