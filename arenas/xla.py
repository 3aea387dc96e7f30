"""MuJoCo XLA: the engine of accelerators, in JAX or in Warp kernels."""

import copy
from collections.abc import Callable
from typing import Any, Literal

import jax.numpy as jnp
import mujoco
from jax import Array
from mujoco import mjx

from arenas.physics import DYNAMICS, Engine, Physics, stackable

# Warp's overflow bits that mean contacts or rows were dropped: OverflowType NEFC, NJMAX_NNZ, BROADPHASE, NARROWPHASE,
# CCD, HFIELD, CONTACT_MATCH, NVMAX, EPA_HORIZON. Those above only say that the solver used all its iterations, as it
# does now and then in single precision (1.4 of 1,000 decisions of pushers): the C engine does not stop for that either.
LOST = 0x1FF


class MjxEngine(Engine):
    """MuJoCo XLA. `worlds`, the most stepped together, sizes Warp's contact pool."""

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
        self._stepped = _boxes(model) if impl == "warp" else model
        self._mjx = mjx.put_model(self._stepped, impl=impl)
        self._buffers: dict[str, int] = {}
        if impl == "warp":
            # One contact pool serves all worlds; overflow is read below and voids the episode: no need to print it.
            self._mjx = self._mjx.tree_replace({"opt._impl.warn_overflow": 0})
            self._buffers = {"naconmax": contacts * worlds, "njmax": rows}
            self._of_one = {"contacts": contacts, "rows": rows}

    def prepare(self) -> Callable[[], None]:
        """Begin to load Warp's kernels."""
        if self.name != "warp":
            return super().prepare()
        from arenas import kernels  # Warp need not be installed where it does not step

        return kernels.begin(self._stepped, ["step", *self._refresh], **self._of_one)

    @property
    def _refresh(self) -> list[str]:
        """The verb of MJX, and of Warp, that fills the derived fields, where there are any."""
        if not self.derived:
            return []
        return ["forward" if set(self.derived) & set(DYNAMICS) else "kinematics"]

    def _carry(self, qpos: Array, qvel: Array, ctrl: Array, warmstart: Array, act: Array) -> Any:
        data = mjx.make_data(self.model, impl=self.name, **self._buffers)
        return data.replace(qpos=qpos, qvel=qvel, ctrl=ctrl, qacc_warmstart=warmstart, act=act)

    def _warm(self, carry: Any) -> tuple[Array, Array]:
        return carry.qacc_warmstart, carry.act

    def _own(self, physics: Physics) -> mjx.Model:
        """The model with this world's own fields."""
        return self._mjx.replace(**physics.model) if physics.model else self._mjx

    def _substeps(self, physics: Physics, ctrl: Array, n: int) -> Physics:
        model, data = self._own(physics), physics.carry.replace(ctrl=ctrl)
        overflow = jnp.zeros((), bool)
        for _ in range(n):
            data = mjx.step(model, data)
            if self.name == "warp":
                overflow |= jnp.any(data._impl.overflow & LOST != 0)
        qpos, qvel = stackable(data.qpos, data.qvel)
        return physics._replace(qpos=qpos, qvel=qvel, ctrl=ctrl, unstable=physics.unstable | overflow, carry=data)

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
        if not self._refresh:
            return physics
        data = getattr(mjx, *self._refresh)(self._own(physics), physics.carry)
        values = stackable(*(getattr(data, name) for name in self.derived))
        return physics._replace(carry=data, **dict(zip(self.derived, values, strict=True)))


def _boxes(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model for Warp, where two boxes meet by a function of their own, as they do in C.

    That is all this flag does there (mujoco_warp's `collision_driver`): without it they meet as any two convex bodies.
    """
    model = copy.copy(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_NATIVECCD
    return model
