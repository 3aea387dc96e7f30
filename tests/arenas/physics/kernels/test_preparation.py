"""The kernels that are loaded before an engine's first step are those which the step, through MJX, then loads.

Warp runs here on a CPU, where it compiles the same modules, with LLVM.
"""

import logging
import threading

import jax
import jax.numpy as jnp
import mujoco
import pytest
import warp

from arenas.physics.kernels import preparation, progress
from arenas.physics.registry import make_engine

XML = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast" cone="pyramidal" iterations="10" ls_iterations="20"/>
  <worldbody>
    <geom type="plane" size="0 0 .05"/>
    <body pos="0 0 .15">
      <freejoint/>
      <geom type="box" size=".1 .1 .1"/>
      <body pos="0 0 .12">
        <joint name="arm" axis="0 1 0" range="-60 60" frictionloss=".01"/>
        <geom type="capsule" size=".03" fromto="0 0 0 0 0 .2"/>
      </body>
    </body>
    <body pos="1 0 .2"><freejoint/><geom type="sphere" size=".1"/></body>
  </worldbody>
  <actuator><general joint="arm" biastype="affine"/></actuator>
  <sensor><jointpos joint="arm"/></sensor>
</mujoco>
"""
WORLDS = 5


def run(engine):
    """A life of worlds: they are made, stepped and placed anew."""
    qpos, qvel = jnp.asarray(engine.model.qpos0, jnp.float32), jnp.zeros(engine.model.nv)

    @jax.jit
    @jax.vmap
    def life(where):
        moved = engine.step(engine.make(qpos, qvel), jnp.zeros(engine.model.nu), n_substeps=2)
        return engine.step(engine.place(moved, qpos, qvel, where), jnp.zeros(engine.model.nu), n_substeps=1).qpos

    return jax.block_until_ready(life(jnp.arange(WORLDS) % 2 == 0))


@pytest.mark.slow
@pytest.mark.parametrize("derived", [(), ("xpos",), ("sensordata",)])
def test_a_run_loads_what_was_prepared_and_compiles_no_more(derived, tmp_path, monkeypatch):
    prepared, loaded = [], []
    load, of_module = preparation.load, warp.Module.load
    monkeypatch.setattr(warp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(preparation, "load", lambda found, device: prepared.extend(found) or load(found, device))
    engine = make_engine("warp", mujoco.MjModel.from_xml_string(XML), derived, worlds=WORLDS)
    engine.prepare()()
    kept = set(tmp_path.iterdir())

    def spy(module, device, block_dim=None, *args, **options):
        loaded.append((module, block_dim or module.options["block_dim"]))
        return of_module(module, device, block_dim, *args, **options)

    monkeypatch.setattr(warp.Module, "load", spy)
    assert jnp.isfinite(run(engine)).all()
    assert {(module.name, block) for module, block in loaded} == {(module.name, block) for module, block in prepared}
    assert set(loaded) == set(prepared)
    assert set(tmp_path.iterdir()) == kept


def test_what_cannot_be_prepared_is_told_and_left_to_warp(monkeypatch, caplog):
    monkeypatch.delattr(preparation.mujoco_warp, "put_model")
    with caplog.at_level(logging.WARNING):
        preparation.Preparation(mujoco.MjModel.from_xml_string(XML), ["step"], contacts=24, rows=128).start_loading()()
    assert "first launched" in caplog.text


def test_a_kernel_that_fails_is_compiled_again_where_it_is_launched(tmp_path, monkeypatch, caplog):
    @warp.kernel(module="unique")
    def double(x: warp.array(dtype=float)):
        x[warp.tid()] *= 2.0

    class Verbs:
        put_model, make_data = preparation.mujoco_warp.put_model, preparation.mujoco_warp.make_data

        @staticmethod
        def step(m, d):
            warp.launch(double, dim=3, inputs=[warp.ones(3, dtype=float)])

    monkeypatch.setattr(preparation, "mujoco_warp", Verbs)
    monkeypatch.setattr(warp.config, "kernel_cache_dir", str(tmp_path / "file" / "under"))
    (tmp_path / "file").write_text("no folder")
    preparation.Preparation(mujoco.MjModel.from_xml_string(XML), ["step"], contacts=24, rows=128).start_loading()()
    assert "first launched" in caplog.text
    monkeypatch.setattr(warp.config, "kernel_cache_dir", str(tmp_path))
    warp.launch(double, dim=3, inputs=[x := warp.ones(3, dtype=float)])
    assert (x.numpy() == 2).all()


@warp.kernel(module="unique")
def triple(x: warp.array(dtype=float)):
    x[warp.tid()] *= 3.0


def test_an_engine_on_warp_has_it_print_no_line_for_each_module_that_it_loads(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(warp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(warp.config, "log_level", warp.LOG_INFO)
    make_engine("warp", mujoco.MjModel.from_xml_string(XML), worlds=WORLDS)
    warp.launch(triple, dim=3, inputs=[x := warp.ones(3, dtype=float)])
    assert (x.numpy() == 3).all()
    assert "load on device" not in capfd.readouterr().out


def test_kernels_that_remain_are_counted_while_threads_load_them(tmp_path, monkeypatch):
    monkeypatch.setattr(warp.config, "kernel_cache_dir", str(tmp_path))
    let_go, of_module = threading.Event(), warp.Module.load

    def slow(module, *args, **options):
        assert let_go.wait(60)
        return of_module(module, *args, **options)

    @warp.kernel(module="unique")
    def fourfold(x: warp.array(dtype=float)):
        x[warp.tid()] *= 4.0

    device = warp.get_device("cpu")
    monkeypatch.setattr(warp.Module, "load", slow)
    loads = preparation.load([(fourfold.module, 1)], device)
    assert (progress.remaining(), progress.describe()) == ((1, 1), "1 of 1 physics kernels remain")
    let_go.set()
    assert all(load.result() for load in loads.values())
    assert (progress.remaining(), progress.describe()) == ((0, 1), "")
