"""What sumo's robots see, in words: which number stands where. Light; `slots.py` and `rich.py` fill it in."""

from collections.abc import Mapping, Sequence

from arenas.about import Part
from arenas.errors import ArenaError

# Slots ----------------------------------------------------------------------------------------------------------------

_ROVER = ("a", "b", "c", "distance", "velocity", "radius")
LAYOUTS: Mapping[str, tuple[str, ...]] = {
    "anymal": ("feeling", "a", "b", "c", "distance", "radius"),
    "leatherback": _ROVER,
    "minitank": _ROVER,
}
WIDTHS = {"feeling": 45, "a": 3, "b": 3, "c": 3, "distance": 1, "velocity": 3, "radius": 1}
NOTHING = "nothing: zeros"


def layout(kind: str) -> tuple[str, ...]:
    """The parts of a robot kind's observation in their order; an ArenaError for a kind that has none."""
    if kind not in LAYOUTS:
        raise ArenaError(f'observation: "slots" is of {", ".join(LAYOUTS)}; for robots of kind {kind} use "rich"')
    return LAYOUTS[kind]


def size(kind: str, extra: int = 0, buffer: int = 0) -> int:
    """Numbers in the observation of a robot that sees `extra` robots more than it has slots for."""
    return sum(WIDTHS[part] for part in layout(kind)) + max(buffer, 3 * extra)


def first(kind: str, part: str) -> int:
    """The index at which a part begins."""
    parts = layout(kind)
    return sum(WIDTHS[each] for each in parts[: parts.index(part)])


def slot_parts(
    kind: str, felt: Sequence[Part], slots: Sequence[str], buffer: int = 0, ring: bool = True
) -> tuple[Part, ...]:
    """A robot kind's observation in words. It feels `felt`; `slots` says what is in A, B and C and then in the tail.

    A slot that is "" is empty. Without a `ring` there is no distance from the centre and no radius.
    """
    a, b, c, *further = (f"{what}: where, in its own frame" if what else NOTHING for what in slots)
    words = {
        "a": Part("slot A", 3, "m", a),
        "b": Part("slot B", 3, "m", b),
        "c": Part("slot C", 3, "m", c),
        "distance": Part("distance", 1, "m", "from the ring's centre, along the height too" if ring else NOTHING),
        "velocity": Part("velocity", 3, "m/s", "in its own frame"),
        "radius": Part("radius", 1, "m", "of the ring, now" if ring else NOTHING),
    }
    found = [part for name in layout(kind) for part in (felt if name == "feeling" else [words[name]])]
    found += [Part(f"tail {i}", 3, "m", what) for i, what in enumerate(further)]
    unused = buffer - 3 * len(further)
    return (*found, Part("buffer", unused, "", "zeros, for what later stages may show")) if unused > 0 else tuple(found)


# Rich -----------------------------------------------------------------------------------------------------------------

_OWN = (
    Part("velocity ahead, left", 2, "m/s", "as all that follows in its own heading frame"),
    Part("yaw rate", 1, "rad/s"),
    Part("centre", 2, "radii", "the way to the centre of the ring / its radius"),
    Part("margin", 1, "m", "radius less the distance from the centre"),
    Part("radius", 1, "m", "of the ring, now"),
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


def rich_parts(felt: Sequence[Part], others: Sequence[str]) -> tuple[Part, ...]:
    """The rich observation in words, of a robot that feels `felt` and sees these `others`."""
    of_others = [part._replace(name=f"{other}'s {part.name}") for other in others for part in _OTHER]
    return (*felt, *_OWN, *of_others)


def others(mates: int, enemies: int) -> list[str]:
    """What the other robots are called, those of the own team first."""
    return [*_numbered("team-mate", mates), *_numbered("enemy", enemies)]


def _numbered(what: str, count: int) -> list[str]:
    return [what] if count == 1 else [f"{what} {i}" for i in range(count)]
