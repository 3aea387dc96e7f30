"""Recorded play, and the bare engine that replays it: the same states and the same controls.

T decisions, N worlds, S physics substeps in a decision. Random controls would be no baseline: robots that stand or
tremble have fewer contacts than robots that fight, and their steps cost two thirds as much.
"""

import copy
import os
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco import mjx
from mujoco.batch import Batch

from agents.rollout.rollout import Trajectory, Worlds
from arenas.arena import Arena
from arenas.physics.engine import Physics
from arenas.physics.mjx import OVERFLOW_BITS, MjxEngine

LOST = sum(OVERFLOW_BITS.values())  # Warp's overflow bits that mean dropped contacts or rows, disjoint by cause
CONVERGED = {"iterations": 100, "ls_iterations": 50}
STATE = {
    "qpos": "qpos",
    "qvel": "qvel",
    "warmstart": "qacc_warmstart",
    "act": "act",
}  # in `Engine.save` -> in MuJoCo


class Play(NamedTuple):
    """The states and controls that the engine received."""

    start: dict[str, Array]  # (T, N, ...) each world as each decision begins, see `Engine.save`
    controls: Array  # (T, N, S, nu) before each substep, the robots' laws applied


def make_record(arena: Arena, length: int) -> jax.stages.Wrapped:
    """Return compiled `record(state, trajectory, key) -> Play`, which repeats a rollout of `length` decisions.

    `state` is the state of the worlds before that rollout, `trajectory` its result, and `key` its key. The C engine
    repeats it bit for bit; Warp adds in another order each time.
    """

    def record(state: Any, trajectory: Trajectory, key: Array) -> Play:
        over = trajectory.terminated | trajectory.truncated | trajectory.void

        def decision(state: Any, of: tuple) -> tuple[Any, Play]:
            actions, over, key = of
            _, place_key = jax.random.split(key)
            play = Play(jax.vmap(arena.engine.save)(state.physics), jax.vmap(partial(_controls, arena))(state, actions))
            after = jax.vmap(arena.step)(state, actions)
            return jax.vmap(arena.restart)(after, jax.random.split(place_key, over.shape[0]), over), play

        return jax.lax.scan(decision, state, (trajectory.actions, over, jax.random.split(key, length)))[1]

    return jax.jit(record)


def _controls(arena: Arena, state: Any, actions: Mapping[str, Array]) -> Array:
    """Return the controls (S, nu) of one world's decision."""
    command, substeps = arena.command(actions), arena.timing.substeps

    def control_step(physics: Physics, _: None) -> tuple[Physics, Array]:
        if arena.law is None:
            return arena.engine.step(physics, command, substeps), jnp.tile(command, (substeps, 1))
        applied = []
        for _ in range(substeps):
            applied.append(arena.law(physics.qpos, physics.qvel, command))
            physics = arena.engine.step(physics, applied[-1], 1)
        return physics, jnp.stack(applied)

    _, controls = jax.lax.scan(control_step, state.physics, length=arena.timing.hold)
    return controls.reshape(-1, controls.shape[-1])


def clocks() -> np.ndarray:
    """Return seconds (wall-clock, CPU of this process and its children); other load affects the second less."""
    own = [int(pid) for each in Path("/proc/self/task").glob("*/children") for pid in each.read_text().split()]
    return np.array([time.perf_counter(), time.process_time() + sum(map(_cpu_seconds, own))])


def _cpu_seconds(pid: int) -> float:
    """Return user and system CPU seconds of a process."""
    after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, after_name[11:13])) / os.sysconf("SC_CLK_TCK")


class Native:
    """Bare C MuJoCo: one call of `mujoco.batch.Batch` for each decision, all its substeps in it."""

    def __init__(self, model: mujoco.MjModel, worlds: int, threads: int = 0):
        self.batch = Batch(model, worlds, threads)

    def put(self, play: Play, t: int) -> np.ndarray:
        """Write the states of decision `t`; return its controls."""
        for name, values in play.start.items():
            field = STATE.get(name)
            if name.startswith("model/"):
                self.batch.expand(name.removeprefix("model/"))[:] = values[t]
            elif field is not None:
                rows = self.batch.bind(field)
                rows[:] = values[t].reshape(rows.shape)
        return np.ascontiguousarray(play.controls[t], np.float64)

    def seconds(self, play: Play) -> np.ndarray:
        """Return seconds (wall-clock, CPU) to step through all decisions, without writing their states."""
        play, total = jax.device_get(play), np.zeros(2)
        for t in range(play.controls.shape[0]):
            controls = self.put(play, t)
            began = clocks()
            self.batch.rollout(controls.shape[1], controls, record=())
            total += clocks() - began
        return total

    def through(self, play: Play, fields: tuple[str, ...], substeps: int | None = None) -> dict[str, np.ndarray]:
        """Return fields of MjData (T, N, substeps, ...) after all substeps of each decision, or the first few."""
        play = jax.device_get(play)
        found = []
        for t in range(play.controls.shape[0]):
            controls = self.put(play, t)[:, :substeps]
            found.append(self.batch.rollout(controls.shape[1], controls, record=fields))
        return {name: np.stack([step[name] for step in found]) for name in fields}


class Accelerated:
    """Bare MJX: one compiled scan over all substeps, nothing in it but `mjx.step`."""

    def __init__(self, engine: MjxEngine):
        self.engine = engine
        self._run = jax.jit(self._scan)

    def _scan(self, play: Play) -> tuple[Array, ...]:
        """Return final positions (N, nq) and, for Warp, iterations, rows and lost contacts of every substep."""
        own = self.engine._mjx  # time the engine's own model
        data = jax.vmap(self.engine.load)({name: values[0] for name, values in play.start.items()}).carry

        def substep(carry: tuple, ctrl: Array) -> tuple[tuple, tuple]:
            data, model = carry
            step = jax.vmap(lambda d, c, m: mjx.step(own.replace(**m) if m else own, d.replace(ctrl=c)))
            data = step(data, ctrl, model)
            if self.engine.name != "warp":
                return (data, model), ()
            counters = (data._impl.solver_niter, data._impl.nefc, data._impl.overflow & LOST != 0)
            return (data, model), jax.lax.optimization_barrier(counters)

        def decision(data: Any, of: tuple) -> tuple[Any, tuple]:
            start, controls = of
            data = data.replace(**{field: start[name] for name, field in STATE.items()})
            model = {k.removeprefix("model/"): v for k, v in start.items() if k.startswith("model/")}
            (data, _), counters = jax.lax.scan(substep, (data, model), jnp.moveaxis(controls, 1, 0))
            return data, counters

        data, counters = jax.lax.scan(decision, data, (play.start, play.controls))
        return data.qpos, counters

    def seconds(self, play: Play) -> np.ndarray:
        """Return seconds (wall-clock, CPU) to step through all decisions."""
        jax.block_until_ready(play)
        began = clocks()
        jax.block_until_ready(self._run(play))
        return clocks() - began

    def counts(self, play: Play) -> dict[str, np.ndarray]:
        """Return Warp's solver iterations, rows and lost contacts after every substep, (T, S, N)."""
        _, counters = self._run(play)
        names = ("warp_iterations", "warp_rows", "lost")[: len(counters)]
        return {name: np.asarray(values, np.float64) for name, values in zip(names, counters, strict=True)}


def bare(arena: Arena, worlds: int) -> Native | Accelerated:
    """Return the engine of an arena without the arena."""
    if isinstance(arena.engine, MjxEngine):
        return Accelerated(arena.engine)
    return Native(arena.scene.model, worlds)


class Stretch(NamedTuple):
    """A timed stretch of play, and its replay."""

    worlds: Worlds  # after it
    trajectory: Trajectory
    play: Play
    whole: np.ndarray  # seconds (wall-clock, CPU) of the whole stretch
    bare: np.ndarray  # the same of the bare engine


class Pair:
    """Rollouts of `length` decisions of an arena, each followed by its replay on the bare engine."""

    def __init__(self, arena: Arena, worlds: int, length: int):
        self.record, self.alone = make_record(arena, length), bare(arena, worlds)

    def stretch(self, whole: Callable[[Worlds, Array], tuple[Worlds, Trajectory]], now: Worlds, key: Array) -> Stretch:
        """Time `whole(now, key)`, which does a rollout of `make_rollout` with this key, and its replay."""
        before = jax.tree.map(jnp.copy, now.state)
        jax.block_until_ready((now, before))
        began = clocks()
        now, trajectory = jax.block_until_ready(whole(now, key))
        took = clocks() - began
        play = jax.block_until_ready(self.record(before, trajectory, key))
        return Stretch(now, trajectory, play, took, self.alone.seconds(play))


def counts(model: mujoco.MjModel, play: Play) -> dict[str, np.ndarray]:
    """Return contacts, constraint rows and Newton iterations of every substep of the play, from the C engine.

    Iterations are counted until convergence, regardless of the model's cap: the maximum over islands, and with all
    robots solved as one, as MJX does.
    """
    worlds = play.controls.shape[1]
    apart = Native(_with(model, **CONVERGED), worlds).through(play, ("ncon", "nefc", "solver_niter"))
    whole = Native(_with(model, islands=False, **CONVERGED), worlds).through(play, ("solver_niter",))
    return {
        "ncon": apart["ncon"], "nefc": apart["nefc"], "iterations": apart["solver_niter"].max(axis=-1),
        "iterations_without_islands": whole["solver_niter"].max(axis=-1),
    }  # fmt: skip


def cap_errors(arena: Arena, play: Play, caps: Sequence[tuple[int, int]]) -> dict[tuple[int, int], dict]:
    """Return the errors of capped solves (iterations, line-search steps) over one control step.

    The reference is a converged solve; all robots are solved as one, without islands, as MJX does. Each cap has the
    largest error of any robot, (T, N): base position (m), orientation (rad), driven joints (rad), base speed (m/s).
    """
    worlds, model = play.controls.shape[1], arena.scene.model

    def ends(**options: float) -> tuple[np.ndarray, np.ndarray]:
        capped = _with(model, islands=False, **options)
        found = Native(capped, worlds).through(play, ("qpos", "qvel"), arena.timing.substeps)
        return found["qpos"][:, :, -1], found["qvel"][:, :, -1]

    true = ends(**CONVERGED | {"tolerance": 1e-13})
    return {cap: _gaps(arena, ends(iterations=cap[0], ls_iterations=cap[1]), true) for cap in caps}


def _gaps(arena: Arena, ours: tuple[np.ndarray, ...], true: tuple[np.ndarray, ...]) -> dict[str, np.ndarray]:
    (qpos, qvel), (qpos0, qvel0) = ours, true
    gaps: dict[str, list[np.ndarray]] = {"base_m": [], "turn_rad": [], "joints_rad": [], "speed_m_s": []}
    for at in arena.scene.agents.values():
        place, turn = slice(at.qpos, at.qpos + 3), slice(at.qpos + 3, at.qpos + 7)
        speed = slice(at.qvel, at.qvel + 3)
        gaps["base_m"].append(np.linalg.norm((qpos - qpos0)[..., place], axis=-1))
        apart = np.linalg.norm((qpos - qpos0)[..., turn], axis=-1)  # of unit quaternions: half the angle, if small
        gaps["turn_rad"].append(2 * apart)
        gaps["joints_rad"].append(np.abs((qpos - qpos0)[..., at.joint_qpos]).max(axis=-1))
        gaps["speed_m_s"].append(np.linalg.norm((qvel - qvel0)[..., speed], axis=-1))
    return {name: np.stack(of).max(axis=0) for name, of in gaps.items()}


def _with(model: mujoco.MjModel, *, islands: bool = True, **options: float) -> mujoco.MjModel:
    """Return a copy of a model with other solver options."""
    other = copy.copy(model)
    if not islands:
        other.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    for name, value in options.items():
        setattr(other.opt, name, value)
    return other
