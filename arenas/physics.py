"""What an arena needs of physics: the engine-neutral state of one world and the verbs that every engine has.

An engine makes a state from (qpos, qvel), steps it under a command and an actuation law, places chosen worlds anew, and
saves and loads a running world exactly. Code here is unbatched; callers batch with `jax.vmap`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from arenas.errors import EngineError

# law(qpos (nq,), qvel (nv,), command (nu,)) -> ctrl (nu,), applied before every substep; None is the identity. One that
# also takes NumPy's arrays (worlds, nq), ... is applied by the C engine without a way through JAX.
Law = Callable[[Any, Any, Any], Any]

# Nothing that we simulate moves faster (m/s, rad/s): a world beyond it has blown up, long before MuJoCo's own 1e10.
MAX_SPEED = 1e4

KINEMATICS = ("xpos", "xquat")  # of the new state, for one pass over the kinematics
DYNAMICS = ("sensordata", "actuator_force", "qacc")  # of the new state, for one whole forward pass
DERIVED = KINEMATICS + DYNAMICS

# Fields of the model that may differ from world to world, drawn at the start of an episode: all three engines read them
# in every step. Constants that MuJoCo derives from them when it compiles (inverse weights, by which soft constraints
# are scaled) keep the compiled model's values on all three; the mass of subtrees follows `body_mass`.
VARIABLE = (
    "geom_friction", "geom_solref", "body_mass", "body_inertia", "body_ipos", "body_pos", "dof_damping", "dof_armature",
    "jnt_stiffness", "actuator_gainprm", "actuator_biasprm",
)  # fmt: skip


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
    model: dict[str, Array] = {}  # noqa: RUF012  (this world's own model fields, of those in VARIABLE)


class Moved(NamedTuple):
    """What stepping changes of a world."""

    qpos: Array  # (nq,)
    qvel: Array  # (nv,)
    ctrl: Array  # (nu,) as applied in the last substep
    failed: Array  # () bool: numbers went bad or a buffer overflowed on the way
    carry: Any  # the engine's own

    def of(self, physics: Physics) -> Physics:
        """The world that has moved so; its time stands still, its derived fields lag."""
        unstable = physics.unstable | self.failed
        return physics._replace(qpos=self.qpos, qvel=self.qvel, ctrl=self.ctrl, unstable=unstable, carry=self.carry)


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

    # What each engine does in its own way ----------------------------------------------------------------------------

    @abstractmethod
    def _carry(self, qpos: Array, qvel: Array, ctrl: Array, warmstart: Array, act: Array) -> Any:
        """The engine's own part of a state: (qpos, qvel, ctrl) and what its last step left to start from."""

    @abstractmethod
    def _warm(self, carry: Any) -> tuple[Array, Array]:
        """Warm start (nv,) and activations (na,) out of the engine's own part."""

    @abstractmethod
    def _substeps(self, physics: Physics, ctrl: Array, n: int) -> Physics:
        """Advance by `n` substeps under constant controls; derived fields may lag."""

    @abstractmethod
    def _place(self, carry: Any, qpos: Array, qvel: Array, where: Array) -> Any:
        """Make the engine's own state agree with (qpos, qvel); where `where`, also forget the old episode."""

    @abstractmethod
    def _derive(self, physics: Physics) -> Physics:
        """Fill the derived fields from (qpos, qvel, ctrl)."""

    # The verbs -------------------------------------------------------------------------------------------------------

    def make(self, qpos: Array, qvel: Array, model: Mapping[str, Array] | None = None) -> Physics:
        """A fresh world at (qpos (nq,), qvel (nv,)), at time 0, with zero controls and model fields of its own."""
        m = self.model
        carry = self._carry(qpos, qvel, jnp.zeros(m.nu), jnp.zeros(m.nv), jnp.zeros(m.na))
        own = self._fields(model or {})
        return self._derive(Physics(qpos, qvel, jnp.zeros(m.nu), jnp.zeros(()), jnp.zeros((), bool), carry, model=own))

    def prepare(self) -> Callable[[], None]:
        """Begin, in threads, what the first step would take long for; what this returns waits for its end.

        Meanwhile nothing may be asked of the engine.
        """
        return lambda: None

    def ahead(self, physics: Physics, command: Array, n_substeps: int, law: Law | None, hold: int) -> Moved | None:
        """The next `hold` control steps under one command, stacked, of an engine that makes them at once; else None."""
        return None

    def step(
        self, physics: Physics, command: Array, n_substeps: int, law: Law | None = None, moved: Moved | None = None
    ) -> Physics:
        """Advance one world by a control step: `n_substeps` timesteps under `command` (nu,) through `law`.

        `moved`: this control step of those that `ahead` made; nothing is asked of the engine then but derived fields.
        """
        start = physics.time
        if moved is None:
            moved = jax.tree.map(lambda x: x[0], self.ahead(physics, command, n_substeps, law, 1))
        if moved is not None:
            physics = moved.of(physics)
        elif law is None:
            physics = self._substeps(physics, command, n_substeps)
        else:
            for _ in range(n_substeps):
                physics = self._substeps(physics, law(physics.qpos, physics.qvel, command), 1)
        bad = ~jnp.all(sound(physics.qpos, physics.qvel))
        # Whole timesteps: a float32 sum of them is off by a control step after two minutes.
        timestep = self.model.opt.timestep
        time = (jnp.round(start / timestep) + n_substeps) * timestep
        return self._derive(physics._replace(time=time, unstable=physics.unstable | bad))

    def place(
        self, physics: Physics, qpos: Array, qvel: Array, where: Array, model: Mapping[str, Array] | None = None
    ) -> Physics:
        """Put the world at (qpos, qvel), with these model fields, where `where` () bool; elsewhere nothing changes."""
        qpos = jnp.where(where, qpos, physics.qpos)
        qvel = jnp.where(where, qvel, physics.qvel)
        own = self._fields(physics.model if model is None else model)
        return self._derive(
            physics._replace(
                qpos=qpos,
                qvel=qvel,
                ctrl=jnp.where(where, 0.0, physics.ctrl),
                time=jnp.where(where, 0.0, physics.time),
                unstable=physics.unstable & ~where,
                carry=self._place(physics.carry, qpos, qvel, where),
                model={name: jnp.where(where, new, physics.model[name]) for name, new in own.items()},
            )
        )

    def save(self, physics: Physics) -> dict[str, Array]:
        """All that decides how this world goes on, by name; the same names and shapes on every engine."""
        warmstart, act = self._warm(physics.carry)
        neutral = {name: getattr(physics, name) for name in ("qpos", "qvel", "ctrl", "time", "unstable")}
        own = {f"model/{name}": value for name, value in physics.model.items()}
        return neutral | {"warmstart": warmstart, "act": act} | own

    def load(self, saved: Mapping[str, Array]) -> Physics:
        """The world of `save`: on the same engine it goes on bit for bit as the one that was saved."""
        qpos, qvel = saved["qpos"], saved["qvel"]
        carry = self._carry(qpos, qvel, saved["ctrl"], saved["warmstart"], saved["act"])
        own = {name.removeprefix("model/"): value for name, value in saved.items() if name.startswith("model/")}
        return self._derive(
            Physics(qpos, qvel, saved["ctrl"], saved["time"], saved["unstable"], carry, model=self._fields(own))
        )

    def _fields(self, model: Mapping[str, Array]) -> dict[str, Array]:
        """A world's own model fields, checked, with what must follow from them."""
        for name, value in model.items():
            if name not in VARIABLE and name != "body_subtreemass":
                raise EngineError(f"model field {name!r} cannot differ between worlds; {', '.join(VARIABLE)} can")
            shape = getattr(self.model, name).shape
            if jnp.shape(value) != shape:
                raise EngineError(f"model field {name} has shape {jnp.shape(value)}, not {shape} as the model's")
        own = {name: jnp.asarray(value, jnp.float32) for name, value in model.items()}
        if "body_mass" in own:
            own["body_subtreemass"] = (_subtrees(self.model) * own["body_mass"]).sum(axis=1)
        return own


class Still(Engine):
    """The engine of worlds in which nothing can move, such as matrix games: only time passes."""

    name = "none"

    def __init__(self, model: mujoco.MjModel, derived: tuple[str, ...] = ()):
        super().__init__(model, derived)
        if derived or model.nv:
            raise EngineError("engine none is for worlds without bodies: it derives no fields and moves nothing")

    def _carry(self, qpos: Array, qvel: Array, ctrl: Array, warmstart: Array, act: Array) -> Any:
        return ()

    def _warm(self, carry: Any) -> tuple[Array, Array]:
        return jnp.zeros(0), jnp.zeros(0)

    def _substeps(self, physics: Physics, ctrl: Array, n: int) -> Physics:
        return physics

    def _place(self, carry: Any, qpos: Array, qvel: Array, where: Array) -> Any:
        return ()

    def _derive(self, physics: Physics) -> Physics:
        return physics


def stackable(*values: Array) -> tuple[Array, ...]:
    """The same arrays, kept apart from the call that wrote them, so that a caller's scan may stack them.

    On a GPU (jax 0.11.2, Warp) XLA's dynamic-slice fusion copies an engine's call to where its output is stacked. The
    copy's buffers are not the ones that it updates: frames were all zeros and later states wrong by metres. On one H100
    with 4,096 worlds the barrier costs training 0.2 %; a recorded match, whose calls no longer run twice, went from
    3.29 to 2.07 s.
    """
    return jax.lax.optimization_barrier(values)


def sound(qpos: Array, qvel: Array) -> Array:
    """() bool: numbers (n,), (m,) of something that has not blown up."""
    return jnp.all(jnp.isfinite(qpos)) & jnp.all(jnp.abs(qvel) < MAX_SPEED)


def _subtrees(model: mujoco.MjModel) -> np.ndarray:
    """(nbody, nbody) 1 where the second body hangs, at whatever depth, on the first."""
    below = np.eye(model.nbody, dtype=np.float32)
    for body in range(model.nbody - 1, 0, -1):  # children have higher numbers than their parents
        below[model.body_parentid[body]] += below[body]
    return below


def f32(*shape: int) -> jax.ShapeDtypeStruct:
    """The shape of an array of floats."""
    return jax.ShapeDtypeStruct(shape, jnp.float32)
