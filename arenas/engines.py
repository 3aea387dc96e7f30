"""Three physics engines behind three verbs, for unbatched code that its caller batches with `jax.vmap`.

| engine | where                       | how                                                          |
|--------|-----------------------------|--------------------------------------------------------------|
| `c`    | CPU, the default there      | `mujoco.batch.Batch` threads behind `jax.pure_callback`      |
| `jax`  | any XLA device              | MJX, `impl='jax'`                                            |
| `warp` | NVIDIA GPU, default there   | MJX, `impl='warp'`                                           |

An engine makes a state from (qpos, qvel), steps it under a command and an actuation law, and places chosen worlds anew.
MuJoCo in C resets a world by itself when numbers go bad; that is switched off, and such a world is told `unstable`.
"""

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from mujoco import mjx
from mujoco.batch import Batch, SimulationError

EngineName = Literal["auto", "c", "jax", "warp"]

# law(qpos (nq,), qvel (nv,), command (nu,)) -> ctrl (nu,), applied before every substep; None is the identity.
Law = Callable[[Array, Array, Array], Array]

# Nothing that we simulate moves faster (m/s, rad/s): a world beyond it has blown up, long before MuJoCo's own 1e10.
MAX_SPEED = 1e4

# Warp's overflow bits that mean contacts or rows were dropped: OverflowType NEFC, NJMAX_NNZ, BROADPHASE, NARROWPHASE,
# CCD, HFIELD, CONTACT_MATCH, NVMAX, EPA_HORIZON. Those above only say that the solver used all its iterations, as it
# does now and then in single precision (1.4 of 1,000 decisions of pushers): the C engine does not stop for that either.
LOST = 0x1FF

KINEMATICS = ("xpos", "xquat")  # of the new state, for one pass over the kinematics
DYNAMICS = ("sensordata", "actuator_force", "qacc")  # of the new state, for one whole forward pass
DERIVED = KINEMATICS + DYNAMICS


class EngineError(Exception):
    """An engine that does not exist or cannot run here; the message is one line for the user."""


class Physics(NamedTuple):
    """The engine-neutral state of one world. Fields that the arena did not ask to derive are None.

    SI units. After a step MuJoCo leaves derived fields one substep behind and after a placing those of the old episode;
    here they always belong to (qpos, qvel), recomputed once per control step on every engine.
    """

    qpos: Array  # (nq,)
    qvel: Array  # (nv,)
    ctrl: Array  # (nu,) as applied in the last substep
    time: Array  # () seconds since the world was placed
    unstable: Array  # () bool: numbers went bad or a buffer overflowed since the world was placed
    carry: Any  # the engine's own: warm start, actuator state, MJX data
    xpos: Array | None = None  # (nbody, 3)
    xquat: Array | None = None  # (nbody, 4) w first
    sensordata: Array | None = None  # (nsensordata,)
    actuator_force: Array | None = None  # (nu,)
    qacc: Array | None = None  # (nv,)


class Engine(ABC):
    """What an arena needs of physics. `derived` names the fields beyond (qpos, qvel) that it reads."""

    name: str

    def __init__(self, model: mujoco.MjModel, derived: tuple[str, ...] = ()):
        unknown = set(derived) - set(DERIVED)
        if unknown:
            raise EngineError(
                f"an engine cannot derive {', '.join(sorted(unknown))}; it can derive {', '.join(DERIVED)}"
            )
        self.model = model
        self.derived = derived

    @abstractmethod
    def make(self, qpos: Array, qvel: Array) -> Physics:
        """A fresh world at (qpos (nq,), qvel (nv,)), at time 0 and with zero controls."""

    @abstractmethod
    def _substeps(self, physics: Physics, ctrl: Array, n: int) -> Physics:
        """Advance by `n` substeps under constant controls; derived fields may lag."""

    @abstractmethod
    def _place(self, carry: Any, qpos: Array, qvel: Array, where: Array) -> Any:
        """Make the engine's own state agree with (qpos, qvel); where `where`, also forget the old episode."""

    @abstractmethod
    def _derive(self, physics: Physics) -> Physics:
        """Fill the derived fields from (qpos, qvel, ctrl)."""

    def step(self, physics: Physics, command: Array, n_substeps: int, law: Law | None = None) -> Physics:
        """Advance one world by `n_substeps` timesteps under `command` (nu,) through `law`."""
        start = physics.time
        if law is None:
            physics = self._substeps(physics, command, n_substeps)
        else:
            for _ in range(n_substeps):
                physics = self._substeps(physics, law(physics.qpos, physics.qvel, command), 1)
        bad = ~jnp.all(jnp.isfinite(physics.qpos)) | ~jnp.all(jnp.abs(physics.qvel) < MAX_SPEED)
        # Whole timesteps: a float32 sum of them is off by a control step after two minutes.
        timestep = self.model.opt.timestep
        time = (jnp.round(start / timestep) + n_substeps) * timestep
        return self._derive(physics._replace(time=time, unstable=physics.unstable | bad))

    def place(self, physics: Physics, qpos: Array, qvel: Array, where: Array) -> Physics:
        """Put the world at (qpos, qvel) where `where` () bool; elsewhere nothing changes."""
        qpos = jnp.where(where, qpos, physics.qpos)
        qvel = jnp.where(where, qvel, physics.qvel)
        return self._derive(
            physics._replace(
                qpos=qpos,
                qvel=qvel,
                ctrl=jnp.where(where, 0.0, physics.ctrl),
                time=jnp.where(where, 0.0, physics.time),
                unstable=physics.unstable & ~where,
                carry=self._place(physics.carry, qpos, qvel, where),
            )
        )


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
        self._batches: dict[int, Batch] = {}
        if set(derived) & set(DYNAMICS):
            self._stage = mujoco.mjtStage.mjSTAGE_ACC
        else:
            self._stage = mujoco.mjtStage.mjSTAGE_POS

    def make(self, qpos: Array, qvel: Array) -> Physics:
        """A fresh world; the carry is its warm start (nv,) and its actuators' activations (na,)."""
        m = self.model
        carry = (jnp.zeros(m.nv), jnp.zeros(m.na))
        return self._derive(Physics(qpos, qvel, jnp.zeros(m.nu), jnp.zeros(()), jnp.zeros((), bool), carry))

    def _substeps(self, physics: Physics, ctrl: Array, n: int) -> Physics:
        m = self.model
        shapes = (_f32(m.nq), _f32(m.nv), _f32(m.nv), _f32(m.na), jax.ShapeDtypeStruct((), bool))
        qpos, qvel, warmstart, act, failed = jax.pure_callback(
            partial(self._step_on_host, n), shapes, physics.qpos, physics.qvel, *physics.carry, ctrl,
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
        shapes = tuple(_f32(*sizes[name]) for name in self.derived)
        values = jax.pure_callback(
            self._derive_on_host, shapes, physics.qpos, physics.qvel, *physics.carry, physics.ctrl,
            vmap_method="broadcast_all",
        )  # fmt: skip
        return physics._replace(**dict(zip(self.derived, values, strict=True)))

    def _load(self, qpos: Any, qvel: Any, warmstart: Any, act: Any, ctrl: Any) -> tuple[Batch, tuple[int, ...]]:
        """Write states (..., nq), (..., nv), ... into a batch of as many simulations; the leading axes are returned."""
        lead = np.shape(qpos)[:-1]
        worlds = int(np.prod(lead))
        if worlds not in self._batches:
            self._batches[worlds] = Batch(self.model, worlds, self._threads)
        batch = self._batches[worlds]
        state = {"qpos": qpos, "qvel": qvel, "qacc_warmstart": warmstart, "act": act, "ctrl": ctrl}
        for name, value in state.items():
            rows = batch.bind(name)
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


class MjxEngine(Engine):
    """MuJoCo XLA, in JAX or in Warp kernels. `worlds`, the most stepped together, sizes Warp's contact pool."""

    def __init__(
        self,
        model: mujoco.MjModel,
        derived: tuple[str, ...] = (),
        *,
        impl: Literal["jax", "warp"],
        worlds: int = 1,
        contacts: int = 24,
        rows: int = 128,
    ):
        super().__init__(model, derived)
        self.name = impl
        self._mjx = mjx.put_model(model, impl=impl)
        self._buffers: dict[str, int] = {}
        if impl == "warp":
            # One contact pool serves all worlds; overflow is read below and voids the episode: no need to print it.
            self._mjx = self._mjx.tree_replace({"opt._impl.warn_overflow": 0})
            self._buffers = {"naconmax": contacts * worlds, "njmax": rows}

    def make(self, qpos: Array, qvel: Array) -> Physics:
        """A fresh world; the carry is MJX's own data."""
        data = mjx.make_data(self.model, impl=self.name, **self._buffers).replace(qpos=qpos, qvel=qvel)
        zero = jnp.zeros(())
        return self._derive(Physics(qpos, qvel, jnp.zeros(self.model.nu), zero, jnp.zeros((), bool), data))

    def _substeps(self, physics: Physics, ctrl: Array, n: int) -> Physics:
        data = physics.carry.replace(ctrl=ctrl)
        overflow = jnp.zeros((), bool)
        for _ in range(n):
            data = mjx.step(self._mjx, data)
            if self.name == "warp":
                overflow |= jnp.any(data._impl.overflow & LOST != 0)
        return physics._replace(
            qpos=data.qpos, qvel=data.qvel, ctrl=ctrl, unstable=physics.unstable | overflow, carry=data
        )

    def _place(self, carry: Any, qpos: Array, qvel: Array, where: Array) -> Any:
        if self.name == "warp":  # Warp only ever adds overflow bits
            overflow = jnp.where(where, 0, carry._impl.overflow)
            carry = carry.tree_replace({"_impl.overflow": overflow})
        return carry.replace(
            qpos=qpos,
            qvel=qvel,
            qacc_warmstart=jnp.where(where, 0.0, carry.qacc_warmstart),
            act=jnp.where(where, 0.0, carry.act),
            ctrl=jnp.where(where, 0.0, carry.ctrl),
        )

    def _derive(self, physics: Physics) -> Physics:
        if not self.derived:
            return physics
        refresh = mjx.forward if set(self.derived) & set(DYNAMICS) else mjx.kinematics
        data = refresh(self._mjx, physics.carry)
        return physics._replace(carry=data, **{name: getattr(data, name) for name in self.derived})


def choose(name: EngineName) -> str:
    """Resolve `auto` to `warp` on an NVIDIA GPU and to `c` elsewhere; say so where a named engine cannot run."""
    on_gpu = jax.default_backend() == "gpu"
    if name == "auto":
        return "warp" if on_gpu else "c"
    if name not in ("c", "jax", "warp"):
        raise EngineError(f"unknown engine {name!r}: choose auto, c, jax or warp")
    return name


def make_engine(
    name: EngineName,
    model: mujoco.MjModel,
    derived: tuple[str, ...] = (),
    *,
    worlds: int = 1,
    contacts: int = 24,
    rows: int = 128,
    threads: int = 0,
) -> Engine:
    """An engine by name. `contacts` and `rows` are Warp's buffer sizes per world, `threads` the C engine's (0: all)."""
    resolved = choose(name)
    if resolved == "c":
        return CEngine(model, derived, threads)
    if resolved == "warp":
        try:
            import warp  # noqa: F401  (mjx imports it late, and then with a traceback)
        except ImportError as error:
            raise EngineError(
                "engine warp needs warp-lang: pip install 'robot-league[cuda]', or use engine c"
            ) from error
        return MjxEngine(model, derived, impl="warp", worlds=worlds, contacts=contacts, rows=rows)
    return MjxEngine(model, derived, impl="jax")


def _narrow(values: np.ndarray, lead: tuple[int, ...]) -> np.ndarray:
    """(worlds, ...) float64 as (*lead, ...) float32. What blew up may not fit: it becomes infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(np.float32).reshape(*lead, *values.shape[1:])


def _ignore(message: str) -> None:
    """Take a warning of MuJoCo's and do nothing."""


def _f32(*shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, jnp.float32)
