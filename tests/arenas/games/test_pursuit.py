"""Pursuit: who is caught, who wins, what is seen and paid, any sizes of teams. By hand on the C engine."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arenas.contract.check import check_arena
from arenas.contract.check_run import WORLDS
from arenas.games.pursuit import PursuitReward, PursuitRules, PursuitSettings
from arenas.games.pursuit.match import GameState, Pursuit
from league.config import experiment
from league.config.schema import ConfigError
from tests.arenas.hooks import judging, observing
from tests.arenas.placing import put

REACH = 0.075 + 0.05  # m
FREE, HALF = GameState(jnp.array([True])), GameState(jnp.array([True, False]))
FEW = PursuitSettings("few", predators=2, prey=2, rules=PursuitRules(side=2.5, episode=1.0, obstacles=1))


@pytest.fixture(scope="module")
def chase() -> Pursuit:
    return PursuitSettings().build(engine="c", threads=1)


@pytest.fixture(scope="module")
def few() -> Pursuit:
    return FEW.build(engine="c", threads=1)


def judged(arena: Pursuit, sample_places, game, time=1.0, before=None):
    now = put(arena, sample_places, time)
    return judging(arena)(put(arena, before, time) if before else now, now, game)


# Who wins -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("gap", "caught"), [(REACH - 0.001, True), (REACH + 0.001, False)])
def test_to_touch_is_to_catch(chase, gap, caught):
    game, verdict = judged(chase, {"predators/1": (0.0, 0.0), "prey/0": (0.0, gap)}, FREE)
    assert bool(game.free[0]) is not caught
    assert bool(verdict.terminated) is caught
    assert verdict.events["capture"].tolist() == [caught, False]
    np.testing.assert_allclose(verdict.rewards["capture"], [caught, -caught])
    if caught:
        np.testing.assert_array_equal(verdict.score, [1.0, 0.0])


def test_time_up_is_won_by_the_prey_and_is_no_cut(chase):
    _, verdict = judged(chase, {}, FREE, time=10.0)
    assert (bool(verdict.terminated), bool(verdict.truncated)) == (True, False)
    np.testing.assert_array_equal(verdict.score, [0.0, 1.0])
    np.testing.assert_array_equal(verdict.rewards["escape"], [-1.0, 1.0])
    assert verdict.events["escape"].tolist() == [False, True]


def test_caught_at_the_last_moment_is_caught(chase):
    _, verdict = judged(chase, {"predators/0": (0.0, 0.0), "prey/0": (0.1, 0.0)}, FREE, time=10.0)
    np.testing.assert_array_equal(verdict.score, [1.0, 0.0])
    assert not verdict.rewards["escape"].any()


def test_all_prey_must_be_caught_and_each_counts_once(few):
    touching = {"predators/0": (0.0, 0.0), "prey/0": (0.1, 0.0), "prey/1": (3.0, 0.0)}
    game, verdict = judged(few, touching, GameState(jnp.array([True, True])), time=0.5)
    assert game.free.tolist() == [False, True]
    assert not verdict.terminated
    np.testing.assert_allclose(verdict.rewards["capture"], [0.5, -0.5])
    again, verdict = judged(few, touching, game, time=0.5)
    assert again.free.tolist() == [False, True]
    assert not verdict.rewards["capture"].any()
    assert not verdict.events["capture"].any()
    _, verdict = judged(few, {"predators/0": (3.0, 0.0), "prey/1": (3.1, 0.0)}, game, time=0.5)
    assert verdict.terminated
    np.testing.assert_array_equal(verdict.score, [1.0, 0.0])


def test_the_hint_is_what_the_nearest_predator_gained_on_free_prey(few):
    before = {"predators/0": (0.0, 0.0), "predators/1": (0.0, 5.0), "prey/0": (1.0, 0.0), "prey/1": (0.5, 0.0)}
    now = before | {"predators/0": (0.1, 0.0), "prey/1": (5.0, 0.0)}
    _, verdict = judged(few, now, HALF, before=before, time=0.5)
    np.testing.assert_allclose(verdict.shapings["approach"], [0.02, -0.02], atol=1e-6)  # prey/1 is caught


def test_weights_are_settings():
    arena = replace(FEW, reward=PursuitReward(capture=3.0, escape=2.0, approach=0.0)).build(engine="c", threads=1)
    _, verdict = judged(arena, {"predators/0": (0.0, 0.0), "prey/0": (0.1, 0.0)}, HALF, time=0.5)
    np.testing.assert_allclose(verdict.rewards["capture"], [1.5, -1.5])
    _, verdict = judged(arena, {}, HALF, time=1.0)
    np.testing.assert_allclose(verdict.rewards["escape"], [-2.0, 2.0])


# What is seen, and who is in the game ---------------------------------------------------------------------------------


def test_a_predator_sees_maddpgs_layout_and_the_clock(chase):
    sample_places = {
        "predators/0": (0.1, 0.2),
        "predators/1": (0.5, 0.2),
        "predators/2": (0.1, -0.3),
        "prey/0": (-0.4, 0.2),
    }
    sample_places |= {"pillar-0": (0.6, 0.6), "pillar-1": (0.0, 0.0)}
    moving = {"predators/0": (0.3, 0.0), "predators/1": (9.0, 9.0), "prey/0": (0.0, 1.0)}
    physics = put(chase, sample_places, time=2.5, moving=moving)
    seen = observing(chase)(physics, FREE, {})
    predator = [0.3, 0, 0.1, 0.2, 0.5, 0.4, -0.1, -0.2, 0.4, 0, 0, -0.5, -0.5, 0, 0, 1.0, 0.25]
    np.testing.assert_allclose(seen["predators/0"], predator, atol=1e-6)
    prey = [0, 1.0, -0.4, 0.2, 1.0, 0.4, 0.4, -0.2, 0.5, 0, 0.9, 0, 0.5, -0.5, 0.25]  # not how predators move
    np.testing.assert_allclose(seen["prey/0"], prey, atol=1e-6)


def test_who_is_caught_is_seen_by_nobody_and_is_out_of_the_game(few):
    physics = put(few, {"predators/0": (0.0, 0.0), "prey/0": (0.4, 0.0), "prey/1": (0.0, 0.7)})
    assert few.alive(physics, HALF).tolist() == [True, True, True, False]
    seen = few.observation_builder.read(observing(few)(physics, HALF, {})["predators/0"], False)
    np.testing.assert_allclose(seen.prey, [[0.4, 0.0], [0.0, 0.0]], atol=1e-6)
    assert few.observation_builder.read(observing(few)(physics, HALF, {})["prey/0"], True).prey.tolist() == [[0.0, 0.0]]


def test_an_observation_is_read_as_it_was_written(few):
    physics = put(few, {}, moving={"prey/1": (0.5, -0.5)})
    seen = few.observation_builder.read(observing(few)(physics, GameState(jnp.array([True, True])), {})["prey/0"], True)
    xy = np.asarray(physics.qpos[few._xy])
    np.testing.assert_allclose(seen.position, xy[2])
    np.testing.assert_allclose(seen.predators, xy[:2] - xy[2])
    np.testing.assert_allclose(seen.prey_velocity, [[0.5, -0.5]])
    assert seen.pillars.shape == (1, 2)
    assert seen.time == 1.0


# Bodies ---------------------------------------------------------------------------------------------------------------


def travelled(arena, sample_places, actions, seconds):
    """Where things are after that time under constant actions, (nq,), and qvel."""
    engine, physics = arena.engine, put(arena, sample_places)
    state = engine.make(physics.qpos, physics.qvel, {})
    told = {a.name: jnp.asarray(actions.get(a.name, (0.0, 0.0))) for a in arena.agents}
    after = jax.jit(lambda s: engine.step(s, arena.command(told), round(seconds / arena.timing.timestep), arena.law))
    return after(state)


def at(arena, physics, name):
    where = arena.scene.agents.get(name) or arena.scene.props[name]
    return np.asarray(physics.qpos[where.qpos : where.qpos + 3])


@pytest.mark.parametrize(("name", "speed"), [("predators/0", 1.0), ("prey/0", 1.3)])
@pytest.mark.parametrize("thrust", [(1.0, 0.0), (-5.0, 5.0)])
def test_prey_is_quicker_and_no_way_is_quicker_than_another(chase, name, speed, thrust):
    after = travelled(chase, {name: (20.0, -20.0)}, {name: thrust}, 3.0)
    where = chase.scene.agents[name].qvel
    np.testing.assert_allclose(np.linalg.norm(after.qvel[where : where + 2]), speed, rtol=0.01)


def test_walls_and_pillars_stop_everybody(chase):
    sample_places = {
        "predators/0": (0.8, 0.0),
        "prey/0": (0.8, -0.5),
        "predators/1": (-0.9, 0.0),
        "pillar-0": (-0.5, 0.0),
    }
    after = travelled(chase, sample_places, dict.fromkeys(("predators/0", "predators/1", "prey/0"), (1.0, 0.0)), 2.0)
    np.testing.assert_allclose(at(chase, after, "predators/0")[:2], [1.0 - 0.075, 0.0], atol=0.01)
    np.testing.assert_allclose(at(chase, after, "prey/0")[:2], [1.0 - 0.05, -0.5], atol=0.01)
    np.testing.assert_allclose(at(chase, after, "predators/1")[:2], [-0.5 - 0.2 - 0.075, 0.0], atol=0.02)
    np.testing.assert_allclose(at(chase, after, "pillar-0")[:2], [-0.5, 0.0], atol=1e-3)


def test_predators_meet_each_other_and_prey_passes_through_them(chase):
    sample_places = {
        "predators/0": (-0.4, 0.0),
        "predators/1": (0.0, 0.0),
        "prey/0": (-0.4, 0.5),
        "predators/2": (0.0, 0.5),
    }
    after = travelled(chase, sample_places, {"predators/0": (1.0, 0.0), "prey/0": (1.0, 0.0)}, 1.0)
    assert at(chase, after, "predators/1")[0] > 0.1
    assert at(chase, after, "prey/0")[0] > 0.2
    np.testing.assert_allclose(at(chase, after, "predators/2")[:2], [0.0, 0.5], atol=1e-3)


def test_prey_meets_other_prey_that_is_limp_as_if_caught(few):
    after = travelled(few, {"prey/0": (-0.4, 0.0), "prey/1": (0.0, 0.0)}, {"prey/0": (1.0, 0.0)}, 1.0)
    assert at(few, after, "prey/1")[0] > 0.1


# Starts ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("settings", [PursuitSettings(), PursuitSettings("wide", 4, 3, PursuitRules(side=3.2))])
def test_all_start_clear_of_each_other_and_can_pass_between_pillars(settings):
    arena = settings.build(engine="c", threads=1)
    rules, worlds = settings.rules, 300
    qpos, _, _ = jax.jit(jax.vmap(arena.place))(jax.random.split(jax.random.key(0), worlds))
    robots, pillars = np.asarray(qpos[:, arena._xy]), np.asarray(qpos[:, arena._pillars])
    radii = np.repeat([rules.predator_radius, rules.prey_radius], [settings.predators, settings.prey])
    every = np.concatenate([robots, pillars], axis=1)
    size = np.concatenate([radii, [rules.obstacle_radius] * rules.obstacles])
    assert (rules.side / 2 - np.abs(every).max(axis=-1) - size >= -1e-6).all()
    gaps = np.linalg.norm(every[:, :, None] - every[:, None], axis=-1) - size[:, None] - size
    gaps[:, range(len(size)), range(len(size))] = 9.0
    roomy = gaps.min(axis=(1, 2)) >= -1e-6
    n = settings.predators
    apart = gaps[:, :n, n : len(radii)].min(axis=(1, 2)) >= rules.apart - 1e-6
    between = gaps[:, len(radii) :, len(radii) :].min(axis=(1, 2)) >= 2 * rules.predator_radius - 1e-6
    assert (roomy & apart & between).mean() > 0.99  # tries are limited
    assert np.ptp(robots, axis=0).min() > 0.8 * (rules.side - 2 * rules.predator_radius - 1.0)  # and everywhere


# Any sizes, and what cannot be ----------------------------------------------------------------------------------------


LONE = replace(FEW, predators=1, prey=1, rules=PursuitRules(episode=1.0, obstacles=0))


@pytest.mark.slow
@pytest.mark.parametrize("settings", [FEW, pytest.param(LONE, marks=pytest.mark.slow)])
def test_any_sizes_keep_the_contract(settings):
    arena = settings.build(engine="c", worlds=WORLDS)
    assert [result for result in check_arena(arena, settings) if not result.ok] == []
    assert [len(team.agents) for team in arena.teams] == [settings.predators, settings.prey]


BAD = [
    ("predators = 0", "predators = 0: must be between 1 and 32"),
    (
        "rules.side = 1.0",
        "rules.side = 1.0: 1.0 m is too narrow for 3 predators, 1 prey and 2 obstacles to start in; it",
    ),
    (
        "prey = 9",
        "rules.side = 2.0: 2.0 m is too narrow for 3 predators, 9 prey and 2 obstacles to start in; it must be",
    ),
    ("rules.prey_speed = 9.0", "rules.prey_speed = 9.0: must be between 0.01 and 4.0"),
]


@pytest.mark.parametrize(("line", "message"), BAD)
def test_bad_settings_are_refused_in_one_line(line, message):
    with pytest.raises(ConfigError) as refused:
        experiment.loads(f'[arena]\nname = "pursuit"\n{line}\n')
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)
