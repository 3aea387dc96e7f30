"""Domain randomisation: properties of bodies that are drawn anew for each robot and episode.

Light, as all settings: jax is loaded only for a draw. HARL-A runs in Isaac Lab, which draws once per environment at
start-up. Here every episode has its own bodies, on every engine.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from arenas.errors import ArenaError

if TYPE_CHECKING:
    from jax import Array

    from arenas.scene.scene import Scene


@dataclass(frozen=True)
class Randomisation:
    """Random differences between episodes in the robots' bodies. The default has none and costs nothing."""

    friction: tuple[float, ...] = field(default=(), metadata={"above": 0.0, "high": 10.0})
    """Factor on the sliding friction of all of a robot's shapes, [low, high] (HARL-A: [0.6, 0.8]); [] is none."""
    base_mass: tuple[float, ...] = ()
    """kg added to a robot's base, whose inertia grows in proportion, [low, high] (HARL-A's ANYmals: [-5, 5]); [] is
    none."""

    def __post_init__(self) -> None:
        """Check that each range is valid."""
        for name, interval in (("friction", self.friction), ("base_mass", self.base_mass)):
            if interval and not (len(interval) == 2 and interval[0] <= interval[1]):
                raise ValueError(f"{name}: {list(interval)} must be [] or two numbers, lowest and highest")

    def check(self, scene: "Scene") -> None:
        """Raise ArenaError if the base of a robot in the scene could end up without mass."""
        for agent, at in scene.agents.items():
            mass = float(scene.model.body_mass[at.base])
            if self.base_mass and self.base_mass[0] <= -mass:
                raise ArenaError(
                    f"randomisation.base_mass = {list(self.base_mass)}: the base of {agent} weighs {mass:.3g} kg;"
                    f" the lowest must be above {-mass:.3g}"
                )

    def draw(self, key: "Array", scene: "Scene") -> "dict[str, Array]":
        """Draw model fields of one world for `Arena.randomise`: a number per robot and field, shaped as the model's."""
        import jax
        import jax.numpy as jnp

        model, bases = scene.model, [at.base for at in scene.agents.values()]
        friction_key, mass_key = jax.random.split(key)
        fields: dict[str, Array] = {}
        if self.friction:
            drawn = jax.random.uniform(friction_key, (len(bases),), minval=self.friction[0], maxval=self.friction[1])
            factor = jnp.ones(model.nbody).at[jnp.array(bases)].set(drawn)
            of_geoms = factor[model.body_rootid[model.geom_bodyid]]  # geoms of no robot have no such base as their root
            fields["geom_friction"] = jnp.asarray(model.geom_friction, jnp.float32).at[:, 0].multiply(of_geoms)
        if self.base_mass:
            drawn = jax.random.uniform(mass_key, (len(bases),), minval=self.base_mass[0], maxval=self.base_mass[1])
            before = jnp.asarray(model.body_mass[bases], jnp.float32)
            grown = jnp.ones(model.nbody).at[jnp.array(bases)].set(1.0 + drawn / before)
            fields["body_mass"] = jnp.asarray(model.body_mass, jnp.float32) * grown
            fields["body_inertia"] = jnp.asarray(model.body_inertia, jnp.float32) * grown[:, None]
        return fields


HARL_A = Randomisation(friction=(0.6, 0.8), base_mass=(-5.0, 5.0))
"""HARL-A's values for ANYmals in stages 1 and 2: static friction 0.8, dynamic 0.6, on a ground of 1.0."""
