"""3D Galaga: what its robots see, number by number, and where they start."""

import math
import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from arenas.description import with_indices
from arenas.games.galaga.settings import FIELD, HULLS, Area, Defects, faithful
from arenas.games.galaga.stages import FlyRules, FlySettings
from tests.arenas.galaga_worlds import PIVOT, game, put, variant

S = math.sqrt(0.5)
LEFT = (S, 0.0, 0.0, S)  # level, facing +y


def seen(arena, physics, playing):
    still = {name: jnp.zeros(robot.action_size) for name, robot in arena.robots.items()}
    return {name: np.asarray(x) for name, x in jax.jit(arena.observe)(physics, playing, still).items()}


def placed(arena, seed=0, worlds=256):
    qpos, _, playing = jax.jit(jax.vmap(arena.place))(jax.random.split(jax.random.key(seed), worlds))
    return np.asarray(qpos), playing


# Numbers --------------------------------------------------------------------------------------------------------------


def test_one_on_one_they_see_ten_and_twelve_numbers():
    arena = variant("galaga-1v1")
    physics = put(
        arena, [(0.0, 4.0, PIVOT)], barrels=[(math.pi / 2, 0.0)], quat=LEFT, velocity=(1, 2, 3), rates=(4, 5, 6)
    )
    at = arena.scene.agents["blue/0"]
    physics = physics._replace(qvel=physics.qvel.at[at.joint_qvel].set(jnp.array([0.5, -0.25])))
    found = seen(arena, physics, game([(3.0, 4.0, PIVOT + 1)]))
    # to the left: a quarter turn about z; straight up: one about -y
    np.testing.assert_allclose(found["blue/0"], [0.5, -0.25, S, 0, 0, S, S, 0, -S, 0], atol=1e-6)
    # its x is the world's y, its y the world's -x
    np.testing.assert_allclose(found["red/0"], [2, -1, 3, 4, 5, 6, 0, 0, -1, 0, -3, 1], atol=1e-5)


def test_two_on_two_they_see_eighteen_and_twenty():
    arena = variant("galaga-2v2")
    drones, tanks = [(-3.0, 0.0, 4.0), (-3.0, 2.0, 3.0)], ((3.0, 1.0), (5.0, -2.0))
    found = seen(arena, put(arena, drones, tanks, ((0.0, 0.0),) * 2), game([(3.0, 1.0, 2.05), (5.0, -2.0, 2.05)]))
    blue, red = found["blue/0"], found["red/0"]
    assert (len(blue), len(red)) == (18, 20)
    way = np.array([-6.0, -1.0, 4.0 - PIVOT])
    x, y, z = way / np.linalg.norm(way)
    np.testing.assert_allclose(blue[2:6], np.array([1 + x, 0, -z, y]) / math.sqrt(2 + 2 * x), atol=1e-5)
    np.testing.assert_allclose(blue[6:10], [1, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(
        blue[10:], [-6, -1, 3.95, 2, -3, 0, 2, -3], atol=1e-5
    )  # the team-mate, and cut off again
    np.testing.assert_allclose(red[9:], [6, 1, -1.95, 0, 2, -1, 0, 2, -1, 5, 2], atol=1e-5)


def test_a_third_of_a_team_is_seen_in_place_of_the_copy():
    arena = variant("galaga-2v2", tanks=3, drones=3)
    drones = [(-3.0, 0.0, 4.0), (-3.0, 2.0, 3.0), (-5.0, -2.0, 3.0)]
    tanks = ((3.0, 1.0), (5.0, -2.0), (4.0, 4.0))
    found = seen(arena, put(arena, drones, tanks, ((0.0, 0.0),) * 3), game([(9.0, 9.0, 9.0)] * 3))
    np.testing.assert_allclose(found["blue/1"][13:18], [-1, 6, 0, -2, 3], atol=1e-5)
    np.testing.assert_allclose(found["red/2"][12:18], [2, 2, 1, 2, 4, 0], atol=1e-5)


def test_rich_observation_shows_enemies_behind_the_slots():
    arena = variant("galaga-1v1", rich=True, buffer=8)
    physics = put(arena, [(0.0, 4.0, 3.0)], barrels=[(0.0, 0.0)], quat=LEFT, velocity=(1, 2, 3))
    found = seen(arena, physics, game([(0.0, 0.0, 5.0)]))
    np.testing.assert_allclose(found["blue/0"][10:], [0, 4, 2.95, 1, 2, 3, 1, 0], atol=1e-5)
    np.testing.assert_allclose(found["red/0"][12:], [-4, 0, PIVOT - 3, 0, -1, 0, 0, 0], atol=1e-5)
    names = [part.name for _, part in with_indices(arena.observation_parts("red/0"))]
    assert names[-3:] == ["tank's position", "tank's barrel", "buffer"]


@pytest.mark.parametrize("size", ["1v1", "2v2"])
def test_a_stage_shows_what_its_match_will_show(size):
    match, drone, place = arenas.load(f"galaga-{size}", engine="c"), (-3.0, 0.0, 4.0), (5.0, 2.0, 4.05)
    count = len(match.drones)
    physics = put(match, [drone] * count, ((0.0, 0.0),) * count, ((0.2, 0.1),) * count)
    whole = seen(match, physics, game([place] * count))
    aim, fly = (arenas.load(f"galaga-{stage}-{size}", engine="c") for stage in ("aim", "fly"))
    aims = seen(aim, put(aim, barrels=((0.2, 0.1),)), jnp.array(drone))["blue/0"]
    flies = seen(fly, put(fly, [drone]), jnp.array(place))["red/0"]
    np.testing.assert_allclose(aims[:13], whole["blue/0"][:13], atol=1e-5)
    np.testing.assert_allclose(flies[:12], whole["red/0"][:12], atol=1e-5)
    assert not aims[13:].any()
    assert not flies[12:18].any()
    np.testing.assert_allclose(flies[18:], whole["red/0"][18:], atol=1e-5)


# Starts ---------------------------------------------------------------------------------------------------------------


def test_one_on_one_starts_are_harl_as_and_fresh():
    arena = variant("galaga-1v1")
    qpos, playing = placed(arena)
    drone, tank = (arena.scene.agents[name].qpos for name in ("red/0", "blue/0"))
    places, goals = qpos[:, drone : drone + 3], np.asarray(playing.goals[:, 0])
    for values, low, high in (
        (places[:, 0], -10, 10), (places[:, 1], -10, 10), (goals[:, 0], -10, 10), (goals[:, 2], 3, 6),
        (qpos[:, arena.scene.agents["blue/0"].joint_qpos[0]], -0.1, 1.5),
        (qpos[:, arena.scene.agents["blue/0"].joint_qpos[1]], -math.pi, math.pi),
    ):  # fmt: skip
        assert low <= values.min() < low + 0.05 * (high - low)
        assert high >= values.max() > high - 0.05 * (high - low)
    np.testing.assert_allclose(places[:, 2], 3.0)
    np.testing.assert_allclose(qpos[:, tank : tank + 3], np.tile([0, 0, 0.05], (256, 1)), atol=1e-6)


def test_many_start_clear_of_each_other_and_of_the_walls():
    arena = variant("galaga-2v2", tanks=6, drones=5)
    qpos, playing = placed(arena)
    for names, hull in ((arena.tanks, HULLS["tank"]), (arena.drones, HULLS["drone"])):
        at = np.stack([qpos[:, arena.scene.agents[name].qpos :][:, :3] for name in names], axis=1)
        gaps = np.linalg.norm(at[:, :, None, :2] - at[:, None, :, :2], axis=-1) + 9 * np.eye(len(names))
        assert gaps.min() >= hull - 1e-5
        assert (np.abs(at[..., :2]) < FIELD).all()
        assert len({tuple(np.argsort(y)) for y in at[..., 1]}) > 50  # who is in which lane is drawn by lot
    assert playing.alive.all()


def test_the_originals_game_of_two_begins_as_ever():
    arena = faithful(arenas.settings("galaga-2v2")).build(engine="c")
    qpos, _ = placed(arena, worlds=2)
    np.testing.assert_array_equal(qpos[0], qpos[1])
    starts = {"blue/0": (3, -0.5, 0.2), "blue/1": (3, 0.5, 0.2), "red/0": (-3, -0.1, 3), "red/1": (-3, 0.1, 3)}
    for name, at in starts.items():
        pose = qpos[0, arena.scene.agents[name].qpos :][:7]
        np.testing.assert_allclose(pose, [*at, 1, 0, 0, 0], atol=1e-6)


def test_every_defect_belongs_to_a_game_of_the_original():
    one, two = (faithful(arenas.settings(f"galaga-{size}")).rules.defects for size in ("1v1", "2v2"))
    assert one == Defects(late_end=True)
    assert replace(two, late_end=True) == Defects(True, True, True, True)


# Settings -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rules", "counts", "says"),
    [
        ({"goals": 3}, {}, "rules.goals: 3 is more than the drones, 2; 1 to all of them"),
        ({"drones_at": Area((-8, -2), (0, 0), (0.2, 3))}, {}, "rules.drones_at.y: [0, 0] is too narrow for 2 side"),
        ({"drones_at": Area((-8, -2), (-3, 3), (0.2, 3))}, {}, "rules.drones_at.z: [0.2, 3] must begin above rules.f"),
        ({"tanks_at": Area((2, 9.6), (-3, 3))}, {}, "rules.tanks_at.x: [2, 9.6] reaches into a wall; between -9.45"),
        (
            {},
            {"tanks": 15},
            "rules.tanks_at.y: [-3.5, 3.5] is too narrow for 15 side by side, each 0.5 m; at least 7.5 m",
        ),
    ],
)
def test_settings_that_cannot_be_are_refused_in_one_line(rules, counts, says):
    settings = arenas.settings("galaga-2v2")
    with pytest.raises(ValueError, match=re.escape(says)) as caught:
        replace(settings, rules=replace(settings.rules, **rules), **counts)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Area(x=(1.0, 0.0)), "x: [1.0, 0.0] must be two numbers in metres, lowest and highest"),
        (lambda: Area(z=(-1.0, 0.0)), "z: [-1.0, 0.0] must begin at the ground, 0, or above"),
        (lambda: FlySettings(rules=FlyRules(drone=Area(z=(0.1, 1.0)))), "rules.drone.z: [0.1, 1.0] must begin above"),
        (lambda: FlySettings(rules=FlyRules(walls=True)), "rules.drone.x: [-10.0, 10.0] reaches into a wall; between"),
    ],
)
def test_areas_and_stages_that_cannot_be_are_refused(make, says):
    with pytest.raises(ValueError, match=re.escape(says)):
        make()
