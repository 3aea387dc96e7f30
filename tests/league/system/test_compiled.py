"""A program is compiled, and its engine made ready, before anything runs."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

from league.system.compiled import Compiled


def test_an_engine_is_made_ready_only_while_xla_compiles():
    """Warp lost its stream on a GPU where threads loaded its kernels while a program ran."""
    told = []

    def prepare():
        told.append("begun")
        return lambda: told.append("ready")

    def ran(x):
        told.append("ran")
        return np.asarray(x)

    def program(x):
        told.append("traced")
        return jax.pure_callback(ran, jax.ShapeDtypeStruct(x.shape, x.dtype), x) + 1

    engine = SimpleNamespace(name="warp", prepare=prepare)
    compiled = Compiled(jax.jit(program), SimpleNamespace(engine=engine))  # pyright: ignore[reportArgumentType]
    assert not told
    run = compiled.ready(jnp.zeros(3))
    assert told == ["traced", "begun", "ready", "ran"]  # the last one has Warp put its kernels into graphs
    assert (run(jnp.zeros(3)) == 1).all()
    assert compiled.ready(jnp.ones(3)) is run
