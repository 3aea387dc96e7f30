"""Where rovers start: inside the ring, clear of each other, and neither team better off."""

import math
from dataclasses import replace

import jax
import mujoco
import numpy as np
import pytest
from scipy.stats import ks_2samp

import arenas
from arenas.games.sumo import SumoRules
from arenas.games.sumo.ring import place_on_lattice
from arenas.games.sumo.settings import KINDS, faithful, lattice_ring
from arenas.robots.leatherback import CHASSIS_HALF

DRAWS = 10_000
CAPSULE = mujoco.mjtGeom.mjGEOM_CAPSULE
CORNERS = 2 * math.hypot(*CHASSIS_HALF[:2])  # m: no nearer can two centres be at every heading
SMALLEST_RING = {1: 0.88, 2: 1.5, 3: 1.98, 4: 2.6}


def draw(team_size):
    """Centres (draws, robots, 2), headings (draws, robots) and radii (draws,), in the smallest rings allowed."""
    ring = (SMALLEST_RING[team_size], SMALLEST_RING[team_size] + 0.5)
    team = ("leatherback",) * team_size
    return starts(replace(arenas.settings("sumo-2v2"), blue=team, red=team, rules=SumoRules(ring)))


def starts(settings):
    """The same of any arena's starts."""
    arena = settings.build(engine="c")
    qpos, _, game = jax.jit(jax.vmap(arena.place))(jax.random.split(jax.random.key(1), DRAWS))
    first = [arena.scene.agents[agent.name].qpos for agent in arena.agents]
    base = np.asarray(qpos)[:, np.array(first)[:, None] + np.arange(7)]  # (draws, robots, 7)
    return base[..., :2], 2 * np.arctan2(base[..., 6], base[..., 3]), np.asarray(game.radius)


@pytest.mark.parametrize("team_size", [1, 2, 3, 4])
def test_hulls_are_inside_the_ring_and_clear_of_each_other(team_size):
    xy, _, radius = draw(team_size)
    assert KINDS["leatherback"].hull >= CORNERS
    assert (np.linalg.norm(xy, axis=2) < radius[:, None]).all()
    assert nearest(xy) > CORNERS


def nearest(xy):
    """How near two robots ever start to each other, m."""
    gaps = np.linalg.norm(xy[:, :, None] - xy[:, None], axis=3)
    first, second = np.triu_indices(xy.shape[1], 1)
    return gaps[:, first, second].min()


@pytest.mark.parametrize("team_size", [1, 2])
def test_neither_team_is_better_off(team_size):
    xy, heading, _ = draw(team_size)
    blue, red = np.split(xy, 2, axis=1)
    np.testing.assert_allclose(blue.mean(axis=(0, 1)), [0.0, 0.0], atol=0.03)
    np.testing.assert_allclose(red.mean(axis=(0, 1)), [0.0, 0.0], atol=0.03)
    facing = np.cos(heading - np.arctan2(-xy[..., 1], -xy[..., 0]))  # 1: towards the centre
    for total_size in (xy[..., 0], xy[..., 1], np.linalg.norm(xy, axis=2), facing):
        ours, theirs = (x.reshape(-1) for x in np.split(total_size, 2, axis=1))
        assert ks_2samp(ours, theirs).pvalue > 0.01


def test_the_quick_start_starts_where_it_always_did():
    """As before rosters, lattice and slots were settings."""
    arena = arenas.load("sumo-2v2", engine="c")
    qpos, _, game = arena.place(jax.random.key(7))
    first, last = (arena.scene.agents[name].qpos for name in ("blue/0", "red/1"))
    assert game.radius == pytest.approx(2.12042, abs=1e-5)
    np.testing.assert_allclose(qpos[first : first + 7], [-0.88037, -0.32475, 0.052, 0.59171, 0, 0, 0.80615], atol=2e-5)
    np.testing.assert_allclose(qpos[last : last + 7], [-0.01055, 1.19562, 0.052, -0.66103, 0, 0, 0.75036], atol=2e-5)


def test_radii_are_drawn_from_the_whole_range():
    _, _, radius = draw(2)
    assert 1.5 <= radius.min() < 1.505
    assert 1.995 < radius.max() <= 2.0


# The lattice ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def paper():
    """Starts of the paper's arena with four ANYmals, the largest robots there are."""
    return starts(arenas.settings("sumo-2v2-anymal"))


def test_on_the_lattice_robots_are_clear_of_each_other_and_inside(paper):
    xy, _, radius = paper
    assert (np.linalg.norm(xy, axis=2) < radius[:, None] + 1e-5).all()
    assert nearest(xy) > 1.2 > KINDS["anymal"].hull
    steps = (xy + radius[:, None, None]) / 0.5
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-4)


def test_an_anymal_at_rest_lies_within_its_hull():
    robot = arenas.load("sumo-1v1-anymal", engine="c").scene
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.rest
    mujoco.mj_kinematics(robot.model, data)
    base = data.xpos[robot.agents["blue/0"].base]
    touching = [
        i for i in range(robot.model.ngeom)
        if robot.model.geom(i).name.startswith("blue/0/") and robot.model.geom_contype[i]
    ]  # fmt: skip
    for i in touching:
        radius, half = robot.model.geom_size[i][:2]
        axis = data.geom_xmat[i].reshape(3, 3)[:, 2] * (half if robot.model.geom_type[i] == CAPSULE else 0.0)
        for end in (data.geom_xpos[i] + axis, data.geom_xpos[i] - axis):
            assert math.hypot(*(end - base)[:2]) + radius < KINDS["anymal"].hull / 2


def test_every_place_is_as_likely_for_every_robot(paper):
    xy, heading, radius = paper
    shares = np.linalg.norm(xy, axis=2) / radius[:, None]
    for robot in (1, 2, 3):
        assert ks_2samp(shares[:, 0], shares[:, robot]).pvalue > 0.01
        assert ks_2samp(xy[:, 0, 0], xy[:, robot, 0]).pvalue > 0.01
    assert shares.min() < 0.05
    assert shares.max() > 0.99
    assert (shares**2).mean() == pytest.approx(0.5, abs=0.03)  # as of even density
    assert np.abs(np.cos(heading).mean(axis=0)).max() < 0.03


def test_the_original_lets_anymals_overlap_and_face_one_way():
    xy, heading, _ = starts(faithful(arenas.settings("sumo-2v2-anymal")))
    assert 0.6 < nearest(xy) < 0.8
    np.testing.assert_allclose(heading, np.pi / 2, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("clear", [(0.6,) * 4, (0.3,) * 4, (0.6, 0.6, 0.3, 0.3), (0.6, 0.25) * 3])
def test_things_of_unlike_size_find_room_in_the_smallest_ring_allowed(clear):
    smallest = lattice_ring(clear)
    keys = jax.random.split(jax.random.key(2), DRAWS)
    radii = jax.random.uniform(jax.random.key(3), (DRAWS,), minval=smallest, maxval=smallest + 0.5)
    xy = np.asarray(jax.jit(jax.vmap(lambda k, r: place_on_lattice(k, r, clear, smallest + 0.5)))(keys, radii))
    assert (np.linalg.norm(xy, axis=2) < np.asarray(radii)[:, None] + 1e-5).all()
    gaps = np.linalg.norm(xy[:, :, None] - xy[:, None], axis=3)
    for i in range(len(clear)):
        for j in range(i):
            assert gaps[:, i, j].min() > clear[i] + clear[j] - 1e-3
