"""Products of matrices in arenas are computed in float32, not in the TF32 that GPUs use by default."""

import re

import jax

import arenas
from tests.arenas.race import RaceSettings


def test_every_product_of_matrices_of_mjx_asks_for_float32():
    arena = RaceSettings().build(engine="jax")
    state = jax.eval_shape(arena.reset, jax.random.key(0))
    program = jax.jit(arena.step).lower(state, state.actions).as_text()
    products = [line for line in program.splitlines() if "dot_general" in line]
    assert products
    assert not [line for line in products if "HIGHEST" not in line]


def test_the_precision_outside_arenas_is_the_users():
    arena = arenas.load("rock-paper-scissors")
    jax.eval_shape(arena.reset, jax.random.key(0))
    program = jax.jit(lambda x: x @ x).lower(jax.ShapeDtypeStruct((2, 2), "float32")).as_text()
    assert not re.search("HIGHEST", program)
