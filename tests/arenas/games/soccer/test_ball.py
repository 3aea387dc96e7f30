"""Soccer's ball is a ball: it bounces, rolls and spins as its settings say, in MuJoCo, and robots can hit it."""

import math

import mujoco
import numpy as np
import pytest

from arenas.games.soccer import pitch
from arenas.games.soccer.rules import Ball, PitchRules
from arenas.scene import scene
from arenas.scene.props import ball as make_ball

HEIGHTS = (0.15, 0.3, 0.5, 0.8, 1.2, 2.0)  # m


def built(ball):
    """A rover in the middle, and the ball, on the pitch; with the solver that soccer's arenas have."""
    rules = PitchRules(ball=ball)
    kinds = ("leatherback",)
    return scene.build(
        {"blue": [pitch.robot(kind, rules) for kind in kinds]},
        pitch.build_props(rules),
        solver=pitch.solver(kinds),
        timestep=0.005,
    )


class Thrown:
    """The ball alone, well away from the rover, after a tenth of a second of rest."""

    def __init__(self, world, x=3.0, y=2.0, height=0.0, rest=20):
        self.model, self.data = world.model, mujoco.MjData(world.model)
        self.data.qpos[:] = world.rest
        self.at, self.speed = world.props["ball"].qpos, world.props["ball"].qvel
        self.data.qpos[self.at : self.at + 2] = x, y
        for _ in range(rest):
            mujoco.mj_step(self.model, self.data)
        self.data.qpos[self.at + 2] += height

    def fly(self, seconds):
        """Its places and velocities (T, 3) in the steps that follow."""
        places, velocities = [], []
        for _ in range(round(seconds / self.model.opt.timestep)):
            mujoco.mj_step(self.model, self.data)
            places.append(self.data.qpos[self.at : self.at + 3].copy())
            velocities.append(self.data.qvel[self.speed : self.speed + 3].copy())
        return np.array(places), np.array(velocities)


@pytest.mark.parametrize("restitution", [0.3, 0.6, 0.85])
def test_it_comes_up_again_as_its_restitution_says(restitution):
    """Speed goes with the root of height. One bounce is off by some hundredths, for steps cut the contact anywhere."""
    world, found = built(Ball(restitution=restitution)), []
    for height in HEIGHTS:
        places, velocities = Thrown(world, height=height).fly(1.5)
        up = np.flatnonzero(velocities[:, 2] > 0)[0]
        down = up + np.flatnonzero(velocities[up:, 2] < 0)[0]
        found.append(math.sqrt((places[down, 2] - 0.11) / height))
    np.testing.assert_allclose(found, restitution, atol=0.13)
    assert np.mean(found) == pytest.approx(restitution, abs=0.05)


def test_it_comes_back_from_a_wall_in_the_same_way():
    """In the air, and with hardly any friction, at five speeds."""
    world, found = built(Ball(sliding=0.05)), []
    for speed in (2.0, 2.5, 3.0, 4.0, 5.0):
        thrown = Thrown(world, x=9.1, height=1.5)
        thrown.data.qvel[thrown.speed] = speed
        _, velocities = thrown.fly(0.4)
        assert velocities[:, 0].max() == pytest.approx(speed, rel=1e-3)
        found.append(-velocities[-1, 0] / speed)
    np.testing.assert_allclose(found, 0.6, atol=0.13)
    assert np.mean(found) == pytest.approx(0.6, abs=0.06)


@pytest.mark.parametrize(("loss", "speed"), [(0.5, 1.0), (1.0, 1.5), (1.0, 3.0), (1.5, 1.5)])
def test_rolling_it_loses_speed_as_stated_and_stops(loss, speed):
    thrown = Thrown(built(Ball(roll_loss=loss)), x=-8.0)
    thrown.data.qvel[thrown.speed], thrown.data.qvel[thrown.speed + 4] = speed, speed / 0.11
    places, velocities = thrown.fly(speed / loss + 0.5)
    seconds = 0.5 * speed / loss
    assert velocities[0, 0] - velocities[round(seconds / 0.005), 0] == pytest.approx(loss * seconds, rel=0.12)
    assert places[-1, 0] + 8.0 == pytest.approx(speed**2 / (2 * loss), rel=0.12)
    assert np.abs(velocities[-1, :2]).max() < 0.02


@pytest.mark.parametrize(("loss", "spin"), [(10.0, 10.0), (10.0, -4.0), (30.0, 20.0)])
def test_spinning_on_the_spot_it_stops_spinning(loss, spin):
    thrown = Thrown(built(Ball(spin_loss=loss)))
    thrown.data.qvel[thrown.speed + 5] = spin
    places, _ = thrown.fly(0.5 * abs(spin) / loss)
    assert thrown.data.qvel[thrown.speed + 5] == pytest.approx(spin / 2, rel=0.1)
    thrown.fly(0.6 * abs(spin) / loss)
    assert abs(thrown.data.qvel[thrown.speed + 5]) < 0.1
    np.testing.assert_allclose(places[-1, :2], [3.0, 2.0], atol=1e-3)


def test_it_is_hollow_and_weighs_what_its_settings_say():
    world = built(Ball(radius=0.1, mass=0.3))
    body = world.props["ball"].body
    assert world.model.body_mass[body] == pytest.approx(0.3)
    np.testing.assert_allclose(world.model.body_inertia[body], 2 / 3 * 0.3 * 0.1**2, rtol=1e-6)
    solid = make_ball(radius=0.1, mass=0.3).build().compile()
    np.testing.assert_allclose(solid.body_inertia[1], 2 / 5 * 0.3 * 0.1**2, rtol=1e-6)


@pytest.mark.parametrize("speed", [0.5, 1.0, 1.5, 1.84, 2.2, 2.6])
@pytest.mark.parametrize("aside", [0.0, 0.08])
def test_a_rover_that_rams_it_stays_on_its_wheels_and_the_ball_on_the_ground(speed, aside):
    """A solver that had not converged threw balls away at 16 m/s, and rovers on their backs.

    The ball leaves with (1 + e) m/(m + M) of the rover's speed, 1.44 of it, and less than twice that in any case.
    """
    world = built(Ball())
    thrown = Thrown(world, x=0.5, y=aside)
    rover, data = world.agents["blue/0"], thrown.data
    data.qvel[rover.qvel] = speed
    for joint in (thrown.model.joint(i) for i in range(thrown.model.njnt)):
        if joint.name.endswith("_spin"):
            data.qvel[joint.dofadr[0]] = speed / 0.052
    data.ctrl[rover.ctrl] = [speed / 0.052] * 4 + [0.0] * 2
    places, velocities = thrown.fly(0.4)
    assert speed < np.linalg.norm(velocities, axis=1).max() < 2.0 * speed
    assert places[:, 2].max() < 0.18
    assert data.qpos[rover.qpos + 2] < 0.06
