"""What every robot tells the arenas about itself: all that is its own, so that a game need not know its kind."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from arenas.about import Part

if TYPE_CHECKING:
    import mujoco

Colour = tuple[float, float, float, float]
MOTION = (  # what several robots feel first, in words
    Part("velocity", 3, "m/s", "in its own frame"),
    Part("rates", 3, "rad/s", "in its own frame"),
    Part("down", 3, "", "the way down, a unit vector in its own frame"),
)
Script = Callable[[Array, Array], Array]  # (observation (obs,), key) -> action (act,)
# A robot's actuation law: (joint angles (joints,), joint speeds (joints,), command (actuators,)) -> ctrl (actuators,).
# One that also takes NumPy's arrays of many worlds (worlds, joints), ... is applied by the C engine without JAX.
JointLaw = Callable[[Any, Any, Any], Any]


class Body(NamedTuple):
    """One robot as it feels itself, read from qpos and qvel: nothing here lags behind."""

    pose: Array  # (7,) base in the world: x, y, z in metres, quaternion w first
    velocity: Array  # (6,) linear in the world frame, m/s; angular in the base's frame, rad/s
    angles: Array  # (joints,) rad or m, in the robot's own order
    speeds: Array  # (joints,) rad/s or m/s
    action: Array  # (action_size,) the last one


def as_it_is(action: Array) -> Array:
    """The command of a robot whose actuators take its action unchanged."""
    return action


def never(pose: Array) -> Array:
    """The fall rule of what cannot fall."""
    return jnp.zeros((), bool)


def nothing(action_size: int) -> Script:
    """The script `idle`: the zero action, always."""
    return lambda observation, key: jnp.zeros(action_size)


def anything(action_size: int) -> Script:
    """The script `random`: every decision a fresh action, uniform within ±1."""
    return lambda observation, key: jax.random.uniform(key, (action_size,), minval=-1.0, maxval=1.0)


@dataclass(frozen=True)
class Robot:
    """A body, its drives and what an action means. Names are the MJCF's, without the agent's prefix.

    A game composes the parts of its robots and asks for no kind. What is left out costs nothing: a robot without `law`
    is stepped without one, one without `build` has no body at all and only chooses (a player of a matrix game).
    """

    kind: str
    action_size: int
    build: Callable[[Colour], "mujoco.MjSpec"] | None = None  # colour -> one body under the world
    base: str = ""  # the body with the free joint
    joints: tuple[str, ...] = ()  # driven joints, in the order of observations
    actuators: tuple[str, ...] = ()
    rest_height: float = 0.0  # m, base origin above the ground when standing
    rest: tuple[float, ...] = ()  # (joints,) angles when standing; empty: all zero
    limp: tuple[float, ...] = ()  # (action_size,) the action of one that is out of the game; empty: all zero
    command: Callable[[Array], Array] = as_it_is  # action (action_size,) -> command (actuators,)
    law: JointLaw | None = None  # applied before every physics substep; None is the identity
    proprioception: Callable[[Body], Array] | None = None  # what it feels of itself, (n,)
    fallen: Callable[[Array], Array] = never  # base pose (7,) -> () bool
    scripts: Mapping[str, Script] = field(default_factory=dict)  # those that need no game: idle, random, ...
    proprioception_parts: tuple[Part, ...] = ()  # what the numbers that it feels are; empty: they have no names
    action_parts: tuple[Part, ...] = ()  # what the numbers of its action do; empty: they have no names

    def __post_init__(self) -> None:
        """A rest pose is of all joints or of none, a limp action of all numbers or of none."""
        if self.rest and len(self.rest) != len(self.joints):
            raise ValueError(f"robot {self.kind}: rest has {len(self.rest)} angles for {len(self.joints)} joints")
        if self.limp and len(self.limp) != self.action_size:
            raise ValueError(
                f"robot {self.kind}: limp has {len(self.limp)} numbers for {self.action_size} of an action"
            )

    @cached_property
    def feeling(self) -> int:
        """Numbers in its proprioception."""
        if self.proprioception is None:
            return 0
        sizes = (7, 6, len(self.joints), len(self.joints), self.action_size)
        return jax.eval_shape(self.proprioception, Body(*(jnp.zeros(size) for size in sizes))).shape[0]

    @property
    def felt(self) -> tuple[Part, ...]:
        """Its proprioception in words, in one nameless piece where it has no names."""
        nameless = (Part("proprioception", self.feeling),) if self.feeling else ()
        return self.proprioception_parts or nameless

    def feels(self, body: Body) -> Array:
        """Its proprioception (feeling,); none is (0,)."""
        return jnp.zeros(0) if self.proprioception is None else self.proprioception(body)
