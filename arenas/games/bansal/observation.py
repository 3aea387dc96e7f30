"""The observation in Bansal et al.'s games.

`forward` is the direction that a body faces at the start: +x of place 0, -x of place 1. Both therefore see the same in
the same situation, and a game whose roles differ adds a number for the role.
"""

import jax.numpy as jnp
from jax import Array

from arenas.description import Part, total_size
from arenas.games.bansal.settings import OPPONENT, OWN, TIME
from arenas.robots.robot import Body, Robot
from arenas.robots.rotations import into_body


class ObservationBuilder:
    """Builds the observation of a body; the game adds `extra` numbers."""

    def __init__(self, robot: Robot, sides: tuple[str, str], extra: int):
        self.robot, self.sides = robot, sides
        joints = len(robot.joints)
        self.size = OWN + robot.proprioception_size + OPPONENT + joints + extra + TIME
        self._home = jnp.asarray(robot.rest or [0.0] * joints, jnp.float32)

    def parts(self, extra: tuple[Part, ...]) -> tuple[Part, ...]:
        """Describe the observation, with the game's own parts."""
        return (
            Part("place", 3, "m", "forward and left from the middle, and up"),
            Part("ahead", 3, "", "its own axis: forward, left, up"),
            *self.robot.sensed_parts,
            Part("opponent place", 3, "m", "from its own base, in its own frame", opponent=True),
            Part("opponent ahead", 3, "", "the opponent's axis in its own frame", opponent=True),
            Part("opponent up", 3, "", "the opponent's axis in its own frame", opponent=True),
            Part("opponent velocity", 3, "m/s", "in its own frame", opponent=True),
            Part("opponent joints", len(self.robot.joints), "rad", "less the standing pose", opponent=True),
            *extra,
            Part("time left", TIME, "", "share of the longest episode"),
        )

    def at(self, name: str) -> slice:
        """Return the place of a part that all these games have, for scripts."""
        parts = self.parts(())
        index = [part.name for part in parts].index(name)
        first = total_size(parts[:index])
        return slice(first, first + parts[index].size)

    def observe(self, own: Body, other: Body, place: Array, extra: Array, left: Array) -> Array:
        """Return the observation (size,) of a body at `place` () 0 or 1 with `left` () share of the time."""
        turn = jnp.stack([1.0 - 2.0 * place, 1.0 - 2.0 * place, jnp.ones(())])  # half a turn about z at place 1
        quat, theirs = own.pose[3:], other.pose[3:]
        return jnp.concatenate([
            turn * own.pose[:3],
            turn * axis(quat, 0),
            self.robot.observe_self(own),
            into_body(quat, other.pose[:3] - own.pose[:3]),
            into_body(quat, axis(theirs, 0)),
            into_body(quat, axis(theirs, 2)),
            into_body(quat, other.velocity[:3]),
            other.angles - self._home,
            extra,
            left[None],
        ])  # fmt: skip


def axis(quat: Array, which: int) -> Array:
    """Return an axis (3,) of the body with this quaternion (4,), w first, in the world: 0 ahead, 2 up."""
    unit = jnp.zeros(3).at[which].set(1.0)
    return into_body(quat * jnp.array([1.0, -1.0, -1.0, -1.0]), unit)
