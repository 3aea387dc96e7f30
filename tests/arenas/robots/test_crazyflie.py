"""Crazyflie: the compiled body, what thrust and moments do to it, and a flight that hovers."""

import jax.numpy as jnp
import numpy as np
import pytest

from arenas.robots.crazyflie import HOVER, MASS, crazyflie, crazyflie_rates, throttle
from tests.arenas.robots.yard import Yard, steadily

WEIGHT = 0.027 * 9.81  # N


@pytest.fixture(scope="module")
def yard():
    return Yard(crazyflie(), lifted=3.0)


def test_the_compiled_body_has_the_numbers_of_its_table(yard):
    model = yard.scene.model
    assert model.body_subtreemass[yard.at.base] == pytest.approx(0.027) == MASS
    np.testing.assert_allclose(model.body_inertia[yard.at.base], [2.3951e-5, 2.3951e-5, 3.2347e-5])
    assert [model.actuator(i).name for i in yard.at.ctrl] == [f"solo/0/{n}" for n in ("thrust", "roll", "pitch", "yaw")]
    limits = [[0, 1.9 * WEIGHT], [-0.01, 0.01], [-0.01, 0.01], [-0.01, 0.01]]
    np.testing.assert_allclose(model.actuator_ctrlrange[yard.at.ctrl], limits, rtol=1e-6)


def test_without_thrust_it_falls_freely(yard):
    played = yard.play(steadily(-1.0, 0.0, 0.0, 0.0), 0.6)
    fall = 3.0 + yard.robot.rest_height - yard.base(played)[-1, 2]
    assert fall == pytest.approx(9.81 * 0.6**2 / 2, rel=0.02)


def test_actions_are_clipped_and_mean_thrust_in_weights(yard):
    command = yard.robot.command(jnp.array([9.0, -9.0, 0.5, 0.0]))
    np.testing.assert_allclose(command, [1.9 * WEIGHT, -0.01, 0.005, 0.0], rtol=1e-5)
    np.testing.assert_allclose(yard.robot.command(jnp.zeros(4))[0], 0.95 * WEIGHT, rtol=1e-5)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_moment_turns_it_about_its_axis(yard, axis):
    action = np.zeros(4)
    action[1 + axis] = 0.1
    rates = yard.play(steadily(*action), 0.02).physics.qvel[-1][yard.at.qvel + 3 : yard.at.qvel + 6]
    expected = np.zeros(3)
    expected[axis] = 0.1 * (417.5, 417.5, 309.1)[axis] * 0.02  # rad/s
    np.testing.assert_allclose(rates, expected, rtol=0.06, atol=1e-4)


def test_at_the_throttle_that_carries_its_weight_it_stays_where_it_is(yard):
    assert pytest.approx(0.053, abs=1e-3) == HOVER
    played = yard.play(steadily(HOVER, 0.0, 0.0, 0.0), 10.0)
    np.testing.assert_allclose(yard.base(played)[-1, :3], [0, 0, 3 + yard.robot.rest_height], atol=0.02)


def test_a_thrown_drone_brakes_levels_and_hovers(yard):
    """Thrown at 2 m/s, falling, tilted by 0.6 rad and tumbling at 5 rad/s."""
    import jax

    state = yard.reset(jax.random.key(0))
    qpos = state.physics.qpos.at[yard.at.qpos + 3 : yard.at.qpos + 7].set(
        jnp.array([jnp.cos(0.3), jnp.sin(0.3), 0.0, 0.0])
    )
    qvel = jnp.array([2.0, 1.0, -1.0, 5.0, -3.0, 2.0])
    state = state._replace(physics=yard.engine.make(qpos, qvel))
    played = yard.play(yard.robot.scripts["hover"], 8.0, start=state)
    end = played.observations["solo/0"][-1]
    np.testing.assert_allclose(end, [0, 0, 0, 0, 0, 0, 0, 0, -1], atol=0.05)
    assert yard.base(played)[:, 2].min() > 2.0


def test_it_feels_velocity_rates_and_the_way_down_in_its_own_frame(yard):
    """On its side, left up, moving east: east is ahead; down is to its right."""
    import jax

    state = yard.reset(jax.random.key(0))
    quat = jnp.array([jnp.sqrt(0.5), jnp.sqrt(0.5), 0.0, 0.0])
    qpos = state.physics.qpos.at[yard.at.qpos + 3 : yard.at.qpos + 7].set(quat)
    physics = yard.engine.make(qpos, jnp.array([1.0, 0.0, 2.0, 3.0, 4.0, 5.0]))
    proprioception_size = yard.observe(physics, (), {"solo/0": jnp.zeros(4)})["solo/0"]
    np.testing.assert_allclose(proprioception_size, [1, 2, 0, 3, 4, 5, 0, -1, 0], atol=1e-6)


def test_on_the_ground_it_rests_on_its_hull_and_counts_as_fallen():
    yard = Yard(crazyflie())
    played = yard.play(steadily(-1.0, 0.0, 0.0, 0.0), 1.0)
    assert yard.base(played)[-1, 2] == pytest.approx(0.0145, abs=1e-3)
    assert played.verdict.events["fall"].all()
    assert not crazyflie(floor=-1.0).fallen(yard.base(played)[-1])


def test_turning_for_ever_it_does_not_exceed_a_hundred_radians_per_second(yard):
    rates = yard.play(steadily(0.0, 0.0, 0.0, 1.0), 2.0).physics.qvel[:, yard.at.qvel + 5]
    assert 90 < rates[-1] <= 101


# Commanded by rates ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def racer():
    return Yard(crazyflie_rates(), lifted=3.0)


@pytest.mark.parametrize(("axis", "limit", "lag"), [(0, 100, 0.020), (1, 100, 0.020), (2, 200, 0.027)])
def test_rates_are_reached_with_the_lag_of_the_table_and_held(racer, axis, limit, lag):
    action = np.zeros(4)
    action[1 + axis] = 0.5
    played = racer.play(steadily(*action), 0.4).physics.qvel[:, racer.at.qvel + 3 : racer.at.qvel + 6]
    wanted = np.zeros(3)
    wanted[axis] = np.radians(limit) / 2
    np.testing.assert_allclose(played[-1], wanted, atol=0.01 * wanted.max())
    share = played[0, axis] / wanted[axis]  # after a decision
    elapsed = racer.timing.decision_interval
    assert share == pytest.approx(1 - np.exp(-elapsed / lag), abs=0.05)


def test_its_throttle_is_in_weights_and_zero_carries_it(racer):
    for action, weights in ((-1.0, 0.0), (-0.5, 0.5), (0.0, 1.0), (0.5, 2.075), (1.0, 3.15), (7.0, 3.15)):
        command = racer.robot.command(jnp.array([action, 0.0, 0.0, 0.0]))
        np.testing.assert_allclose(command[0], weights * WEIGHT, rtol=1e-5, atol=1e-7)
        assert float(throttle(jnp.array(weights))) == pytest.approx(min(action, 1.0), abs=1e-6)
    played = racer.play(steadily(0.0, 0.0, 0.0, 0.0), 2.0)
    np.testing.assert_allclose(racer.base(played)[-1, :3], [0, 0, 3 + racer.robot.rest_height], atol=0.01)
