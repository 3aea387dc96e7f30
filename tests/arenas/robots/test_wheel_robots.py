"""Robots whose models come in wheels of others: each stands, and has a page. Skipped where its wheel is missing."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from arenas.errors import ArenaError
from arenas.robots.files import catalogue
from arenas.robots.files.catalogue import WHEELS, model_path, robot_file, shipped
from arenas.robots.files.loading import file_robot
from arenas.robots.rotations import up_z
from arenas.scene.scene import build

ROOT = Path(__file__).parents[3]
# s; others 2. The humanoid has balls for feet, no ankles, and tips over after a second; the torques of the others'
# zero action hold no pose.
STANDS = {"humanoid": 0.5, "hopper": 0.5, "walker2d": 0.5}


@pytest.mark.parametrize("name", shipped())
def test_it_stands_on_the_ground(name):
    try:
        robot = file_robot(name)
    except ArenaError as missing:
        pytest.skip(str(missing))
    scene = build({"blue": [robot]}, timestep=0.005)
    data, at = mujoco.MjData(scene.model), scene.agents["blue/0"]
    data.qpos[:] = scene.rest
    data.ctrl[at.ctrl] = np.asarray(robot.command(np.zeros(robot.action_size, np.float32)))
    seconds = STANDS.get(name, 2.0)
    while data.time < seconds:
        mujoco.mj_step(scene.model, data)
    pose = np.asarray(at.pose(data.qpos))
    assert up_z(pose[3:]) > 0.98
    assert pose[2] > 0.8 * robot.rest_height
    assert not robot.fallen(pose)
    assert all(drive.effort > 0 for drive in robot_file(name).drives.values())


@pytest.mark.parametrize("name", shipped())
def test_a_missing_wheel_is_named_with_its_command(name, monkeypatch):
    monkeypatch.setattr(catalogue.importlib.util, "find_spec", lambda package: None)
    package = robot_file(name).model.partition(":")[0]
    with pytest.raises(ArenaError, match=rf"robot {name}: .* package {package}: pip install") as missing:
        model_path(robot_file(name))
    assert WHEELS[package].install in str(missing.value)


@pytest.mark.parametrize("name", shipped())
def test_it_has_a_page_with_a_small_picture_and_its_licence(name):
    text = (ROOT / "docs" / "robots" / f"{name}.md").read_text("utf-8")
    picture = ROOT / "docs" / "pictures" / "robots" / f"{name}.png"
    assert f"../pictures/robots/{name}.png" in text
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert picture.stat().st_size < 100_000
    package = robot_file(name).model.partition(":")[0]
    assert WHEELS[package].install in text
