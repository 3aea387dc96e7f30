"""Layout of sumo's observations: order, size and description of their parts. Light; used by `paper_observation.py` and
`full_observation.py`.
"""

from collections.abc import Mapping, Sequence

from arenas.description import Part
from arenas.errors import ArenaError

# Slots ----------------------------------------------------------------------------------------------------------------

_ROVER = ("a", "b", "c", "distance", "velocity", "radius")
LAYOUTS: Mapping[str, tuple[str, ...]] = {
    "anymal": ("feeling", "a", "b", "c", "distance", "radius"),
    "leatherback": _ROVER,
    "minitank": _ROVER,
}
WIDTHS = {"feeling": 45, "a": 3, "b": 3, "c": 3, "distance": 1, "velocity": 3, "radius": 1}
NOTHING = "unused: zeros"
ENEMY = "enemy"  # how the names of robots of the other team begin


def layout(kind: str) -> tuple[str, ...]:
    """Return the parts of a robot kind's observation in order. Raises ArenaError for a kind without a layout."""
    if kind not in LAYOUTS:
        raise ArenaError(f'observation: "slots" is of {", ".join(LAYOUTS)}; for robots of kind {kind} use "rich"')
    return LAYOUTS[kind]


def size(kind: str, extra: int = 0, buffer: int = 0) -> int:
    """Return the size of the observation of a robot that sees `extra` robots more than it has slots for."""
    return sum(WIDTHS[part] for part in layout(kind)) + max(buffer, 3 * extra)


def first_index(kind: str, part: str) -> int:
    """Return the index at which a part begins."""
    parts = layout(kind)
    return sum(WIDTHS[each] for each in parts[: parts.index(part)])


def slot_parts(
    kind: str, proprioception: Sequence[Part], slots: Sequence[str], buffer: int = 0, ring: bool = True
) -> tuple[Part, ...]:
    """Describe a robot kind's observation with this proprioception; `slots` describes A, B, C and then the tail.

    A slot "" is empty. Without a `ring` there is no distance from the centre and no radius.
    """
    a, b, c, *further = (
        Part("", 3, "m", f"{what}: position in its own frame" if what else NOTHING, opponent=what.startswith(ENEMY))
        for what in slots
    )
    words = {
        "a": a._replace(name="slot A"),
        "b": b._replace(name="slot B"),
        "c": c._replace(name="slot C"),
        "distance": Part("distance", 1, "m", "from the ring's centre, including height" if ring else NOTHING),
        "velocity": Part("velocity", 3, "m/s", "in its own frame"),
        "radius": Part("radius", 1, "m", "of the ring, at present" if ring else NOTHING),
    }
    found = [part for name in layout(kind) for part in (proprioception if name == "feeling" else [words[name]])]
    found += [part._replace(name=f"tail {i}") for i, part in enumerate(further)]
    unused = buffer - 3 * len(further)
    return (*found, Part("buffer", unused, "", "zeros, reserved for later stages")) if unused > 0 else tuple(found)


# Rich -----------------------------------------------------------------------------------------------------------------

_OWN = (
    Part("velocity ahead, left", 2, "m/s", "in its own heading frame, as all that follows"),
    Part("yaw rate", 1, "rad/s"),
    Part("centre", 2, "radii", "vector to the ring's centre / its radius"),
    Part("margin", 1, "m", "radius less the distance from the centre"),
    Part("radius", 1, "m", "of the ring, at present"),
    Part("time", 1, "", "share of the match that has passed"),
    Part("up", 1, "", "up axis, world z: 1 upright, -1 on the back"),
)
_OTHER = (
    Part("position", 2, "m"),
    Part("bearing", 2, "", "its position as a unit vector"),
    Part("heading", 2, "", "relative, cosine and sine"),
    Part("velocity", 2, "m/s", "relative"),
    Part("margin", 1, "m", "its own to the edge"),
)
OWN, PER_OTHER = sum(part.size for part in _OWN), sum(part.size for part in _OTHER)


def full_parts(proprioception: Sequence[Part], other_names: Sequence[str]) -> tuple[Part, ...]:
    """Describe the full observation of a robot with this proprioception that observes these robots."""
    of_others = [
        part._replace(name=f"{other}'s {part.name}", opponent=other.startswith(ENEMY))
        for other in other_names
        for part in _OTHER
    ]
    return (*proprioception, *_OWN, *of_others)


def other_names(mates: int, enemies: int) -> list[str]:
    """Name the other robots, those of the own team first."""
    return [*_numbered("team-mate", mates), *_numbered(ENEMY, enemies)]


def _numbered(what: str, count: int) -> list[str]:
    return [what] if count == 1 else [f"{what} {i}" for i in range(count)]
