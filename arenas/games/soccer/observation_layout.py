"""Layout of soccer's observations: order, size and description of their parts. Light; used by `observation.py`."""

from collections.abc import Sequence

from arenas.description import Part
from arenas.games.sumo.observation_layout import ENEMY
from arenas.robots.kinds import kind_of

VECTORS = 7  # of three numbers each: ball, its velocity, two goals, a team-mate, two enemies
OWN_SIZE = {"anymal": 45, "leatherback": 3}  # numbers before them: proprioception; for a rover velocity alone
MATES, ENEMIES = 1, 2  # robots of each group with a vector of their own
NOTHING = "unused: zeros"
GOAL_HEIGHT = 0.05  # m above the ground, as HARL-A's goals


def own_size(kind: str) -> int:
    """Return how many numbers of a kind's observation come before the vectors; of robots from files too."""
    return OWN_SIZE[kind] if kind in OWN_SIZE else kind_of(kind).proprioception_size


def size(own: int, extra: int = 0, buffer: int = 0) -> int:
    """Return the size of the observation of a robot with `own` numbers before the vectors, that observes `extra`
    robots more than have vectors.
    """
    return own + 3 * VECTORS + max(buffer, 3 * extra)


def agents_without_vector(own: int, other: int) -> int:
    """Return the number of robots without a vector, for an agent of a team of `own` robots against `other`."""
    return max(0, own - 1 - MATES) + max(0, other - ENEMIES)


def feels_joints(kind: str) -> bool:
    """Return whether a kind's observation begins with all of its proprioception; a rover's with its velocity alone."""
    return kind != "leatherback"


def parts(kind: str, proprioception: Sequence[Part], seen: Sequence[str], buffer: int = 0) -> tuple[Part, ...]:
    """Describe a robot kind's observation with this proprioception; `seen` describes the vectors and then the
    tail.

    An empty description means zeros.
    """
    named = ("ball", "ball's velocity", "target goal", "own goal", "team-mate", "enemy 0", "enemy 1")
    units = ("m", "m/s", *["m"] * len(seen))
    begins = proprioception if feels_joints(kind) else (Part("velocity", 3, "m/s", "in its own frame"),)
    names = [*named, *(f"tail {i}" for i in range(len(seen) - VECTORS))]
    rest = [
        Part(name, 3, unit, what or NOTHING, opponent=what.startswith(ENEMY))
        for name, unit, what in zip(names, units, seen, strict=False)
    ]
    unused = buffer - 3 * (len(seen) - VECTORS)
    ends = (Part("buffer", unused, "", "zeros, reserved for later stages"),) if unused > 0 else ()
    return (*begins, *rest, *ends)
