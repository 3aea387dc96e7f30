"""Native MuJoCo behind a callback: the engine of CPUs."""

import threading
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco.batch import Batch, SimulationError

from arenas.physics import DYNAMICS, Engine, Physics, f32


class CEngine(Engine):
    """Native MuJoCo on all cores. State in, state out: the callback keeps nothing between calls."""

    name = "c"

    def __init__(self, model: mujoco.MjModel, derived: tuple[str, ...] = (), threads: int = 0):
        # Only C has this reset: MJX never had it, and its Warp half refuses the flag.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        if mujoco.get_mju_user_warning() is None:  # warnings are counted below: no need to print and log each one
            mujoco.set_mju_user_warning(_ignore)
        super().__init__(model, derived)
        self._threads = threads
        self._lock = threading.Lock()
        self._batches: dict[tuple, Batch] = {}
        if set(derived) & set(DYNAMICS):
            self._stage = mujoco.mjtStage.mjSTAGE_ACC
        else:
            self._stage = mujoco.mjtStage.mjSTAGE_POS

    def _carry(self, qpos: Array, qvel: Array, ctrl: Array, warmstart: Array, act: Array) -> Any:
        return warmstart, act

    def _warm(self, carry: Any) -> tuple[Array, Array]:
        return carry

    def _substeps(self, physics: Physics, ctrl: Array, n: int) -> Physics:
        m = self.model
        shapes = (f32(m.nq), f32(m.nv), f32(m.nv), f32(m.na), jax.ShapeDtypeStruct((), bool))
        qpos, qvel, warmstart, act, failed = jax.pure_callback(
            partial(self._step_on_host, n), shapes, physics.qpos, physics.qvel, *physics.carry, ctrl, physics.model,
            vmap_method="broadcast_all",
        )  # fmt: skip
        return physics._replace(
            qpos=qpos, qvel=qvel, ctrl=ctrl, unstable=physics.unstable | failed, carry=(warmstart, act)
        )

    def _place(self, carry: Any, qpos: Array, qvel: Array, where: Array) -> Any:
        return jax.tree.map(lambda x: jnp.where(where, 0.0, x), carry)

    def _derive(self, physics: Physics) -> Physics:
        if not self.derived:
            return physics
        m = self.model
        sizes = {"xpos": (m.nbody, 3), "xquat": (m.nbody, 4), "sensordata": (m.nsensordata,)}
        sizes |= {"actuator_force": (m.nu,), "qacc": (m.nv,)}
        shapes = tuple(f32(*sizes[name]) for name in self.derived)
        values = jax.pure_callback(
            self._derive_on_host, shapes, physics.qpos, physics.qvel, *physics.carry, physics.ctrl, physics.model,
            vmap_method="broadcast_all",
        )  # fmt: skip
        return physics._replace(**dict(zip(self.derived, values, strict=True)))

    def _load(
        self, qpos: Any, qvel: Any, warmstart: Any, act: Any, ctrl: Any, model: dict[str, Any]
    ) -> tuple[Batch, tuple[int, ...]]:
        """Write states (..., nq), (..., nv), ... into a batch of as many simulations; the leading axes are returned."""
        lead = np.shape(qpos)[:-1]
        worlds = int(np.prod(lead))
        key = (worlds, *sorted(model))
        if key not in self._batches:
            self._batches[key] = Batch(self.model, worlds, self._threads)
        batch = self._batches[key]
        state = {"qpos": qpos, "qvel": qvel, "qacc_warmstart": warmstart, "act": act, "ctrl": ctrl}
        for name, value in state.items():
            rows = batch.bind(name)
            rows[:] = np.asarray(value).reshape(rows.shape)
        for name, value in model.items():
            rows = batch.expand(name)
            rows[:] = np.asarray(value).reshape(rows.shape)
        return batch, lead

    def _step_on_host(self, n: int, *state: Any) -> tuple[np.ndarray, ...]:
        with self._lock:
            batch, lead = self._load(*state)
            batch.warning[:] = 0
            failed = np.zeros(batch.nsim, bool)
            try:
                batch.step(nstep=n)
            except SimulationError as error:
                failed[error.ids] = True
            failed |= batch.warning[:, :, 1].any(axis=1)  # (worlds, kinds, [detail, count]): bad numbers, full buffers
            rows = (_narrow(batch.bind(name), lead) for name in ("qpos", "qvel", "qacc_warmstart", "act"))
            return *rows, failed.reshape(lead)

    def _derive_on_host(self, *state: Any) -> tuple[np.ndarray, ...]:
        with self._lock:
            batch, lead = self._load(*state)
            outputs = [batch.bind(name) for name in self.derived]
            batch.forward(stage=self._stage)
            return tuple(_narrow(x, lead) for x in outputs)


def _narrow(values: np.ndarray, lead: tuple[int, ...]) -> np.ndarray:
    """(worlds, ...) float64 as (*lead, ...) float32. What blew up may not fit: it becomes infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(np.float32).reshape(*lead, *values.shape[1:])


def _ignore(message: str) -> None:
    """Take a warning of MuJoCo's and do nothing."""
