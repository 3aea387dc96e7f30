"""MuJoCo XLA: the engine of accelerators, in JAX or in Warp kernels."""

import copy
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import jax
import jax.numpy as jnp
import mujoco
from jax import Array
from mujoco import mjx

from arenas.arena_settings import Solver
from arenas.physics.engine import DYNAMICS, Engine, Physics, keep_apart_from_fusion, no_cause
from arenas.physics.void_causes import Cause

if TYPE_CHECKING:
    from arenas.physics.kernels.preparation import Preparation

# Warp's overflow bits for dropped contacts or rows, by cause: NEFC and NJMAX_NNZ; BROADPHASE; NARROWPHASE and CCD,
# whose convex pairs have as many slots as the contact pool; HFIELD, CONTACT_MATCH, NVMAX and EPA_HORIZON. Higher bits
# only report that the solver used all its iterations, which happens sometimes in single precision (1.4 of 1,000
# decisions of pushers); the C engine does not stop for that either.
OVERFLOW_BITS = {Cause.ROWS: 0x003, Cause.PAIRS: 0x004, Cause.CONTACTS: 0x018, Cause.BUFFERS: 0x1E0}


class MjxEngine(Engine):
    """MuJoCo XLA. `worlds`, the maximum number stepped together, sizes Warp's contact pool."""

    def __init__(
        self,
        model: mujoco.MjModel,
        derived: tuple[str, ...] = (),
        pushed: Sequence[int] = (),
        *,
        impl: Literal["jax", "warp"],
        worlds: int = 1,
        buffers: Solver | None = None,
    ):
        super().__init__(model, derived, pushed)
        self.buffers, self.worlds = buffers or Solver(), worlds
        self.name = impl
        self._stepped = _with_box_collider(model) if impl == "warp" else model
        self._mjx = mjx.put_model(self._stepped, impl=impl)
        self._buffers: dict[str, int] = {}
        if impl == "warp":
            from arenas.physics.warp_streams import keep_external_streams  # Warp is an optional dependency

            keep_external_streams()
            # One contact pool serves all worlds. Overflow is read below and voids the episode, so it need not be
            # printed.
            self._mjx = self._mjx.tree_replace({"opt._impl.warn_overflow": 0})
            self._buffers = {"naconmax": self.buffers.slots(worlds), "njmax": self.buffers.rows}
            self._of_one = {"contacts": self.buffers.contacts, "rows": self.buffers.rows}

    def compile_ahead(self) -> None:
        """Start to compile Warp's kernels."""
        if self.name == "warp":
            self._kernels.start_compiling()

    def compile(self) -> None:
        """Compile Warp's kernels into its cache."""
        if self.name == "warp":
            self._kernels.compile()

    def prepare(self) -> Callable[[], None]:
        """Start to load Warp's kernels."""
        return self._kernels.start_loading() if self.name == "warp" else super().prepare()

    @cached_property
    def _kernels(self) -> "Preparation":
        from arenas.physics.kernels.preparation import Preparation  # Warp is an optional dependency

        return Preparation(self._stepped, ["step", *self._refresh], **self._of_one)

    @property
    def _refresh(self) -> list[str]:
        """The function of MJX and Warp that fills the derived fields; empty if there are none."""
        if not self.derived:
            return []
        return ["forward" if set(self.derived) & set(DYNAMICS) else "kinematics"]

    def _carry(self, qpos: Array, qvel: Array, ctrl: Array, warmstart: Array, act: Array) -> Any:
        data = mjx.make_data(self.model, impl=self.name, **self._buffers)
        return data.replace(qpos=qpos, qvel=qvel, ctrl=ctrl, qacc_warmstart=warmstart, act=act)

    def _warm(self, carry: Any) -> tuple[Array, Array]:
        return carry.qacc_warmstart, carry.act

    def _own(self, physics: Physics) -> mjx.Model:
        """Return the model with this world's own fields."""
        return self._mjx.replace(**physics.model) if physics.model else self._mjx

    def _substeps(self, physics: Physics, ctrl: Array, n: int) -> Physics:
        model, data = self._own(physics), physics.carry.replace(ctrl=ctrl, **self._wrenches(physics.push))

        def substep(world: Physics) -> Physics:
            data = mjx.step(model, world.carry)
            if self.name == "warp":
                world = world._replace(causes=world.causes | overflow_causes(data._impl.overflow))
            return world._replace(carry=data)

        physics = self._repeat(substep, physics._replace(carry=data), n)
        qpos, qvel = keep_apart_from_fusion(physics.carry.qpos, physics.carry.qvel)
        return physics._replace(qpos=qpos, qvel=qvel, ctrl=ctrl)

    def _repeat(self, substep: Callable[[Physics], Physics], physics: Physics, n: int) -> Physics:
        """Return the world after `n` substeps. On a CPU XLA loops over them, and so compiles MJX's step only once.

        Steps of Warp are calls, of which XLA compiles nothing. On a GPU the speed of the loop is not measured.
        """
        if self.name == "warp" or n == 1 or jax.default_backend() != "cpu":
            return super()._repeat(substep, physics, n)
        return jax.lax.fori_loop(0, n, lambda _, world: substep(world), physics)

    def _place(self, carry: Any, qpos: Array, qvel: Array, where: Array) -> Any:
        if self.name == "warp":  # Warp never clears overflow bits itself
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
        if not self._refresh:
            return physics
        pushed = physics.carry.replace(**self._wrenches(physics.push))
        data = getattr(mjx, *self._refresh)(self._own(physics), pushed)
        values = keep_apart_from_fusion(*(getattr(data, name) for name in self.derived))
        return physics._replace(carry=data, **dict(zip(self.derived, values, strict=True)))


def overflow_causes(overflow: Array) -> Array:
    """Convert Warp's overflow bits of a world to () uint8, bits of arenas.physics.void_causes."""
    found = no_cause()
    for cause, mask in OVERFLOW_BITS.items():
        found |= jnp.any(overflow & mask != 0).astype(jnp.uint8) * jnp.uint8(cause)
    return found


def _with_box_collider(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return the model for Warp with box-box collisions by the function for boxes, as in C.

    The flag has no other effect there (mujoco_warp's `collision_driver`): without it two boxes collide as any two
    convex bodies.
    """
    model = copy.copy(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_NATIVECCD
    return model
