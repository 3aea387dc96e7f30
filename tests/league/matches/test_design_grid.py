"""Snapshots on a grid of what a designer may set: cells, their results and the worst of them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arenas.arena_settings import Table
from arenas.errors import ArenaError
from arenas.games.disturbance import DisturbanceSettings
from arenas.games.disturbance.settings import DisturbanceRules
from league.matches.design_grid import designer_of, grid_points, play_grid, summarise
from storage.records import Snapshot
from tests.league.packs import refused

pytest.importorskip("gymnasium")
SETTINGS = DisturbanceSettings(
    blue=("hopper",), bodies=(), design=Table({"friction": [0.5, 2.0], "base": [0.5, 8.0]}),
    rules=DisturbanceRules(episode=1.0),
)  # fmt: skip
POINTS, EPISODES = 2, 3


@pytest.fixture(scope="module")
def arena():
    return SETTINGS.build(engine="c", threads=1, worlds=POINTS**2 * EPISODES)


def idle(arena, name="idle"):
    return Snapshot("cup", name, "", arena.teams[0].roster, script=name)


def test_cells_are_the_corners_and_all_between():
    bounds = {"friction": (0.5, 2.0), "base": (0.5, 8.0)}
    np.testing.assert_array_equal(grid_points(bounds, 2), [[-1, -1], [-1, 1], [1, -1], [1, 1]])
    assert grid_points(bounds, 10).shape == (100, 2)
    np.testing.assert_array_equal(grid_points(bounds, 1), [[0, 0]])


def test_a_choice_has_a_cell_for_each_of_its_names():
    hills = replace(
        SETTINGS, terrain=Table({"bumps": 0.1}), design=Table({"friction": [0.5, 2.0], "terrain": ["flat", "bumps"]})
    ).build(engine="c", threads=1, worlds=3 * 2 * EPISODES)
    found = play_grid(hills, None, idle(hills), 3, EPISODES, seed=3)
    assert found.labels == tuple({"friction": x, "terrain": y} for x in (0.5, 1.25, 2.0) for y in ("flat", "bumps"))
    assert found.voids == 0
    assert summarise(found.returns, found.labels).where in found.labels


@pytest.mark.slow
def test_a_cell_is_played_with_its_masses_from_the_same_seeds(arena):
    found = play_grid(arena, None, idle(arena), POINTS, EPISODES, seed=3)
    np.testing.assert_allclose(found.values, [[0.5, 0.5], [0.5, 8.0], [2.0, 0.5], [2.0, 8.0]])
    assert found.names == ("friction", "base")
    assert (found.scores == 0.0).all()  # nobody gets ten metres far
    assert found.voids == 0
    heavy, key = 3, jax.random.key(3)
    by_hand = []
    for start, _ in jax.random.split(key, (EPISODES, 2)):
        state, total, step = arena.reset(start), 0.0, jax.jit(arena.step)
        actions = {"blue/0": jnp.zeros(3), "nature/0": jnp.array([1.0, 1.0])}
        while not state.done:
            state = step(state, actions)
            total += float(state.verdict.reward[0])
        by_hand.append(total)
    assert found.returns[heavy] == pytest.approx(np.mean(by_hand), rel=1e-3)
    assert abs(found.returns[heavy] - found.returns[2]) > 1e-3
    again = play_grid(arena, None, idle(arena), POINTS, EPISODES, seed=3)
    np.testing.assert_array_equal(again.returns, found.returns)


def test_the_worst_tenth_is_the_mean_of_the_worst_cells():
    values, cells = np.arange(30.0)[::-1].copy(), np.arange(60.0).reshape(30, 2)
    values[0] = np.nan  # a cell whose episodes were all void
    found = summarise(values, cells)
    assert (found.mean, found.tenth, found.least) == (14.0, 0.5, 0.0)
    np.testing.assert_array_equal(found.where, cells[29])
    assert summarise(np.array([3.0, 1.0]), cells).tenth == 1.0


def test_what_cannot_be_played_is_told_in_one_line(arena):
    alone = replace(SETTINGS, design=Table()).build(engine="c", threads=1)
    with pytest.raises(ArenaError, match=r"^arena disturbance has 0 agents that set its worlds, and a grid needs one"):
        designer_of(alone)
    other = replace(idle(arena), roster="puck:6:2", name="blue@4")
    with pytest.raises(ArenaError, match=r"^blue@4 is a policy of puck:6:2, and arena disturbance has a designer aga"):
        play_grid(arena, None, other, POINTS, EPISODES, 1)


def test_the_command_needs_snapshots_and_bounds_the_worlds(capsys, copied_league, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert "league grid needs SNAPSHOTS" in refused(capsys, "grid")
    assert "has 0 agents that set its worlds" in refused(capsys, "grid", "blue")
