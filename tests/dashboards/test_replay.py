"""Markers of a recorded match, as they are drawn beside its bodies."""

from dataclasses import replace

import numpy as np
import pytest

from dashboards.errors import ViewerError
from dashboards.replay import FORCE_LENGTH, Robot, drawn_markers, replay
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


@pytest.mark.parametrize(("body", "width"), [("red/0/wing", 4), ("red/0/chassis", 2)])
def test_a_force_that_fits_nothing_is_refused_in_one_line(body, width):
    match = cars()
    shown = replace(
        match, header=replace(match.header, marker_kinds={body: "force"}), markers={body: np.zeros((STEPS, width))}
    )
    with pytest.raises(ViewerError, match=rf"force on '{body}' has {width} numbers"):
        drawn_markers(shown, replay(shown))


def test_a_force_above_its_limit_or_not_a_number_stays_in_the_picture():
    match, body = cars(), "red/0/chassis"
    told = np.tile([0.0, 8.0, 0.0, 2.0], (STEPS, 1))
    told[3] = np.nan
    shown = replace(match, header=replace(match.header, marker_kinds={body: "force"}), markers={body: told})
    scene = replay(shown)
    _, segment = drawn_markers(shown, scene)[body]
    long = np.linalg.norm(segment[:, 3:] - segment[:, :3], axis=1)
    assert long == pytest.approx(np.where(np.arange(STEPS) == 3, 0, FORCE_LENGTH * max(r.size for r in scene.robots)))


def test_other_markers_are_drawn_as_they_were_told():
    match = cars()
    kind, values = drawn_markers(match, replay(match))["ring"]
    assert kind == "circle"
    assert values == pytest.approx(match.markers["ring"])


@pytest.mark.parametrize(("sizes", "labelled"), [((1, 1), [0, 1]), ((3, 2), [0, 1, 2, 3, 4]), ((8, 2), [0, 8, 9])])
def test_of_a_large_side_only_the_first_robot_has_a_label(sizes, labelled):
    robots = tuple(Robot(f"{side}/{i}", side, 1 + i, 0.1) for side, size in enumerate(sizes) for i in range(size))
    scene = replace(replay(cars()), robots=robots)
    assert [robots.index(robot) for robot in scene.labelled] == labelled
