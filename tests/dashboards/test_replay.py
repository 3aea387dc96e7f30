"""What is drawn beside the bodies of a recorded match."""

from dataclasses import replace

import numpy as np
import pytest

from dashboards.replay import FORCE_LENGTH, drawn_markers, replay
from tests.dashboards.cars import STEPS, cars


def test_a_force_is_a_segment_from_its_body_along_it():
    match = cars()
    told = {"red/0/chassis": np.tile([0.0, 3.0, 0.0, 6.0], (STEPS, 1)), "blue/0/chassis": np.zeros((STEPS, 4))}
    shown = replace(match, header=replace(match.header, marker_kinds=dict.fromkeys(told, "force")), markers=told)
    scene = replay(shown)
    largest = max(robot.size for robot in scene.robots)
    kind, segment = drawn_markers(shown, scene)["red/0/chassis"]
    at = scene.xpos[:, scene.model.body("red/0/chassis").id]
    assert kind == "segment"
    np.testing.assert_allclose(segment[:, :3], at)
    np.testing.assert_allclose(segment[:, 3:] - at, np.tile([0, 0.5 * FORCE_LENGTH * largest, 0], (STEPS, 1)))
    _, none = drawn_markers(shown, scene)["blue/0/chassis"]
    np.testing.assert_array_equal(none[:, :3], none[:, 3:])


def test_other_markers_are_drawn_as_they_were_told():
    match = cars()
    kind, values = drawn_markers(match, replay(match))["ring"]
    assert kind == "circle"
    assert values == pytest.approx(match.markers["ring"])
