"""Scripted rovers do what their names say, played on the C engine."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arenas.arena import ArenaError, check_scripts

WORLDS = 64


@pytest.mark.parametrize("arena", ["duel", "brawl"])
def test_the_pusher_beats_those_who_stand_still(arena, request):
    states = request.getfixturevalue(arena).play("pusher", "idle", WORLDS)
    score, void = states.verdict.score[-1, :, 0], states.void[-1]
    assert void.mean() < 0.05
    assert (score[~void] == 1).mean() > 0.8
    assert (np.argmax(states.done, axis=0) < 50).mean() > 0.8  # before the ring shrinks: idle rovers were pushed


def test_the_centre_holder_reaches_the_centre_and_stays(duel):
    states = duel.play("centre-holder", "idle", WORLDS)
    seen = states.observations["blue/0"]  # (T, worlds, obs)
    distance = np.linalg.norm(seen[..., 3:5], axis=-1) * seen[..., 6]  # m
    distance[states.done] = 0.0  # what a script does after the end is nobody's business
    assert (distance[40:].max(axis=0) < 0.5).mean() >= 0.95
    assert (states.verdict.score[-1, :, 0] == 1).mean() >= 0.95  # the ring shrinks until the idle are outside


def test_the_idle_and_the_random_act_so(duel):
    keys = jax.random.split(jax.random.key(0), 1000)
    actions = {n: jax.vmap(s)(jnp.ones((1000, 20)), keys) for n, s in duel.arena.scripts().items()}
    assert not actions["idle"].any()
    assert actions["random"].min() < -0.98
    assert actions["random"].max() > 0.98
    assert abs(actions["random"].mean()) < 0.05


# What is near and beside lies inside the turning circle: a rover meets it only after drawing away from it.
@pytest.mark.parametrize(
    ("centre", "last_throttle", "throttle", "steering"),
    [
        ((1.0, 0.0), 0.0, 0.6, 0.0),  # ahead: straight on
        ((-1.0, 0.0), 0.0, -0.6, 0.0),  # behind: straight back
        ((0.5, 0.5), 0.0, 0.6, 1.0),  # ahead on the left: left
        ((-0.5, -0.5), 0.0, -0.6, -1.0),  # behind on the right: back, wheels to the right
        ((0.0, 0.4), 0.0, -0.4, -1.0),  # beside on the left: back, wheels to the right, so that the nose swings left
        ((0.6, 0.5), -0.6, -0.6, -1.0),  # the same manoeuvre goes on until there is room to spare
    ],
)
def test_the_centre_holder_turns_as_a_driver_would(duel, centre, last_throttle, throttle, steering):
    radius = 1.5
    seen = jnp.zeros(20).at[3:5].set(jnp.array(centre) / radius).at[6].set(radius).at[9].set(last_throttle)
    action = duel.arena.scripts()["centre-holder"](seen, jax.random.key(0))
    np.testing.assert_allclose(action, [throttle, steering], atol=1e-6)


def test_an_unknown_script_is_told_what_exists(duel):
    with pytest.raises(ArenaError, match="has no script 'puscher'; it has centre-holder, idle, pusher, random"):
        check_scripts(duel.arena, "puscher")
