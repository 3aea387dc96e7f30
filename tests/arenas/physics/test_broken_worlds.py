"""Worlds of the C engine beside a broken one, which share a thread and its memory."""

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

import arenas
from arenas.physics.mujoco_c import Simulations

WORLDS, STEPS = 3, 6


@pytest.fixture(scope="module")
def model():
    """Four drones, of which MuJoCo 3.17 loses the damping in the world after one that is all NaN."""
    return arenas.load("gate-race-4", engine="c", threads=1).scene.model


def advanced(model, name, value, substeps):
    """Velocities (STEPS, WORLDS, nv) while the first world has `value` in its state from the start."""
    worlds = Simulations(Batch(model, WORLDS, 1), ())
    drones = worlds.state["qpos"].reshape(WORLDS, -1, 7)
    drones[:, :, :3] = [[3.0 * i, 0.0, 2.0] for i in range(drones.shape[1])]
    worlds.state["qvel"][:] = 0.3
    if name:
        worlds.state[name][0] = value
    found, failed = [], []
    for _ in range(STEPS):
        failed.append(worlds.advance(substeps, None, worlds.state["ctrl"]))
        found.append(worlds.state["qvel"].copy())
    return np.array(found), np.array(failed)


@pytest.mark.parametrize(
    ("name", "value", "substeps"),
    [("qpos", np.nan, 1), ("qvel", np.nan, 1), ("qvel", np.inf, 2), ("qvel", 1e300, 8)],
    ids=["nan places", "nan velocities", "infinite velocities", "breaks within a call"],
)
def test_others_move_as_they_do_alone(model, name, value, substeps):
    alone, well = advanced(model, None, 0.0, substeps)
    beside, failed = advanced(model, name, value, substeps)
    assert not well.any()
    assert failed[-1].tolist() == [True, False, False]
    np.testing.assert_array_equal(beside[:, 1:], alone[:, 1:])
    assert np.isnan(beside[-1, 0]).all()


def test_mujoco_itself_lets_a_broken_world_disturb_others(model):
    """Once it does not, `Simulations` may step broken worlds with the others."""
    mujoco.set_mju_user_warning(lambda message: None)
    found = []
    for value in (0.0, np.nan):
        batch = Batch(model, WORLDS, 1)
        qpos, qvel = batch.bind("qpos"), batch.bind("qvel")
        drones = qpos.reshape(WORLDS, -1, 7)
        drones[:, :, :3] = [[3.0 * i, 0.0, 2.0] for i in range(drones.shape[1])]
        qvel[:] = 0.3
        qpos[0] += value
        batch.step(nstep=1)
        found.append(qvel[1:].copy())
    assert not np.array_equal(*found)
