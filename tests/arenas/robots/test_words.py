"""What robots say of what they feel and do is as long as what they feel and do."""

import pytest

from arenas.description import total_size
from arenas.games.sumo.settings import KINDS
from arenas.robots.anymal import anymal
from arenas.robots.crazyflie import crazyflie, crazyflie_rates
from arenas.robots.leatherback import leatherback
from arenas.robots.minitank import minitank
from arenas.robots.puck import PUCK

ROBOTS = (anymal(), crazyflie(), crazyflie_rates(), leatherback(), minitank(), PUCK)


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.kind)
def test_every_number_has_a_name(robot):
    assert total_size(robot.proprioception_parts) == robot.proprioception_size
    assert total_size(robot.action_parts) == robot.action_size


@pytest.mark.parametrize("kind", KINDS)
def test_light_settings_know_the_same_numbers(kind):
    (robot,) = (robot for robot in ROBOTS if robot.kind == kind)
    assert (KINDS[kind].proprioception_size, KINDS[kind].action_size) == (robot.proprioception_size, robot.action_size)
