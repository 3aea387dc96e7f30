"""Scripted rovers play soccer: what a plan asks for is done on the C engine."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from tests.arenas.conftest import Worlds
from tests.arenas.kickoff import put


@pytest.fixture(scope="module")
def drill():
    """A rover alone, for eight seconds."""
    settings = arenas.settings("soccer-score-leatherback")
    return replace(settings, rules=replace(settings.rules, episode=8.0)).build(engine="c")


def played(arena, script, poses, ball, side, seconds=8.0):
    """States (T,) of one episode from these places on."""
    act, decisions = arena.scripts()[script]["leatherback"], round(seconds / 0.02)

    def decision(state, key):
        state = arena.step(state, {"blue/0": act(state.observations["blue/0"], key)})
        kept = state._replace(physics=state.physics._replace(carry=()))
        return state, jax.lax.optimization_barrier(kept)

    @jax.jit
    def run(key):
        start = arena.reset(key)
        there = put(arena, poses, ball, time=0.0)
        physics = arena.engine.place(start.physics, there.qpos, there.qvel, jnp.ones((), bool))
        game = start.game._replace(side=jnp.asarray(side))
        actions = {"blue/0": jnp.zeros(2)}
        seen = arena.observe(physics, game, actions)
        start = start._replace(physics=physics, game=game, observations=seen)
        return jax.lax.scan(decision, start, jax.random.split(key, decisions))[1]

    return jax.device_get(run(jax.random.key(0)))


@pytest.mark.parametrize(
    ("pose", "ball", "side"),
    [
        ((4.0, 0.0, 0.0), (5.5, 0.0), 1.0),  # behind the ball, and facing it
        ((-4.0, 0.0, 3.1), (-6.0, 0.5), -1.0),
        ((6.5, 1.0, 3.1), (5.0, 1.0), 1.0),  # on the wrong side of it: it must go round
    ],
)
def test_a_striker_scores_in_the_goal_that_is_asked_for(drill, pose, ball, side):
    states = played(drill, "striker", [pose], ball, side)
    assert states.verdict.terminated[-1]
    np.testing.assert_array_equal(states.verdict.score[-1], [1.0])
    assert not states.verdict.events["fall"].any()


def test_a_chaser_pushes_the_ball_wherever_it_is_going(drill):
    """From the wrong side: into the goal that was not asked for."""
    states = played(drill, "chaser", [(-5.0, 0.0, 3.14)], (-6.5, 0.0), 1.0)
    assert states.verdict.events["wrong_goal"].any()
    np.testing.assert_array_equal(states.verdict.score[-1], [0.0])


def test_a_keeper_goes_to_the_line_between_ball_and_goal_and_stays(drill):
    """Its goal is at -9.25; the ball lies at (0, 3), so 0.8 m before the goal's middle it is 0.25 m off the axis."""
    states = played(drill, "keeper", [(-6.0, -2.0, 0.0)], (0.0, 3.0), 1.0)
    at = drill.scene.agents["blue/0"].qpos
    places = states.physics.qpos[:, at : at + 2]
    assert np.linalg.norm(places[-100:] - np.array([-8.49, 0.25]), axis=1).max() < 0.5
    assert np.linalg.norm(np.diff(places[-100:], axis=0), axis=1).max() < 0.02
    assert not states.verdict.events["touch"].any()


BY_WALLS = [  # (rover), (ball), for who plays at +x
    ((-6.1, -0.9, -2.0), (-9.2, -4.1)),  # in its own corner
    ((-6.8, 1.6, 2.6), (-9.3, 3.5)),
    ((0.0, 0.0, 0.0), (-9.0, 4.0)),
    ((-1.6, -0.7, -2.8), (-1.4, -4.5)),  # at a side wall
    ((-2.0, 2.9, -1.7), (-0.3, 4.3)),
    ((6.0, 3.0, 0.0), (4.0, 4.6)),
    ((7.3, 1.5, 0.8), (9.4, -3.9)),  # beside the goal that it plays at
    ((-3.6, 2.1, -2.0), (8.9, -4.0)),
]


def test_a_striker_gets_a_ball_off_the_walls():
    """Within 30 s; one of these eight became a goal before rovers rammed balls along walls."""
    settings = arenas.settings("soccer-score-leatherback")
    arena = replace(settings, rules=replace(settings.rules, episode=30.0)).build(engine="c")
    worlds = Worlds(arena)
    act, there = (
        arena.scripts()["striker"]["leatherback"],
        [put(arena, [pose], ball, time=0.0) for pose, ball in BY_WALLS],
    )
    n = len(there)

    def decision(state, key):
        actions = {"blue/0": jax.vmap(act)(state.observations["blue/0"], jax.random.split(key, n))}
        state = worlds.step(state, actions)
        return state, jax.lax.optimization_barrier(state.verdict)

    @jax.jit
    def run(key):
        start = worlds.reset(jax.random.split(key, n))
        qpos, qvel = (jnp.stack([getattr(each, name) for each in there]) for name in ("qpos", "qvel"))
        physics = worlds.place(start.physics, qpos, qvel, jnp.ones(n, bool))
        game = start.game._replace(side=jnp.ones_like(start.game.side))
        seen = jax.vmap(arena.observe)(physics, game, {"blue/0": jnp.zeros((n, 2))})
        start = start._replace(physics=physics, game=game, observations=seen)
        return jax.lax.scan(decision, start, jax.random.split(key, arena.timing.decisions))[1]

    verdict = jax.device_get(run(jax.random.key(0)))
    over = verdict.terminated | verdict.truncated
    scored = verdict.score[over.argmax(0), np.arange(n), 0] == 1.0
    assert scored.sum() >= n - 2, scored


@pytest.mark.slow
def test_strikers_beat_those_who_stand_still_and_keepers_hold_some():
    arena = replace(arenas.settings("soccer-1v1"), blue=("leatherback",), red=("leatherback",)).build(engine="c")
    worlds = Worlds(arena)
    still, kept = (worlds.play("striker", red, 64).verdict.score[-1, :, 0] for red in ("idle", "keeper"))
    assert (still == 1.0).mean() > 0.9
    assert (kept == 1.0).mean() < (still == 1.0).mean()
    assert (still == 0.0).mean() < 0.05
