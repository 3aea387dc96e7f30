"""MuJoCo's C engine behind a callback: the engine of CPUs."""

import threading
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jax.experimental.buffer_callback import buffer_callback
from mujoco.batch import Batch, SimulationError

from arenas.physics.cpu import cores
from arenas.physics.engine import DYNAMICS, Engine, Law, Physics, StepResult, float_shape

STATE = ("qpos", "qvel", "qacc_warmstart", "act", "ctrl")  # all of a simulation that outlives a call
MOVING = ("qpos", "qvel", "act")  # what is not finite in a simulation that broke
PUSH = "xfrc_applied"  # also an input, in arenas that push bodies
Arrays = Mapping[str, Any]


class CEngine(Engine):
    """MuJoCo's C engine on all cores. The callback is stateless: it gets and returns the whole state."""

    name = "c"
    can_rest = True

    def __init__(
        self, model: mujoco.MjModel, derived: tuple[str, ...] = (), pushed: Sequence[int] = (), *, threads: int = 0
    ):
        # Only C has this reset: MJX never had it, and its Warp half refuses the flag.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        if mujoco.get_mju_user_warning() is None:  # warnings are counted below, so they need not be printed and logged
            mujoco.set_mju_user_warning(_ignore)
        super().__init__(model, derived, pushed)
        self._threads = threads
        self._lock = threading.Lock()
        self._rows: dict[tuple, Simulations] = {}
        if set(derived) & set(DYNAMICS):
            self._stage = mujoco.mjtStage.mjSTAGE_ACC
        else:
            self._stage = mujoco.mjtStage.mjSTAGE_POS

    def _carry(self, qpos: Array, qvel: Array, ctrl: Array, warmstart: Array, act: Array) -> Any:
        return warmstart, act

    def _warm(self, carry: Any) -> tuple[Array, Array]:
        return carry

    def step_many(
        self, physics: Physics, command: Array, n_substeps: int, law: Law | None, hold: int
    ) -> StepResult | None:
        """Return all `hold` control steps from one call of MuJoCo, unless the law can only run in JAX."""
        if law is not None and not accepts_batches(law, self.model):
            return None
        m = self.model
        sizes = dict(zip(STATE, (m.nq, m.nv, m.nv, m.na, m.nu), strict=True))
        shapes = {name: float_shape(hold, size) for name, size in sizes.items() if size}
        shapes["failed"] = jax.ShapeDtypeStruct((hold,), bool)
        state = self._state_arrays(physics, command)
        found = call_on_host(partial(self._steps, n_substeps, law), shapes, state, physics.model, physics.resting)
        qpos, qvel, warmstart, act, ctrl = (found.get(name, jnp.zeros((hold, 0))) for name in STATE)
        return StepResult(qpos, qvel, ctrl, found["failed"], (warmstart, act))

    def _substeps(self, physics: Physics, ctrl: Array, n: int) -> Physics:
        result = self.step_many(physics, ctrl, n, None, 1)
        assert result is not None
        return jax.tree.map(lambda x: x[0], result).applied_to(physics)

    def _place(self, carry: Any, qpos: Array, qvel: Array, where: Array) -> Any:
        return jax.tree.map(lambda x: jnp.where(where, 0.0, x), carry)

    def _derive(self, physics: Physics) -> Physics:
        if not self.derived:
            return physics
        m = self.model
        sizes = {"xpos": (m.nbody, 3), "xquat": (m.nbody, 4), "sensordata": (m.nsensordata,)}
        sizes |= {"actuator_force": (m.nu,), "qacc": (m.nv,)}
        shapes = {name: float_shape(*sizes[name]) for name in self.derived}
        state = self._state_arrays(physics, physics.ctrl)
        found = call_on_host(self._fields_of, shapes, state, physics.model, physics.resting)
        for name, new in found.items():
            before, resting = getattr(physics, name), physics.resting
            if before is not None and resting is not None:
                found[name] = jnp.where(resting, before, new)
        return physics._replace(**found)

    def _state_arrays(self, physics: Physics, ctrl: Array) -> dict[str, Array]:
        """Return the inputs of a call, by MuJoCo's names."""
        values = zip(STATE, (physics.qpos, physics.qvel, *physics.carry, ctrl), strict=True)
        return {name: value for name, value in values if value.size} | self._wrenches(physics.push)

    # On the host -----------------------------------------------------------------------------------------------------

    def _loaded(self, state: Arrays, model: Arrays) -> "Simulations":
        """Return as many simulations as there are worlds in the state, with that state."""
        key = (state["qpos"].size // self.model.nq, *model)
        if key not in self._rows:
            self._rows[key] = Simulations(Batch(self.model, key[0], self._threads or cores()), tuple(model))
        rows = self._rows[key]
        for values, own in ((state, rows.state), (model, rows.model)):
            for name, value in values.items():
                np.copyto(own[name], value.reshape(own[name].shape))
        return rows

    def _steps(self, n: int, law: Law | None, found: Arrays, state: Arrays, model: Arrays, resting: Any) -> None:
        """Fill `found`, (..., hold, size) each, with the state after each control step of `n` substeps.

        Each control step continues from the rounded float32 state, so a decision equals the same control steps one by
        one, to the last bit.
        """
        with self._lock:
            rows = self._loaded(state, model)
            worlds, hold = rows.batch.nsim, found["failed"].shape[-1]
            command = rows.state["ctrl"].copy()
            failed = np.zeros(worlds, bool)
            rows.batch.warning[:] = 0
            for control_step in range(hold):
                failed |= rows.advance(n, law, command, resting.ravel())
                for name, values in found.items():
                    out = values.reshape(worlds, hold, *values.shape[found["failed"].ndim :])[:, control_step]
                    if name == "failed":
                        out[:] = failed
                    else:
                        _copy_as_float32(out, rows.state[name])
                        rows.state[name][:] = out

    def _fields_of(self, found: Arrays, state: Arrays, model: Arrays, resting: Any) -> None:
        with self._lock:
            rows = self._loaded(state, model)
            outputs = {name: rows.batch.bind(name) for name in found}
            broken = rows.forward(self._stage, resting.ravel())
            for name, values in found.items():
                out = values.reshape(outputs[name].shape)
                _copy_as_float32(out, outputs[name])
                out[broken] = np.nan


class Simulations:
    """Simulations, and live views (worlds, ...) of their states and of those model fields that are their own."""

    def __init__(self, batch: Batch, own: Sequence[str]):
        self._begin(batch, own)

    def _begin(self, batch: Batch, own: Sequence[str]) -> None:
        self.batch = batch
        self.state = {name: batch.bind(name) for name in (*STATE, PUSH)}
        self.model = {name: batch.expand(name) for name in own}

    def advance(
        self, n: int, law: Law | None, command: np.ndarray, resting: np.ndarray | Literal[False] = False
    ) -> np.ndarray:
        """Advance those that are not `resting` (worlds,) by `n` substeps. Return (worlds,) bool: MuJoCo failed, warned
        since warnings were last cleared, or gave numbers that are not finite.
        """
        failed = np.zeros(self.batch.nsim, bool)
        for _ in range(1 if law is None else n):
            if law is not None:
                self.state["ctrl"][:] = law(self.state["qpos"], self.state["qvel"], command)
            failed |= self._step(n if law is None else 1, resting)
        return failed | self.batch.warning[:, :, 1].any(axis=1)  # (worlds, kinds, [detail, count]): bad numbers, ...

    def forward(self, stage: mujoco.mjtStage, resting: np.ndarray) -> np.ndarray:
        """Compute what follows from the states of those that are not `resting` (worlds,).

        Return (worlds,) bool: those whose numbers are not finite.
        """
        broken = self._broken()
        left_out = broken | resting
        if not left_out.all():
            self.batch.forward(np.flatnonzero(~left_out), stage=stage)
        return broken

    def _step(self, n: int, resting: np.ndarray | Literal[False]) -> np.ndarray:
        """Advance those that are not `resting` (worlds,) by `n` substeps. Return (worlds,) bool: MuJoCo failed, or
        numbers are not finite, as they stay.

        The simulations of a thread share memory. In some models MuJoCo 3.17 damps no velocities of a simulation after
        it has stepped one that is all NaN. Broken simulations are therefore left out; if one breaks within the call,
        the others take it again without it, in new memory.
        """
        broken, failed = self._broken(), np.zeros(self.batch.nsim, bool)
        left_out = broken | resting
        start = {name: values.copy() for name, values in self.state.items()}
        warnings = self.batch.warning.copy()
        while not left_out.all():
            try:
                self.batch.step(np.flatnonzero(~left_out) if left_out.any() else None, nstep=n)
            except SimulationError as error:
                failed[error.ids] = True
            new = self._broken() & ~broken
            if not new.any():
                break
            broken, left_out = broken | new, left_out | new
            self._renew(start, warnings)
        for name in MOVING:
            self.state[name][broken] = np.nan
        return failed | broken

    def _renew(self, state: Arrays, warnings: np.ndarray) -> None:
        """Make the simulations anew, with this state and these warnings, and the model fields of before."""
        before = self.model
        self._begin(Batch(self.batch.model, self.batch.nsim, self.batch.nthread), tuple(before))
        for values, own in ((state, self.state), (before, self.model)):
            for name, value in values.items():
                own[name][:] = value
        self.batch.warning[:] = warnings

    def _broken(self) -> np.ndarray:
        """Return (worlds,) bool: numbers of the state are not finite."""
        return ~np.logical_and.reduce([np.isfinite(self.state[name]).all(axis=1) for name in MOVING])


def accepts_batches(law: Law, model: mujoco.MjModel) -> bool:
    """Return whether a law accepts batched NumPy input and gives each world the same result as an unbatched call."""
    rng = np.random.default_rng(0)
    worlds = [rng.normal(size=(3, size)) for size in (model.nq, model.nv, model.nu)]
    try:
        batched = law(*worlds)
        alone = [law(*(values[i] for values in worlds)) for i in range(3)]
    except Exception:  # the law is foreign code: if it raises anything, it is a law for JAX alone
        return False
    return isinstance(batched, np.ndarray) and np.array_equal(batched, np.stack(alone))


def call_on_host(fill: Callable[..., None], shapes: dict[str, Any], *inputs: Any) -> dict[str, Array]:
    """Call `fill(found, *inputs)` on the host, which fills arrays of these shapes; under `vmap` once for all worlds.

    On a CPU it works on XLA's own buffers. Elsewhere they must be copied, as `pure_callback` does; on a CPU copying
    took 0.32 ms of CPU time for six arrays of 256 worlds, and 0.04 ms without (jax 0.10.2).
    """
    if jax.default_backend() == "cpu":

        def in_place(_: Any, *buffers: Any) -> None:
            fill(*jax.tree.map(np.asarray, buffers))

        return buffer_callback(in_place, shapes, vmap_method="broadcast_all")(*inputs)

    def copied(*inputs: Any) -> dict[str, np.ndarray]:
        lead = np.shape(inputs[0]["qpos"])[:-1]
        found = {name: np.empty((*lead, *x.shape), x.dtype) for name, x in shapes.items()}
        fill(found, *jax.tree.map(np.asarray, inputs))
        return found

    return jax.pure_callback(copied, shapes, *inputs, vmap_method="broadcast_all")


def _copy_as_float32(out: np.ndarray, values: np.ndarray) -> None:
    """Write float64 numbers into float32. Numbers of a diverged world that do not fit become infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        np.copyto(out, values, casting="same_kind")


def _ignore(message: str) -> None:
    """Ignore a warning of MuJoCo."""
