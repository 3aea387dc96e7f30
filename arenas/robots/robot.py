"""Robots as values: all properties of a robot, so that a game need not know its kind."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.description import Part

if TYPE_CHECKING:
    import mujoco

Colour = tuple[float, float, float, float]
MOTION = (  # proprioception that several robots begin with
    Part("velocity", 3, "m/s", "in its own frame"),
    Part("rates", 3, "rad/s", "in its own frame"),
    Part("down", 3, "", "the down direction, a unit vector in its own frame"),
)
Script = Callable[[Array, Array], Array]  # (observation (obs,), key) -> action (act,)
# A robot's actuation law: (joint angles (joints,), joint speeds (joints,), command (actuators,)) -> ctrl (actuators,).
# The C engine applies a law without JAX if the law also accepts NumPy arrays of many worlds (worlds, joints), ...
JointLaw = Callable[[Any, Any, Any], Any]
Bounds = tuple[float, float] | tuple[str, ...]  # the lowest and the highest of a number, or the names of a choice


class Body(NamedTuple):
    """The state of one robot for its own sensing, read from qpos and qvel without delay."""

    pose: Array  # (7,) base in the world: x, y, z in metres, quaternion w first
    velocity: Array  # (6,) linear in the world frame, m/s; angular in the base's frame, rad/s
    angles: Array  # (joints,) rad or m, in the robot's own order
    speeds: Array  # (joints,) rad/s or m/s
    action: Array  # (action_size,) the latest action


class Push(NamedTuple):
    """Forces from outside on bodies of any team, by which a robot acts, with or without a body of its own."""

    bodies: tuple[str, ...]  # as the scene names them, such as blue/0/torso
    wrench: Callable[[Array], Array]  # action (action_size,) -> (bodies, 6) N in the world, then N·m


def is_choice(bounds: Bounds) -> bool:
    """Return whether something to be set is one of several names, and no number."""
    return isinstance(bounds[0], str)


def identity_command(action: Array) -> Array:
    """Return the action as the command, for robots whose actuators take it unchanged."""
    return action


def never_falls(pose: Array) -> Array:
    """Return () bool False: the fall rule of a robot that cannot fall."""
    return jnp.zeros((), bool)


def idle_script(action_size: int) -> Script:
    """Make the script `idle`, which always returns the zero action."""
    return lambda observation, key: jnp.zeros(action_size)


def random_script(action_size: int) -> Script:
    """Make the script `random`, which draws a new action in every decision, uniform within ±1."""
    return lambda observation, key: jax.random.uniform(key, (action_size,), minval=-1.0, maxval=1.0)


nothing, anything = idle_script, random_script  # former names, kept for one release


@dataclass(frozen=True)
class Robot:
    """A body, its drives and the meaning of its action. Names are the MJCF's, without the agent's prefix.

    A game combines the parts of its robots and never asks for a robot's kind. Omitted parts cost nothing: a robot
    without `law` is stepped without one, a robot without `build` has no body and only chooses (a player of a matrix
    game).
    """

    kind: str
    action_size: int
    build: Callable[[Colour], "mujoco.MjSpec"] | None = None  # colour -> one body under the world
    base: str = ""  # the body with the free joint
    joints: tuple[str, ...] = ()  # driven joints, in the order of observations
    actuators: tuple[str, ...] = ()
    rest_height: float = 0.0  # m, base origin above the ground when standing
    rest: tuple[float, ...] = ()  # (joints,) angles when standing; empty: all zero
    limp: tuple[float, ...] = ()  # (action_size,) the action of a robot that is out of the game; empty: all zero
    command: Callable[[Array], Array] = identity_command  # action (action_size,) -> command (actuators,)
    law: JointLaw | None = None  # applied before every physics substep; None is the identity
    push: Push | None = None  # its forces on bodies, held for a decision; None: it pushes nothing from outside
    sets: Mapping[str, Bounds] = field(default_factory=dict)  # what its first action sets
    proprioception: Callable[[Body], Array] | None = None  # sensing of itself, (n,)
    fallen: Callable[[Array], Array] = never_falls  # base pose (7,) -> () bool
    scripts: Mapping[str, Script] = field(default_factory=dict)  # scripts that need no game: idle, random, ...
    proprioception_parts: tuple[Part, ...] = ()  # description of proprioception; empty: its numbers have no names
    action_parts: tuple[Part, ...] = ()  # description of the action; empty: its numbers have no names
    drive: Callable[[Array, bool], Array] | None = None  # position (2,) ahead and left, stop there? -> action
    radius: float = 0.0  # m, of the circle that it covers, for scripts that pass by; 0: not known
    feet: tuple[str, ...] = ()  # bodies that it walks on
    torques: JointLaw | None = None  # torques of its motors under a ctrl; None: ctrl is the torques
    ls_iterations: int = 0  # line-search steps that the solver takes at least in its scenes; 0: those of the arena
    identity: str = ""  # settings outside the code and the model that decide how it moves; for configuration hashes

    def __post_init__(self) -> None:
        """Check that `rest` covers all joints or none, and `limp` the whole action or none of it."""
        if self.rest and len(self.rest) != len(self.joints):
            raise ValueError(f"robot {self.kind}: rest has {len(self.rest)} angles for {len(self.joints)} joints")
        if self.limp and len(self.limp) != self.action_size:
            raise ValueError(
                f"robot {self.kind}: limp has {len(self.limp)} numbers for {self.action_size} of an action"
            )

    @cached_property
    def proprioception_size(self) -> int:
        """The size of its proprioception."""
        if self.proprioception is None:
            return 0
        sizes = (7, 6, len(self.joints), len(self.joints), self.action_size)
        return jax.eval_shape(self.proprioception, Body(*(jnp.zeros(size) for size in sizes))).shape[0]

    @property
    def sensed_parts(self) -> tuple[Part, ...]:
        """The description of its proprioception; a single unnamed part if its numbers have no names."""
        nameless = (Part("proprioception", self.proprioception_size),) if self.proprioception_size else ()
        return self.proprioception_parts or nameless

    def designed(self, action: Array) -> Array:
        """Return the numbers (sets,) that an action (..., sets) sets: -1 the lowest, 1 the highest, clipped beyond.

        Of a choice it is the place of a name, from 0; each has an equal part of -1 to 1.
        """
        choice = np.array([is_choice(each) for each in self.sets.values()], bool)
        bounds = [(0, len(each)) if is_choice(each) else each for each in self.sets.values()]
        low, high = np.array(bounds, np.float32).reshape(-1, 2).T
        found = jnp.asarray(low) + (jnp.clip(action, -1.0, 1.0) + 1.0) / 2.0 * (high - low)
        return jnp.where(choice, jnp.clip(jnp.floor(found), 0.0, high - 1.0), found)

    def name_designed(self, numbers: Sequence[float] | np.ndarray) -> dict[str, float | str]:
        """Return what `designed` numbers (sets,) mean, by name: a number, or the name that was chosen."""
        pairs = zip(self.sets.items(), numbers, strict=True)
        return {name: each[int(x)] if is_choice(each) else float(x) for (name, each), x in pairs}

    def observe_self(self, body: Body) -> Array:
        """Return its proprioception (proprioception_size,); (0,) if it has none."""
        return jnp.zeros(0) if self.proprioception is None else self.proprioception(body)
