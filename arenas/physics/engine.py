"""Interface of physics engines: the engine-neutral state of one world and the operations of every engine.

An engine makes a state from (qpos, qvel), steps it under a command and an actuation law, resets chosen worlds, and
saves and loads a running world exactly. Code here is unbatched; callers batch with `jax.vmap`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from arenas.errors import EngineError
from arenas.physics.void_causes import Cause

# law(qpos (nq,), qvel (nv,), command (nu,)) -> ctrl (nu,), applied before every substep; None is the identity. The C
# engine applies a law without JAX if the law also accepts NumPy arrays (worlds, nq), ...
Law = Callable[[Any, Any, Any], Any]

# m/s and rad/s. All simulated bodies are slower: a faster world has diverged, long before MuJoCo's own limit of 1e10.
MAX_SPEED = 1e4

KINEMATICS = ("xpos", "xquat")  # of the new state; one pass over the kinematics
DYNAMICS = ("sensordata", "actuator_force", "qacc")  # of the new state; one whole forward pass
DERIVED = KINEMATICS + DYNAMICS

# Fields of the model that may differ between worlds, drawn at the start of an episode: all three engines read them in
# every step. Constants that MuJoCo derives from them at compile time (inverse weights, which scale soft constraints)
# keep the compiled model's values on all three; the mass of subtrees follows `body_mass`. Warp reads `body_pos` of
# bodies that can move alone: those fixed to the world stay where the compiled model has them.
VARIABLE = (
    "geom_friction", "geom_solref", "body_mass", "body_inertia", "body_ipos", "body_pos", "dof_damping", "dof_armature",
    "jnt_stiffness", "actuator_gainprm", "actuator_biasprm",
)  # fmt: skip


class Physics(NamedTuple):
    """The engine-neutral state of one world. Fields that the arena did not ask to derive are None.

    SI units. MuJoCo leaves derived fields one substep behind after a step, and those of the old episode after a reset.
    Here they always belong to (qpos, qvel): every engine recomputes them once per control step.
    """

    qpos: Array  # (nq,)
    qvel: Array  # (nv,)
    ctrl: Array  # (nu,) as applied in the last substep
    time: Array  # () seconds since the world was reset
    causes: Array  # () uint8, bits of `void_causes.Cause`: failures since the world was reset
    carry: Any  # the engine's own: warm start, actuator state, MJX data
    xpos: Array | None = None  # (nbody, 3)
    xquat: Array | None = None  # (nbody, 4) w first
    sensordata: Array | None = None  # (nsensordata,)
    actuator_force: Array | None = None  # (nu,)
    qacc: Array | None = None  # (nv,)
    model: dict[str, Array] = {}  # noqa: RUF012  (this world's own model fields, of those in VARIABLE)
    push: Array | None = None  # (pushed, 6) N, N·m: force and torque in the world on the engine's `pushed` bodies
    resting: Array | None = None  # () bool: only time passes; None on engines that step all worlds alike

    @property
    def unstable(self) -> Array:
        """() bool: numbers became non-finite or a buffer overflowed since the world was reset."""
        return self.causes != 0


class StepResult(NamedTuple):
    """The part of a world's state that stepping changes."""

    qpos: Array  # (nq,)
    qvel: Array  # (nv,)
    ctrl: Array  # (nu,) as applied in the last substep
    failed: Array  # () bool: numbers became non-finite during the step
    carry: Any  # the engine's own

    def applied_to(self, physics: Physics) -> Physics:
        """Return the world after the step. Its time is unchanged, and its derived fields lag."""
        causes = physics.causes | cause_bit(self.failed, Cause.NUMBERS)
        return physics._replace(qpos=self.qpos, qvel=self.qvel, ctrl=self.ctrl, causes=causes, carry=self.carry)


class Engine(ABC):
    """Base class of engines. `derived` names the fields beyond (qpos, qvel) that the arena reads; `pushed` are the ids
    of bodies on which outer forces act at their centres of mass (MuJoCo's `xfrc_applied`). Others cost nothing.
    """

    name: str
    can_rest = False  # whether worlds that need not move can be left out of a step

    def __init__(self, model: mujoco.MjModel, derived: tuple[str, ...] = (), pushed: Sequence[int] = ()):
        unknown = set(derived) - set(DERIVED)
        if unknown:
            raise EngineError(
                f"an engine cannot derive {', '.join(sorted(unknown))}; it can derive {', '.join(DERIVED)}"
            )
        self.model = model
        self.derived = derived
        self.pushed = tuple(pushed)

    # Engine-specific --------------------------------------------------------------------------------------------------

    @abstractmethod
    def _carry(self, qpos: Array, qvel: Array, ctrl: Array, warmstart: Array, act: Array) -> Any:
        """Make the engine's own part of a state: (qpos, qvel, ctrl), warm start and activations."""

    @abstractmethod
    def _warm(self, carry: Any) -> tuple[Array, Array]:
        """Return warm start (nv,) and activations (na,) from the engine's own part."""

    @abstractmethod
    def _substeps(self, physics: Physics, ctrl: Array, n: int) -> Physics:
        """Advance by `n` substeps under constant controls; derived fields may lag."""

    @abstractmethod
    def _place(self, carry: Any, qpos: Array, qvel: Array, where: Array) -> Any:
        """Make the engine's own state agree with (qpos, qvel); where `where` holds, also clear the old episode."""

    @abstractmethod
    def _derive(self, physics: Physics) -> Physics:
        """Fill the derived fields from (qpos, qvel, ctrl)."""

    def _repeat(self, substep: Callable[[Physics], Physics], physics: Physics, n: int) -> Physics:
        """Return the world after a function of it was applied `n` times."""
        for _ in range(n):
            physics = substep(physics)
        return physics

    # The verbs -------------------------------------------------------------------------------------------------------

    def make(self, qpos: Array, qvel: Array, model: Mapping[str, Array] | None = None) -> Physics:
        """Make a new world at (qpos (nq,), qvel (nv,)), at time 0, with zero controls and model fields of its own."""
        m = self.model
        carry = self._carry(qpos, qvel, jnp.zeros(m.nu), jnp.zeros(m.nv), jnp.zeros(m.na))
        own = self._fields(model or {})
        push = jnp.zeros((len(self.pushed), 6)) if self.pushed else None
        zeros = jnp.zeros(m.nu), jnp.zeros(())
        return self._derive(Physics(qpos, qvel, *zeros, no_cause(), carry, model=own, push=push, resting=self._awake()))

    def compile_ahead(self) -> None:
        """Start to compile, in threads, what the first step needs; loads nothing, and the engine may be used."""
        return

    def compile(self) -> None:
        """Compile what the first step needs into a cache for later processes; load nothing. Raises what fails."""
        return

    def prepare(self) -> Callable[[], None]:
        """Start slow preparations of the first step in threads, and return a function that waits for them.

        Until that function returns, the engine must not be used.
        """
        return lambda: None

    def step_many(
        self, physics: Physics, command: Array, n_substeps: int, law: Law | None, hold: int
    ) -> StepResult | None:
        """Return the next `hold` control steps under one command, stacked; None if the engine cannot compute them at
        once.
        """
        return None

    def step(
        self,
        physics: Physics,
        command: Array,
        n_substeps: int,
        law: Law | None = None,
        result: StepResult | None = None,
    ) -> Physics:
        """Advance one world by a control step: `n_substeps` timesteps under `command` (nu,) through `law`.

        `result` is this control step's part of `step_many`; the engine then only computes derived fields.
        """
        start = physics.time
        if result is None:
            result = jax.tree.map(lambda x: x[0], self.step_many(physics, command, n_substeps, law, 1))
        if result is not None:
            physics = result.applied_to(physics)
        elif law is None:
            physics = self._substeps(physics, command, n_substeps)
        else:
            physics = self._repeat(
                lambda world: self._substeps(world, law(world.qpos, world.qvel, command), 1), physics, n_substeps
            )
        bad = ~jnp.all(is_finite(physics.qpos, physics.qvel))
        # Count whole timesteps: a float32 sum of them is off by a control step after two minutes.
        timestep = self.model.opt.timestep
        time = (jnp.round(start / timestep) + n_substeps) * timestep
        return self._derive(physics._replace(time=time, causes=physics.causes | cause_bit(bad, Cause.NUMBERS)))

    def place(
        self, physics: Physics, qpos: Array, qvel: Array, where: Array, model: Mapping[str, Array] | None = None
    ) -> Physics:
        """Put the world at (qpos, qvel), with these model fields, where `where` () bool; elsewhere nothing changes.

        Nothing pushes it. Fields that `model` does not name stay.
        """
        qpos = jnp.where(where, qpos, physics.qpos)
        qvel = jnp.where(where, qvel, physics.qvel)
        own = physics.model | self._fields({} if model is None else model)
        return self._derive(
            physics._replace(
                qpos=qpos,
                qvel=qvel,
                ctrl=jnp.where(where, 0.0, physics.ctrl),
                time=jnp.where(where, 0.0, physics.time),
                causes=jnp.where(where, no_cause(), physics.causes),
                carry=self._place(physics.carry, qpos, qvel, where),
                model={name: jnp.where(where, new, physics.model[name]) for name, new in own.items()},
                push=None if physics.push is None else jnp.where(where, 0.0, physics.push),
                resting=None if physics.resting is None else physics.resting & ~where,
            )
        )

    def save(self, physics: Physics) -> dict[str, Array]:
        """Return everything that decides how this world continues, by name; names and shapes are the same on every
        engine.
        """
        warmstart, act = self._warm(physics.carry)
        neutral = {name: getattr(physics, name) for name in ("qpos", "qvel", "ctrl", "time", "causes")}
        own = {f"model/{name}": value for name, value in physics.model.items()}
        pushes = {} if physics.push is None else {"push": physics.push}
        return neutral | {"warmstart": warmstart, "act": act} | own | pushes

    def load(self, saved: Mapping[str, Array]) -> Physics:
        """Restore the world of `save`. On the same engine it continues bit for bit as the saved one."""
        qpos, qvel = saved["qpos"], saved["qvel"]
        carry = self._carry(qpos, qvel, saved["ctrl"], saved["warmstart"], saved["act"])
        own = {name.removeprefix("model/"): value for name, value in saved.items() if name.startswith("model/")}
        neutral = (qpos, qvel, saved["ctrl"], saved["time"], saved["causes"], carry)
        push, resting = saved.get("push"), self._awake()
        return self._derive(Physics(*neutral, model=self._fields(own), push=push, resting=resting))

    def rest(self, physics: Physics, where: Array) -> Physics:
        """Let a world rest in the next steps where `where` () bool, and move elsewhere. Results of others never change.

        An engine that computes all worlds alike moves them all.
        """
        return physics._replace(resting=where) if self.can_rest else physics

    def _awake(self) -> Array | None:
        """Return `Physics.resting` of a new world."""
        return jnp.zeros((), bool) if self.can_rest else None

    def _wrenches(self, push: Array | None) -> dict[str, Array]:
        """Return MuJoCo's `xfrc_applied` (nbody, 6) with these pushes (pushed, 6), by its name; {} without any."""
        if push is None:
            return {}
        return {"xfrc_applied": jnp.zeros((self.model.nbody, 6)).at[jnp.array(self.pushed)].set(push)}

    def _fields(self, model: Mapping[str, Array]) -> dict[str, Array]:
        """Check a world's own model fields and add those that follow from them. Raises EngineError for wrong names or
        shapes.
        """
        for name, value in model.items():
            if name not in VARIABLE and name != "body_subtreemass":
                raise EngineError(f"model field {name!r} cannot differ between worlds; {', '.join(VARIABLE)} can")
            shape = getattr(self.model, name).shape
            if jnp.shape(value) != shape:
                raise EngineError(f"model field {name} has shape {jnp.shape(value)}, not {shape} as the model's")
        own = {name: jnp.asarray(value, jnp.float32) for name, value in model.items()}
        if "body_mass" in own and "body_subtreemass" not in own:  # a saved world's has its last digit from its batch
            own["body_subtreemass"] = jnp.where(_subtrees(self.model), own["body_mass"], 0.0).sum(axis=1)
        return own


class StaticEngine(Engine):
    """The engine of worlds without moving bodies, such as matrix games: only time passes."""

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


def cause_bit(where: Array, cause: Cause) -> Array:
    """Return () uint8: the bit of a cause where `where` () bool, else 0."""
    return where.astype(jnp.uint8) * jnp.uint8(cause)


def no_cause() -> Array:
    """Return () uint8 0: no failure."""
    return jnp.zeros((), jnp.uint8)


def keep_apart_from_fusion(*values: Array) -> tuple[Array, ...]:
    """Return the same arrays behind an optimization barrier, so that a caller's scan may stack them.

    On a GPU (jax 0.11.2, Warp) XLA's dynamic-slice fusion copies an engine's call to the place where its output is
    stacked. The copy writes to other buffers than the ones that it updates: frames were all zeros and later states
    wrong by metres. On one H100 with 4,096 worlds the barrier costs training 0.2 %; a recorded match, whose calls no
    longer run twice, went from 3.29 to 2.07 s.
    """
    return jax.lax.optimization_barrier(values)


def is_finite(qpos: Array, qvel: Array) -> Array:
    """Return () bool: positions (n,) are finite, and velocities (m,) are finite and below MAX_SPEED."""
    return jnp.all(jnp.isfinite(qpos)) & jnp.all(jnp.abs(qvel) < MAX_SPEED)


def _subtrees(model: mujoco.MjModel) -> np.ndarray:
    """Return (nbody, nbody) bool: the second body is in the subtree of the first."""
    below = np.eye(model.nbody, dtype=bool)
    for body in range(model.nbody - 1, 0, -1):  # children have higher numbers than their parents
        below[model.body_parentid[body]] |= below[body]
    return below


def float_shape(*shape: int) -> jax.ShapeDtypeStruct:
    """Return the shape of an array of floats."""
    return jax.ShapeDtypeStruct(shape, jnp.float32)
