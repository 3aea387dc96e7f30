"""What robots say of what they feel and do is as long as what they feel and do."""

import pytest

from arenas.about import numbers
from arenas.robots.anymal import anymal
from arenas.robots.crazyflie import crazyflie
from arenas.robots.leatherback import leatherback
from arenas.robots.minitank import minitank
from arenas.robots.puck import PUCK
from arenas.sumo.settings import KINDS

ROBOTS = (anymal(), crazyflie(), leatherback(), minitank(), PUCK)


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.kind)
def test_every_number_has_a_name(robot):
    assert numbers(robot.proprioception_parts) == robot.feeling
    assert numbers(robot.action_parts) == robot.action_size


@pytest.mark.parametrize("kind", KINDS)
def test_light_settings_know_the_same_numbers(kind):
    (robot,) = (robot for robot in ROBOTS if robot.kind == kind)
    assert (KINDS[kind].feels, KINDS[kind].acts) == (robot.feeling, robot.action_size)
