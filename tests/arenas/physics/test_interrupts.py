"""Ctrl-C during an engine's steps stops what runs by KeyboardInterrupt, as it does everywhere else in Python."""

import signal
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import arenas
from arenas.physics import mujoco_c
from arenas.physics.interrupts import interruptible
from arenas.physics.mujoco_c import call_on_host
from league.commands.cli import guarded
from league.system.compiled import Compiled

SHAPE = {"y": jax.ShapeDtypeStruct((3,), jnp.float32)}


@pytest.fixture(autouse=True)
def hears_ctrl_c():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@jax.jit
def interrupted(x):
    return call_on_host(lambda found, x: signal.raise_signal(signal.SIGINT), SHAPE, x)


@jax.jit
def faulty(x):
    return call_on_host(lambda found, x: 1 // 0, SHAPE, x)


def test_an_interrupt_in_a_callback_stays_one():
    with pytest.raises(KeyboardInterrupt):
        interruptible(interrupted)(jnp.zeros(3))
    with pytest.raises(jax.errors.JaxRuntimeError, match="ZeroDivisionError"):
        interruptible(faulty)(jnp.zeros(3))


def test_so_it_does_in_a_compiled_program_of_a_league():
    engine = SimpleNamespace(name="c", prepare=lambda: lambda: None)
    compiled = Compiled(interrupted, SimpleNamespace(engine=engine))  # pyright: ignore[reportArgumentType]
    with pytest.raises(KeyboardInterrupt):
        compiled.ready(jnp.zeros(3))(jnp.zeros(3))


def test_a_command_ends_by_it_with_130(capsys):
    assert guarded(lambda: int(interrupted(jnp.zeros(3))["y"][0])) == 130
    assert guarded(lambda: int(faulty(jnp.zeros(3))["y"][0])) == 1
    assert "ZeroDivisionError" in capsys.readouterr().err


def test_an_environment_raises_it_and_can_be_reset(monkeypatch):
    env = arenas.vector("sumo-1v1-leatherback", team="blue", opponent="idle", num_envs=2, engine="c")
    env.reset(seed=0)
    idle = np.zeros(env.action_space.shape, np.float32)
    with monkeypatch.context() as during:
        during.setattr(mujoco_c, "_copy_as_float32", lambda *_: signal.raise_signal(signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            env.step(idle)
    env.reset(seed=0)
    assert np.isfinite(env.step(idle)[0]).all()
