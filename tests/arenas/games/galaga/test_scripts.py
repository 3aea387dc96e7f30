"""3D Galaga's scripts, played on the C engine, and the stages in which robots are alone."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from arenas.games.galaga import scripts
from tests.arenas.galaga_worlds import PIVOT, compiled, ending, put, variant

WORLDS = 32
DT = 0.02  # s


def play(arena, *sides, worlds=WORLDS, seconds=5.0):
    """Score of the first team (worlds,), or nan where the game goes on, and how long each took, s."""
    known, steps = arena.scripts(), round(seconds / DT)
    acting = {a.name: known[side][a.kind] for team, side in zip(arena.teams, sides, strict=True) for a in team.agents}

    def decision(state, key):
        keys = jax.random.split(key, worlds)
        chosen = {name: jax.vmap(act)(state.observations[name], keys) for name, act in acting.items()}
        state = jax.vmap(arena.step)(state, chosen)
        return state, (state.done, state.verdict.score[:, 0], state.void)

    @jax.jit
    def run(key):
        start = jax.vmap(arena.reset)(jax.random.split(key, worlds))
        return jax.lax.scan(decision, start, jax.random.split(key, steps))[1]

    done, score, void = jax.device_get(run(jax.random.key(0)))
    assert not void.any()
    return np.where(done[-1], score[-1], np.nan), DT * (~done).sum(axis=0)


def test_a_gunner_hits_who_is_idle_within_two_seconds():
    score, seconds = play(variant("galaga-1v1"), "gunner", "idle", seconds=2.0)
    assert (score == 1).mean() >= 0.9
    assert np.median(seconds) < 0.8


@pytest.mark.slow
def test_a_flyer_is_at_its_goal_before_an_idle_tank_can_hit():
    score, seconds = play(variant("galaga-1v1"), "idle", "flyer")
    assert (score == 0).mean() >= 0.9
    assert seconds.mean() < 4.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "sides", "wins"),
    [
        ("1v1", ("idle", "dodger"), 0), ("2v2", ("gunner", "idle"), 1), ("2v2", ("idle", "flyer"), 0),
        ("2v2", ("idle", "dodger"), 0),
    ],
)  # fmt: skip
def test_scripts_beat_who_is_idle(size, sides, wins):
    score, _ = play(variant(f"galaga-{size}"), *sides, worlds=128, seconds=8.0)
    assert (score == wins).mean() >= 0.9


@pytest.mark.parametrize(
    ("size", "worlds"),
    [
        pytest.param("2v2", 64, marks=pytest.mark.slow),
        pytest.param("1v1", 200, marks=pytest.mark.gpu),
        pytest.param("2v2", 200, marks=pytest.mark.gpu),
    ],
)
def test_random_play_stays_sound(size, worlds):
    settings = arenas.settings(f"galaga-{size}")
    arena = replace(settings, rules=replace(settings.rules, floor=None)).build(engine="c")
    play(arena, "random", "random", worlds=worlds, seconds=20.0)  # it asserts that no world is void


# Actions --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("target", "action"),
    [((0.0, 0.02), (0.0, 1.0)), ((0.0, -0.02), (0.0, -1.0)), ((0.02, 0.0), (1.0, 0.0)), ((0.0, 3.1), (0.0, 1.0))],
)
def test_a_gunner_turns_the_shorter_way(target, action):
    arena = variant("galaga-1v1")
    far, (up, left) = 8.0, target
    level = far * math.cos(up)
    drone = (level * math.cos(left), level * math.sin(left), PIVOT + far * math.sin(up))
    still = {name: jnp.zeros(robot.action_size) for name, robot in arena.robots.items()}
    playing = jax.jit(arena.place)(jax.random.key(0))[2]
    seen = jax.jit(arena.observe)(put(arena, [drone]), playing, still)["blue/0"]
    np.testing.assert_array_equal(jnp.sign(jnp.round(scripts.gunner(5.0, seen, None), 2)), action)


def test_a_flyer_at_its_goal_hovers():
    level = jnp.zeros(12).at[8].set(-1.0)
    np.testing.assert_allclose(scripts.flyer(level, None), [2 / 1.9 - 1, 0, 0, 0], atol=1e-5)
    ahead = scripts.flyer(level.at[9].set(5.0), None)  # nose down, and more thrust
    assert ahead[2] > 0.1
    np.testing.assert_allclose(ahead[1], 0.0, atol=1e-6)


def test_a_dodger_that_sees_barrels_flies_away_from_a_ray():
    dodger = variant("galaga-1v1", rich=True, buffer=8).scripts()["dodger"]["crazyflie"]
    level = jnp.zeros(20).at[8].set(-1.0)  # 12 numbers of its own, 6 of the tank, 2 of the buffer
    near = level.at[12:18].set(jnp.array([-5.0, 0.5, 0.0, 1.0, 0.0, 0.0]))  # the ray passes 0.5 m to the left
    action = dodger(near, None)
    assert action[1] > 0.1  # to the right
    far = level.at[12:18].set(jnp.array([-5.0, 5.0, 0.0, 1.0, 0.0, 0.0]))
    np.testing.assert_allclose(dodger(far, None), scripts.flyer(level, None), atol=1e-5)


# Stages ---------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def aim():
    return arenas.load("galaga-aim-1v1", engine="c")


@pytest.fixture(scope="module")
def fly():
    return arenas.load("galaga-fly-1v1", engine="c")


def test_a_tank_alone_succeeds_when_its_barrel_is_on_the_target(aim):
    target, before = jnp.array([6.0, 0.0, PIVOT]), put(aim, barrels=((0.0, 0.5),))
    for off, end in ((0.03, "tanks"), (0.2, "")):
        verdict = compiled(aim)(before, put(aim, barrels=((0.0, off),)), target)[1]
        assert ending(verdict) == end
        assert float(verdict.rewards["progress"][0]) == pytest.approx(0.5 * (0.5 - off), rel=1e-4)
        assert float(verdict.rewards["hit"][0]) == (1.0 if end else 0.0)
    late = compiled(aim)(before, put(aim, barrels=((0.0, 0.2),), time=20.0), target)[1]
    assert ending(late) == "cut"
    assert not late.score.any()


def test_targets_are_never_near(aim):
    target = jax.jit(jax.vmap(aim.place))(jax.random.split(jax.random.key(0), 500))[2]
    assert float(jnp.abs(target[:, :2]).min()) >= 3.0
    assert float(jnp.abs(target[:, :2]).max()) <= 10.0
    assert 0.5 <= float(target[:, 2].min()) < 1.0
    assert 9.5 < float(target[:, 2].max()) <= 10.0
    assert (jnp.abs(target[:, 0]) == 3.0).mean() == pytest.approx(0.3, abs=0.07)  # pushed out


def test_a_drone_alone_succeeds_at_its_goal_and_fails_on_the_way_down(fly):
    goal, before = jnp.array([3.0, 0.0, 3.0]), put(fly, [(0.0, 0.0, 3.0)])
    for place, end in (((2.9, 0.0, 3.0), "tanks"), ((1.0, 0.0, 3.0), ""), ((3.0, 0.0, 0.2), "drones")):
        verdict = compiled(fly)(before, put(fly, [place], rates=(3.0, 0.0, 4.0)), goal)[1]
        assert ending(verdict) == end  # a success scores as a win of the only team
        far = math.dist(place, (3.0, 0.0, 3.0))
        assert float(verdict.rewards["progress"][0]) == pytest.approx(3.0 - far, rel=1e-4)
        assert float(verdict.rewards["rates"][0]) == pytest.approx(-0.01 * 25.0 * DT, rel=1e-4)
        assert [float(verdict.rewards[name][0]) for name in ("reached", "crash")] == {
            "tanks": [5.0, 0.0], "": [0.0, 0.0], "drones": [0.0, -5.0]
        }[end]  # fmt: skip
    late = compiled(fly)(before, put(fly, [(1.0, 0.0, 3.0)], time=20.0), goal)[1]
    assert ending(late) == "cut"


def test_scripts_succeed_alone(aim, fly):
    assert (play(aim, "gunner", seconds=1.5)[0] == 1).mean() >= 0.9
    assert (play(fly, "flyer")[0] == 1).mean() >= 0.9
