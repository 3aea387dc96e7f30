"""Where rovers start: inside the ring, clear of each other, and neither team better off."""

import math
from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.stats import ks_2samp

import arenas
from arenas.robots.leatherback import CHASSIS_HALF
from arenas.sumo import HULL, SumoRules

DRAWS = 10_000
CORNERS = 2 * math.hypot(*CHASSIS_HALF[:2])  # m: no nearer can two centres be at every heading
SMALLEST_RING = {1: 0.88, 2: 1.5, 3: 1.98, 4: 2.6}


def draw(team_size):
    """Centres (draws, robots, 2), headings (draws, robots) and radii (draws,), in the smallest rings allowed."""
    ring = (SMALLEST_RING[team_size], SMALLEST_RING[team_size] + 0.5)
    arena = replace(arenas.settings("sumo-2v2"), team_size=team_size, rules=SumoRules(ring)).build(engine="c")
    qpos, _, game = jax.jit(jax.vmap(arena.place))(jax.random.split(jax.random.key(1), DRAWS))
    first = [arena.scene.agents[agent.name].qpos for agent in arena.agents]
    base = np.asarray(qpos)[:, np.array(first)[:, None] + np.arange(7)]  # (draws, robots, 7)
    return base[..., :2], 2 * np.arctan2(base[..., 6], base[..., 3]), np.asarray(game.radius)


@pytest.mark.parametrize("team_size", [1, 2, 3, 4])
def test_hulls_are_inside_the_ring_and_clear_of_each_other(team_size):
    xy, _, radius = draw(team_size)
    assert CORNERS <= HULL
    assert (np.linalg.norm(xy, axis=2) < radius[:, None]).all()
    gaps = np.linalg.norm(xy[:, :, None] - xy[:, None], axis=3)
    first, second = np.triu_indices(2 * team_size, 1)
    assert gaps[:, first, second].min() > CORNERS


@pytest.mark.parametrize("team_size", [1, 2])
def test_neither_team_is_better_off(team_size):
    xy, heading, _ = draw(team_size)
    blue, red = np.split(xy, 2, axis=1)
    np.testing.assert_allclose(blue.mean(axis=(0, 1)), [0.0, 0.0], atol=0.03)
    np.testing.assert_allclose(red.mean(axis=(0, 1)), [0.0, 0.0], atol=0.03)
    facing = np.cos(heading - np.arctan2(-xy[..., 1], -xy[..., 0]))  # 1: towards the centre
    for numbers in (xy[..., 0], xy[..., 1], np.linalg.norm(xy, axis=2), facing):
        ours, theirs = (x.reshape(-1) for x in np.split(numbers, 2, axis=1))
        assert ks_2samp(ours, theirs).pvalue > 0.01


def test_radii_are_drawn_from_the_whole_range():
    _, _, radius = draw(2)
    assert 1.5 <= radius.min() < 1.505
    assert 1.995 < radius.max() <= 2.0
