"""Scripted predators and prey do what their names say."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arenas.games.pursuit import PursuitSettings
from arenas.games.pursuit.match import GameState
from scripts import script_tournament
from tests.arenas.placing import put


@pytest.fixture(scope="module")
def arena():
    return PursuitSettings().build(engine="c", threads=1)


@pytest.fixture(scope="module")
def act(arena):
    """The action of a script that sees those places."""

    def act(script, agent, places, **given):
        seen = arena.observe(put(arena, places, **given), GameState(jnp.array([True])), {})[agent]
        return np.asarray(arena.scripts()[script][arena.robots[agent].kind](seen, jax.random.key(0)))

    return act


@pytest.mark.slow
def test_each_script_beats_those_that_do_nothing_to_the_purpose(arena):
    ladder = script_tournament.play(arena, PursuitSettings(), 48).ladder
    assert not ladder.payoff.voids.any()
    for predators in ("chaser", "interceptor"):
        for prey in ("idle", "random"):
            assert ladder.score(f"{predators}:predators", f"{prey}:prey").score >= 0.9
    for predators in ("idle", "random"):
        assert ladder.score("runner:prey", f"{predators}:predators").score >= 0.9
    straight, leading = (ladder.score(f"{s}:predators", "runner:prey").score for s in ("chaser", "interceptor"))
    assert 0.1 < straight < leading - 0.2 < 0.8


def test_a_chaser_goes_straight_and_an_interceptor_where_the_prey_will_be(act):
    places = {"predators/0": (0.0, 0.0), "prey/0": (0.5, 0.0)}
    moving = {"prey/0": (0.0, 1.0)}
    np.testing.assert_allclose(act("chaser", "predators/0", places, moving=moving), [1.0, 0.0], atol=1e-6)
    ahead = act("interceptor", "predators/0", places, moving=moving)
    np.testing.assert_allclose(ahead, np.array([1.0, 1.0]) / np.sqrt(2), atol=1e-6)  # it goes 0.5 m in 0.5 s


def test_an_interceptor_knows_that_prey_cannot_leave_the_field(act):
    places = {"predators/0": (0.0, 0.0), "prey/0": (0.95, 0.0)}
    np.testing.assert_allclose(
        act("interceptor", "predators/0", places, moving={"prey/0": (1.3, 0.0)}), [1.0, 0.0], atol=1e-6
    )


def test_a_runner_goes_away_along_the_wall_and_round_a_pillar(act):
    alone = {"prey/0": (0.0, 0.0), "predators/0": (-0.3, 0.0)}
    assert act("runner", "prey/0", alone)[0] > 0.9
    by_the_wall = act("runner", "prey/0", {"prey/0": (0.94, 0.3), "predators/0": (0.6, 0.3)})
    assert abs(by_the_wall[1]) > 0.6
    behind_it = act("runner", "prey/0", {"prey/0": (0.0, 0.02), "predators/0": (-0.3, 0.02), "pillar-0": (0.3, 0.0)})
    assert behind_it[0] > 0.0
    assert behind_it[1] > 0.3  # the shorter way round
