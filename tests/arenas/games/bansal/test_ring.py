"""Sumo by Bansal et al.'s rules: out, down, and whether they have touched; and the distance of two bodies."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from arenas.games.bansal.body_distance import BodyShape, gap
from arenas.games.bansal.ring_sumo import Ring
from tests.arenas.games.bansal.contests import built, judged, outcome, put, state
from tests.arenas.hooks import judging

UP, DOWN = 0.5, 0.29


@pytest.fixture(scope="module")
def sumo():
    return built("sumo-ants")


def ring(touched):
    return Ring(jnp.asarray(3.0), jnp.asarray(touched))


BOUTS = [
    # bases, touched, time, score, rewards
    (((-2.9, 0, UP), (2.9, 0, UP)), True, 1.0, None, (0, 0)),
    (((-3.1, 0, UP), (2.9, 0, UP)), True, 1.0, (0, 1), (-1, 1)),
    (((-3.1, 0, UP), (2.9, 0, UP)), False, 1.0, (0.5, 0.5), (-1, 0)),
    (((-2.0, 0, UP), (2.0, 0, DOWN)), True, 1.0, (1, 0), (1, -1)),
    (((-2.0, 0, DOWN), (2.0, 3.0, UP)), True, 1.0, (0.5, 0.5), (-1, -1)),
    (((-2.0, 0, UP), (2.0, 0, UP)), True, 7.5, (0.5, 0.5), (-1, -1)),
]


@pytest.mark.parametrize(("bases", "touched", "time", "score", "rewards"), BOUTS)
@pytest.mark.parametrize("second_first", [False, True])
def test_out_or_down_loses_and_wins_for_the_other_only_after_a_touch(
    sumo, bases, touched, time, score, rewards, second_first
):
    verdict = judged(sumo, bases, ring(touched), second_first, time=time)
    assert outcome(verdict) == (score, rewards)


@pytest.mark.parametrize(("apart", "touch"), [(1.2, True), (2.2, False)])
def test_a_touch_is_remembered(sumo, apart, touch):
    now = put(sumo, ((0.0, 0.0, UP), (apart, 0.0, UP)))
    game, verdict = judging(sumo)(now, now, state(sumo, ring(False)))
    assert bool(game.own.touched) is touch
    assert verdict.events["touch"].tolist() == [touch, touch]


def test_with_auto_contact_a_fall_alone_loses_and_no_place_is_read():
    arena = built("sumo-ants", auto_contact=True)
    first = jax.jit(jax.vmap(arena.reset))(jax.random.split(jax.random.key(0), 4))
    assert np.asarray(first.game.own.touched).all()
    assert first.physics.xpos is None
    verdict = judged(arena, ((-2.0, 0, DOWN), (2.0, 0, UP)), ring(True))
    assert outcome(verdict) == ((0, 1), (-1, 1))


@pytest.mark.parametrize("name", ["sumo-ants", "sumo-humanoids"])
def test_all_start_apart_and_in_the_ring(name):
    arena = built(name)
    qpos, _, game = jax.jit(jax.vmap(arena.place))(jax.random.split(jax.random.key(0), 300))
    low, high = arena.rules.ring
    xy = np.asarray(qpos)[:, np.array([at.qpos for at in arena.bodies_at])[:, None] + np.arange(2)]
    radius, swapped = np.asarray(game.own.radius), np.asarray(game.second_first)
    assert low <= radius.min() < low + 0.1 * (high - low) and high - 0.1 * (high - low) < radius.max() <= high  # noqa: PT018
    assert (np.linalg.norm(xy, axis=-1) < radius[:, None] - arena.rules.edge + 0.15).all()
    left = np.where(swapped, xy[:, 1, 0], xy[:, 0, 0])
    assert (left < 0.1 - arena.rules.apart).all()
    assert 0.4 < swapped.mean() < 0.6
    data, first = mujoco.MjData(arena.scene.model), arena.scene.agents[arena.names[0]]
    for each in np.asarray(qpos)[:100]:
        data.qpos[:] = each
        mujoco.mj_forward(arena.scene.model, data)
        pairs = arena.scene.model.body_rootid[arena.scene.model.geom_bodyid[data.contact.geom[: data.ncon]]]
        between = (pairs > 0).all(axis=1) & ((pairs == first.base).sum(axis=1) == 1)
        assert not between.any()


@pytest.mark.parametrize("name", ["sumo-ants", "sumo-humanoids"])
def test_the_distance_of_two_bodies_is_that_of_mujoco(name):
    arena, rng = built(name), np.random.default_rng(0)
    model = arena.scene.model
    geoms = [[g for g in range(model.ngeom) if model.geom(g).name.startswith(f"{n}/")] for n in arena.names]
    shapes = [BodyShape(model, f"{n}/") for n in arena.names]
    far = jax.jit(lambda xpos, xquat: gap(*(shape.segments(xpos, xquat) for shape in shapes)))
    data = mujoco.MjData(model)
    for _ in range(8):
        data.qpos[:] = arena.scene.rest + rng.uniform(-0.4, 0.4, model.nq)
        for at, x in zip(arena.bodies_at, (0.0, rng.uniform(0.5, 2.5)), strict=True):
            data.qpos[at.qpos : at.qpos + 3] = [x, rng.uniform(-0.3, 0.3), 1.0]
            data.qpos[at.qpos + 3 : at.qpos + 7] = rng.normal(size=4)
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_kinematics(model, data)
        theirs = min(mujoco.mj_geomDistance(model, data, a, b, 10.0, None) for a in geoms[0] for b in geoms[1])
        ours = float(far(jnp.asarray(data.xpos, jnp.float32), jnp.asarray(data.xquat, jnp.float32)))
        if theirs > 0.0:
            assert ours == pytest.approx(theirs, abs=1e-4)
        else:
            assert ours < 1e-4
