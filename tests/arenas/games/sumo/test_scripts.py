"""Scripted rovers do what their names say, played on the C engine."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from arenas.errors import ArenaError
from arenas.game import check_scripts
from arenas.games.sumo import scripts

WORLDS = 64


@pytest.mark.parametrize("arena", ["duel", pytest.param("brawl", marks=pytest.mark.slow)])
def test_the_pusher_beats_those_who_stand_still(arena, request):
    states = request.getfixturevalue(arena).play("pusher", "idle", WORLDS)
    score, void = states.verdict.score[-1, :, 0], states.void[-1]
    assert void.mean() < 0.05
    assert (score[~void] == 1).mean() > 0.8
    assert (np.argmax(states.done, axis=0) < 50).mean() > 0.8  # before the ring shrinks: idle rovers were pushed


def test_the_centre_holder_reaches_the_centre_and_stays(duel):
    states = duel.play("centre-holder", "idle", WORLDS)
    seen = states.observations["blue/0"]  # (T, worlds, obs)
    distance = np.linalg.norm(seen[..., 5:7], axis=-1) * seen[..., 8]  # m
    distance[states.done] = 0.0  # what a script does after the end is nobody's business
    assert (distance[40:].max(axis=0) < 0.5).mean() >= 0.95
    assert (states.verdict.score[-1, :, 0] == 1).mean() >= 0.95  # the ring shrinks until the idle are outside


def test_the_idle_and_the_random_act_so(duel):
    keys = jax.random.split(jax.random.key(0), 1000)
    actions = {
        n: jax.jit(jax.vmap(s["leatherback"]))(jnp.ones((1000, 20)), keys) for n, s in duel.arena.scripts().items()
    }
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
    seen = jnp.zeros(20).at[5:7].set(jnp.array(centre) / radius).at[8].set(radius).at[0].set(last_throttle)
    action = duel.arena.scripts()["centre-holder"]["leatherback"](seen, jax.random.key(0))
    np.testing.assert_allclose(action, [throttle, steering], atol=1e-6)


def test_an_unknown_script_is_told_what_exists(duel):
    with pytest.raises(ArenaError, match="has no script 'puscher'; it has centre-holder, idle, pusher, random"):
        check_scripts(duel.arena, "puscher")


# By HARL-A's rules, in slots ------------------------------------------------------------------------------------------


@pytest.fixture
def eight_seconds(worlds):
    def build(name):
        settings = arenas.settings(name)
        rules = replace(settings.rules, episode=8.0, shrink_after=8.0)
        return worlds(replace(settings, rules=rules).build(engine="c"))

    return build


@pytest.mark.slow
def test_a_rover_in_slots_pushes_as_one_that_sees_all(eight_seconds):
    states = eight_seconds("sumo-1v1-leatherback").play("pusher", "idle", 32)
    assert (states.verdict.score[-1, :, 0] == 1).mean() > 0.6
    assert (states.verdict.score[-1, :, 1] == 1).mean() < 0.1


@pytest.mark.slow
def test_an_anymal_trots_at_its_enemy(eight_seconds):
    states = eight_seconds("sumo-1v1-anymal").play("pusher", "idle", 24)
    gap = np.linalg.norm(states.observations["blue/0"][..., 45:48], axis=-1)  # (T, worlds) m
    x, y = states.observations["blue/0"][0, :, 45:47].T
    ahead = (np.abs(np.arctan2(y, x)) < 0.9) & (gap[0] > 2.5)  # what is further aside takes it longer
    assert ahead.sum() >= 3
    assert (gap[0] - gap.min(axis=0))[ahead].mean() > 0.8
    assert not states.verdict.events["fall"][:, ahead].any()


def test_the_pusher_looks_for_the_nearest_in_either_slot():
    push = scripts.pusher("leatherback", scripts.slots_view("leatherback"), scripts.Pace(0.02, 6.0, 6.0))
    far_ahead = jnp.array([3.0, 0.0, 0.0])
    seen = jnp.zeros(14).at[:3].set(far_ahead)
    np.testing.assert_allclose(push(seen, jax.random.key(0)), [5.4, 0.0], atol=1e-5)  # nobody in slot C
    near_behind = seen.at[6:9].set(jnp.array([-1.0, 0.0, 0.0]))
    np.testing.assert_allclose(push(near_behind, jax.random.key(0)), [-5.4, 0.0], atol=1e-5)


def test_an_anymal_stands_where_its_arc_would_lead_over_the_edge():
    push = scripts.pusher("anymal", scripts.slots_view("anymal"), scripts.Pace(0.02))
    seen = jnp.zeros(56).at[8].set(-1.0).at[45:48].set(jnp.array([-2.0, 1.0, 0.0])).at[55].set(4.0)
    assert push(seen.at[54].set(1.0), jax.random.key(0)).any()
    assert not push(seen.at[54].set(3.5), jax.random.key(0)).any()


@pytest.mark.parametrize(("left", "rotor"), [(1.0, 1.0), (-0.5, -1.0)])
def test_a_tank_swings_its_barrel_to_the_enemys_side(left, rotor):
    push = scripts.pusher("minitank", scripts.slots_view("minitank"), scripts.Pace(0.02))
    seen = jnp.zeros(14).at[:3].set(jnp.array([0.3, left, 0.0]))
    np.testing.assert_array_equal(push(seen, jax.random.key(0)), [0.0, rotor])
