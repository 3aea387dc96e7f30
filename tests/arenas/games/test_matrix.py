"""Games without bodies: their tables, and that they know nothing of physics."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from arenas.games.matrix.settings import MatrixRules


def player(arena):
    """play(blue, red, rounds=1): the state after as many rounds of two choices."""
    reset, step = jax.jit(arena.reset), jax.jit(arena.step)

    def play(blue, red, rounds=1):
        chosen = zip(arena.agents, (blue, red), strict=True)
        actions = {a.name: 3.0 * jax.nn.one_hot(choice, a.action_size) for a, choice in chosen}
        state = reset(jax.random.key(0))
        for _ in range(rounds):
            state = step(state, actions)
        return state

    return play


@pytest.mark.parametrize(
    ("name", "table"),
    [("rock-paper-scissors", [[0, -1, 1], [1, 0, -1], [-1, 1, 0]]), ("matching-pennies", [[1, -1], [-1, 1]])],
)
def test_the_table_decides(name, table):
    arena = arenas.load(name, engine="c")
    assert arena.engine.name == "none"
    play = player(arena)
    for (blue, red), payoff in np.ndenumerate(np.array(table)):
        state = play(blue, red)
        assert state.verdict.terminated
        assert state.verdict.reward.tolist() == [payoff, -payoff]
        assert state.verdict.score.tolist() == [0.5 + payoff / 2, 0.5 - payoff / 2]


def test_the_same_roster_where_sides_are_alike_and_two_where_not():
    rosters = {
        name: [t.roster for t in arenas.load(name).teams] for name in ("rock-paper-scissors", "matching-pennies")
    }
    assert rosters == {
        "rock-paper-scissors": ["chooser:1:3", "chooser:1:3"],
        "matching-pennies": ["matcher:1:2", "mismatcher:1:2"],
    }


def test_several_rounds_are_decided_by_their_sum():
    settings = arenas.settings("matching-pennies")
    arena = replace(settings, rules=replace(settings.rules, rounds=4)).build()
    play = player(arena)
    early, late = play(0, 1, 3), play(0, 1, 4)
    assert not early.done
    assert late.verdict.terminated
    assert late.verdict.reward.tolist() == [-0.25, 0.25]
    assert late.verdict.score.tolist() == [0.0, 1.0]


def test_scripts_choose_what_they_are_called_and_random_chooses_evenly():
    arena = arenas.load("rock-paper-scissors")
    keys = jax.random.split(jax.random.key(1), 3000)
    said = {n: jax.vmap(s["chooser"])(jnp.ones((3000, 1)), keys).argmax(axis=1) for n, s in arena.scripts().items()}
    assert [set(said[name].tolist()) for name in ("rock", "paper", "scissors")] == [{0}, {1}, {2}]
    assert np.bincount(said["random"]).min() > 900


def test_an_unknown_table_is_told_what_exists():
    with pytest.raises(ValueError, match=r"^table: 'chess' is none of rock-paper-scissors, matching-pennies$"):
        MatrixRules("chess")
