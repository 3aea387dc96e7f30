"""Where soccer's robots and balls start: clear of each other and of the walls, alike for both teams."""

import math
from dataclasses import replace
from itertools import combinations

import jax
import numpy as np
import pytest

import arenas
from arenas.games.soccer.rules import Defects
from arenas.games.soccer.stages import faithful
from arenas.games.sumo.settings import KINDS

STARTS = 400


def starts(settings, number=STARTS):
    """Places (number, robots + 1, 2) of robots and then the ball, headings (number, robots), heights, and games."""
    arena = settings.build(engine="c")
    qpos, qvel, game = jax.jit(jax.vmap(arena.place))(jax.random.split(jax.random.key(0), number))
    assert (np.abs(qvel) == 0).all()
    qpos = np.asarray(qpos)
    at = [*(arena.scene.agents[a.name].qpos for a in arena.agents), arena.scene.props["ball"].qpos]
    places = np.stack([qpos[:, i : i + 2] for i in at], axis=1)
    heights = np.stack([qpos[:, i + 2] for i in at], axis=1)
    heading = np.stack([2 * np.arctan2(qpos[:, i + 6], qpos[:, i + 3]) for i in at[:-1]], axis=1)
    return places, heading, heights, game


def over_goal(places):
    return (np.abs(np.abs(places[..., 0]) - 9.25) <= 0.5) & (np.abs(places[..., 1]) <= 1.5)


def gaps(places):
    return {
        pair: np.linalg.norm(places[:, pair[0]] - places[:, pair[1]], axis=1).min()
        for pair in combinations(range(places.shape[1]), 2)
    }


@pytest.mark.parametrize("name", ["soccer-1v1", "soccer-2v2", "soccer-2v2-leatherback", "soccer-score"])
def test_all_start_clear_of_each_other_within_the_walls_and_outside_the_goals(name):
    settings = arenas.settings(name)
    kinds = [agent_outline.kind for seats in settings.outline().teams.values() for agent_outline in seats]
    places, heading, heights, _ = starts(settings)
    clear = [*(KINDS[kind].hull / 2 for kind in kinds), 0.11]
    for (one, other), gap in gaps(places).items():
        assert gap >= clear[one] + clear[other] - 1e-4
    room = np.array([9.75, 4.75]) - np.array(clear)[:, None]
    assert (np.abs(places) <= room).all()
    assert not over_goal(places).any()
    rest = {"anymal": 0.5492, "leatherback": 0.052}
    np.testing.assert_allclose(heights, [[*(rest[kind] for kind in kinds), 0.11]] * STARTS, atol=1e-5)
    np.testing.assert_allclose(np.quantile(heading % (2 * np.pi), [0.25, 0.5, 0.75]), [1.57, 3.14, 4.71], atol=0.6)


def test_places_are_all_over_the_pitch_and_alike_for_both_teams():
    places, *_ = starts(arenas.settings("soccer-2v2-leatherback"), 2000)
    assert len(np.unique(places.reshape(-1, 2), axis=0)) == 19 * 9 - 6
    for thing in range(5):
        np.testing.assert_allclose(places[:, thing].mean(axis=0), 0.0, atol=0.3)
        np.testing.assert_allclose(places[:, thing].std(axis=0), [5.4, 2.6], rtol=0.1)


def test_the_originals_starts_can_be_had():
    """Any two points of the lattice, in the air, all facing -x."""
    settings = arenas.settings("soccer-2v2")
    rules = replace(settings.rules, defects=Defects(spawn_overlap=True, dropped=True), heading="fixed")
    places, heading, heights, _ = starts(replace(settings, rules=rules))
    assert gaps(places)[0, 1] == pytest.approx(1.0)  # two ANYmals of 1.05 m
    np.testing.assert_allclose(np.abs(heading), math.pi, atol=1e-5)
    np.testing.assert_allclose(heights[0], [0.5492, 0.5492, 0.30, 0.30, 0.11], atol=1e-5)
    *_, alone, _ = starts(faithful(arenas.settings("soccer-ball")), 3)
    np.testing.assert_allclose(alone[0], [0.60, 0.11], atol=1e-5)


def test_in_the_first_stage_the_ball_is_near_the_robot():
    places, _, _, game = starts(arenas.settings("soccer-ball"), 2000)
    offset = places[:, 1] - places[:, 0]
    assert np.abs(offset).max() <= 3.0
    assert np.linalg.norm(offset, axis=1).min() >= 0.7 - 1e-4  # ANYmal's circle and the ball's
    assert (np.abs(places[:, 1]) <= np.array([9.75, 4.75]) - 0.11).all()
    assert not over_goal(places[:, 1]).any()
    inner = (np.abs(places[:, 0]) <= [6.0, 1.0]).all(axis=1)  # where no wall cuts the square off
    np.testing.assert_allclose(
        np.quantile(offset[inner], [0.1, 0.5, 0.9], axis=0), [[-2.4] * 2, [0.0] * 2, [2.4] * 2], atol=0.3
    )
    np.testing.assert_allclose(np.mean(np.asarray(game.side) == 1.0), 0.5, atol=0.05)
    assert set(np.unique(game.side)) == {-1.0, 1.0}


def test_an_easy_start_has_the_ball_on_its_way_and_the_robot_behind_it():
    settings = arenas.settings("soccer-score-leatherback")
    hard, *_ = starts(settings, 2000)
    places, _, _, game = starts(replace(settings, rules=replace(settings.rules, ease=0.5)), 2000)
    clear = KINDS["leatherback"].hull / 2 + 0.11
    assert np.linalg.norm(places[:, 0] - places[:, 1], axis=1).min() >= clear - 1e-4
    assert (np.abs(places) <= np.array([9.75, 4.75]) - np.array([clear - 0.11, 0.11])[:, None] + 1e-5).all()
    assert not over_goal(places[:, 1]).any()
    easy = (np.abs(places - hard) > 1e-4).any(axis=(1, 2))
    assert 0.35 < easy.mean() <= 0.55  # half, less those that found no room
    goal = np.stack([np.asarray(game.side) * 9.25, np.zeros(2000)], axis=1)
    robot, ball = (np.linalg.norm(places[:, i] - goal, axis=1) for i in range(2))
    assert np.median(ball[easy]) < 0.7 * np.median(ball[~easy])
    near = easy & (ball < 3.0)
    assert near.sum() > 0.2 * easy.sum()
    assert (robot > ball)[near].mean() > 0.8
