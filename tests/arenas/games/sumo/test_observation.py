"""What a rover sees, by index, worked out by hand for one scene."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from arenas.games.sumo.match import GameState
from tests.arenas.hooks import observing

RIGHT = math.pi / 2
SCENE = [(1.0, 0.0, RIGHT), (1.0, 1.0, 0.0), (-1.0, 0.0, math.pi), (1.0, -1.5, RIGHT)]  # blue/0, blue/1, red/0, red/1
SPEEDS = {0: (0.5, 1.0, 0.7), 2: (0.2, 0.0, 0.0), 3: (0.5, 2.0, 0.0)}
ACTIONS = {"blue/0": (0.3, -0.2), "blue/1": (0.4, 0.1), "red/0": (-1.0, 0.5), "red/1": (0.7, 0.6)}


@pytest.fixture(scope="module")
def seen(brawl, stand):
    physics = stand(brawl.arena, SCENE, time=2.5, velocity=SPEEDS, flipped=(3,))
    actions = {name: jnp.array(a) for name, a in ACTIONS.items()}
    return observing(brawl.arena)(physics, GameState(jnp.asarray(2.0)), actions)


# blue/0 faces +y: ahead of it is +y, on its left is -x.
def test_own_part(seen):
    np.testing.assert_allclose(seen["blue/0"][0:2], [0.3, -0.2], atol=1e-6)  # last action
    np.testing.assert_allclose(seen["blue/0"][2:4], [1.0, -0.5], atol=1e-6)  # velocity
    np.testing.assert_allclose(seen["blue/0"][4], 0.7, atol=1e-6)  # yaw rate
    np.testing.assert_allclose(seen["blue/0"][5:7], [0.0, 0.5], atol=1e-6)  # the centre, 1 m to the left of a 2 m ring
    np.testing.assert_allclose(seen["blue/0"][7:11], [1.0, 2.0, 0.25, 1.0], atol=1e-6)  # margin, radius, time, up


@pytest.mark.parametrize(
    ("part", "position", "bearing", "turn", "velocity", "margin"),
    [
        (0, (1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.5), 2 - math.sqrt(2)),  # blue/1, the team-mate, right ahead
        (1, (0.0, 2.0), (0.0, 1.0), (0.0, 1.0), (-1.0, 0.3), 1.0),  # red/0, beyond the centre
    ],
)
def test_part_of_another_robot(seen, part, position, bearing, turn, velocity, margin):
    first = 11 + 9 * part
    expected = [*position, *bearing, *turn, *velocity, margin]
    np.testing.assert_allclose(seen["blue/0"][first : first + 9], expected, atol=1e-6)


def test_sizes_and_order(seen):
    assert {name: x.shape for name, x in seen.items()} == dict.fromkeys(ACTIONS, (38,))
    # Margins tell who is listed where: blue/0 1.0, blue/1 0.586, red/0 1.0, red/1 0.197 m.
    np.testing.assert_allclose(seen["blue/1"][jnp.array([19, 28, 37])], [1.0, 1.0, 0.197], atol=1e-3)
    np.testing.assert_allclose(seen["red/0"][jnp.array([19, 28, 37])], [0.197, 1.0, 0.586], atol=1e-3)
    np.testing.assert_allclose(seen["red/1"][jnp.array([19, 28, 37])], [1.0, 1.0, 0.586], atol=1e-3)


def test_the_up_axis_tells_a_rover_on_its_back(seen):
    np.testing.assert_allclose([seen[name][10] for name in ACTIONS], [1.0, 1.0, 1.0, -1.0], atol=1e-6)


def test_the_radius_seen_is_the_radius_now(duel, stand):
    physics = stand(duel.arena, [(0.6, 0.0, 0.0), (-0.6, 0.0, 0.0)], time=7.5)
    seen = observing(duel.arena)(physics, GameState(jnp.asarray(1.5)), {"blue/0": jnp.zeros(2), "red/0": jnp.zeros(2)})
    np.testing.assert_allclose(seen["red/0"][5:10], [0.6 / 0.9, 0.0, 0.3, 0.9, 0.75], atol=1e-6)
    assert seen["red/0"].shape == (20,)
