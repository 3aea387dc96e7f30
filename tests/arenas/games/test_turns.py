"""Games of turns: the arenas have the rules of `matchmaking/extensive_games/`, history by history."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from arenas.games.matrix.turns.settings import GAMES, TurnRules
from league.matches.exact_exploitability import GAMES as TREES
from matchmaking.extensive_games.game import CHANCE, TERMINAL


def all_histories(game):
    """Return (outcomes of chance, actions, states after each action, return) of every game that can be played."""
    found, waiting = [], [(game.start(), (), (), ())]
    while waiting:
        state, chance, played, states = waiting.pop()
        player = game.player(state)
        if player == TERMINAL:
            found.append((chance, played, states, game.gain(state)))
        elif player == CHANCE:
            waiting += [(game.play(state, o), (*chance, o), played, states) for o in game.legal(state)]
        else:
            waiting += [(game.play(state, a), chance, (*played, a), (*states, state)) for a in game.legal(state)]
    return found


def random_histories(game, number):
    """Return such histories of random play, for games with too many of them."""
    rng, found = np.random.default_rng(1), []
    for _ in range(number):
        state, played, states = game.start(), (), ()
        while game.player(state) != TERMINAL:
            action = int(rng.choice(game.legal(state)))
            state, played, states = game.play(state, action), (*played, action), (*states, state)
        found.append(((), played, states, game.gain(state)))
    return found


@pytest.mark.parametrize("name", GAMES)
def test_every_history_is_the_trees(name):
    """All of both poker games, and 3,000 games of dark hex."""
    game, arena = TREES[name](), arenas.load(name)
    histories = random_histories(game, 3000) if name == "dark-hex-3" else all_histories(game)
    assert len(histories) == {"kuhn-poker": 30, "leduc-poker": 5520, "dark-hex-3": 3000}[name]
    number, width = len(histories), arena.draw(jax.random.key(0)).shape[0]
    dealt = np.array([(*chance, 0, 0, 0)[:width] for chance, *_ in histories], np.int32).reshape(number, width)
    state = jax.jit(jax.vmap(arena.reset))(jax.random.split(jax.random.key(2), number))
    state = state._replace(game=state.game._replace(hand=jax.jit(jax.vmap(arena.start))(jnp.asarray(dealt))))
    swapped = np.asarray(state.game.second_first)
    assert 0.1 < swapped.mean() < 0.9
    step, alive, legal = (jax.jit(jax.vmap(f)) for f in (arena.step, arena.alive, lambda game: arena.legal(game.hand)))
    for at in range(game.longest):
        going = np.array([at < len(played) for _, played, *_ in histories])
        assert np.array_equal(~np.asarray(state.done), going)
        states = [states[at] if at < len(states) else None for *_, states, _ in histories]
        movers = np.array([0 if s is None else game.player(s) for s in states])
        expected = (movers[:, None] ^ swapped[:, None]) == np.arange(2)
        assert np.array_equal(np.asarray(alive(state.physics, state.game))[going], expected[going])
        allowed = np.asarray(legal(state.game))
        for row, each in zip(allowed, states, strict=True):
            assert each is None or np.flatnonzero(row).tolist() == list(game.legal(each))
        taken = np.array([(*played, *[0] * game.longest)[at] for _, played, *_ in histories])
        action = jax.nn.one_hot(taken, game.actions)
        state = step(state, {agent.name: action for agent in arena.agents})
        ends = np.array([at == len(played) - 1 for _, played, *_ in histories])
        gains = np.array([gain for *_, gain in histories]) * np.where(swapped, -1, 1)
        reward = np.asarray(state.verdict.reward)[ends]
        assert np.array_equal(reward, np.stack([gains, -gains], 1)[ends])
        assert np.array_equal(np.asarray(state.verdict.score)[ends], 0.5 + 0.5 * np.sign(reward))
    assert state.verdict.terminated.all()


@pytest.mark.parametrize("name", GAMES)
def test_illegal_choices_are_never_taken(name):
    arena = arenas.load(name)
    state = jax.jit(arena.reset)(jax.random.key(0))
    legal = np.asarray(arena.legal(state.game.hand))
    numbers = jnp.where(legal, jnp.arange(len(legal)) - 100.0, 100.0)
    chosen = arena.decide(state.game, {agent.name: numbers for agent in arena.agents}).choice
    assert chosen == np.flatnonzero(legal)[-1]


def test_a_lottery_has_the_mean_of_the_chips():
    settings = arenas.settings("kuhn-poker")
    arena = replace(settings, rules=TurnRules("kuhn-poker", score="chips")).build()
    state = jax.jit(jax.vmap(arena.reset))(jax.random.split(jax.random.key(5), 4000))
    hand = arena.start(jnp.array([2, 0]))  # the highest card against the lowest, and both bet
    hand = jax.tree.map(lambda x: jnp.broadcast_to(x, (4000, *x.shape)), arena.play(hand, jnp.int32(1)))
    judge, wins = jax.jit(jax.vmap(arena.judge)), {}
    for choice, gain in ((1, 2), (0, 1)):
        _, verdict = judge(
            state.physics, state.physics,
            state.game._replace(hand=hand, choice=jnp.full(4000, choice), second_first=jnp.zeros(4000, bool)),
        )  # fmt: skip
        assert (verdict.score.sum(axis=1) == 1).all()
        wins[gain] = float(verdict.score[:, 0].mean())
    assert wins[2] == 1.0
    assert wins[1] == pytest.approx(0.75, abs=4 * np.sqrt(0.25 * 0.75 / 4000))


def test_scripts_take_their_choice_or_the_first_legal_one():
    arena = arenas.load("leduc-poker")
    game = jax.jit(arena.reset)(jax.random.key(0)).game
    scripts = arena.scripts()
    said = {
        name: scripts[name]["leduc"](jnp.zeros(31), jax.random.key(1)) for name in ("fold", "call", "raise", "random")
    }
    chosen = {n: int(arena.decide(game, {a.name: numbers for a in arena.agents}).choice) for n, numbers in said.items()}
    assert [chosen[name] for name in ("fold", "call", "raise")] == [1, 1, 2]  # without a bet nobody folds
    assert chosen["random"] in (1, 2)


def test_an_unknown_game_is_told_what_exists():
    with pytest.raises(ValueError, match=r"^game: 'chess' is none of kuhn-poker, leduc-poker, dark-hex-3$"):
        TurnRules("chess")
