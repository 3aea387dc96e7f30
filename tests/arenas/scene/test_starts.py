"""Starts are drawn where worlds begin, and are the same whether alone, in a batch, or in a batch of batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from arenas.scene.starts import draw_where


def start(key):
    """A place, a number, and a random key, as a game may keep one."""
    return jax.random.normal(key, (2,)), {"n": jax.random.randint(key, (), 1, 9)}, jax.random.fold_in(key, 1)


def plain(tree):
    place, number, key = tree
    return np.asarray(place), np.asarray(number["n"]), np.asarray(jax.random.key_data(key))


@pytest.mark.optimised
@pytest.mark.parametrize("worlds", [1, 7, 16, 96])
def test_a_start_is_that_of_its_key(worlds):
    keys = jax.random.split(jax.random.key(0), worlds)
    where = jnp.arange(worlds) % 5 == 0
    found = jax.jit(jax.vmap(lambda key, here: draw_where(start, key, here)))(keys, where)
    for ours, alone in zip(plain(found), plain(jax.vmap(start)(keys)), strict=True):
        np.testing.assert_array_equal(ours[where], alone[where])


def test_blocks_in_which_nobody_begins_are_not_drawn():
    keys = jax.random.split(jax.random.key(0), 64)
    where = jnp.zeros(64, bool).at[20].set(True)
    place, number, _ = plain(jax.jit(jax.vmap(lambda key, here: draw_where(start, key, here)))(keys, where))
    assert number[16:32].all()
    assert not number[:16].any()
    assert not place[32:].any()


@pytest.mark.optimised
def test_alone_and_in_batches_of_batches():
    keys = jax.random.split(jax.random.key(0), (3, 4))
    where = jnp.ones((3, 4), bool).at[1, 2].set(False)
    found = plain(jax.jit(jax.vmap(jax.vmap(lambda key, here: draw_where(start, key, here))))(keys, where))
    for ours, alone in zip(found, plain(jax.vmap(jax.vmap(start))(keys)), strict=True):
        np.testing.assert_array_equal(ours[where], alone[where])
    for ours, alone in zip(plain(draw_where(start, keys[0, 0], True)), plain(start(keys[0, 0])), strict=True):
        np.testing.assert_array_equal(ours, alone)


def test_all_worlds_may_share_one_key():
    key = jax.random.key(3)
    place, *_ = plain(jax.vmap(lambda here: draw_where(start, key, here))(jnp.ones(4, bool)))
    np.testing.assert_array_equal(place, np.tile(start(key)[0], (4, 1)))
