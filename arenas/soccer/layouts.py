"""What soccer's robots see, in words: which number stands where. Light; `sight.py` fills it in."""

from collections.abc import Sequence

from arenas.about import Part

VECTORS = 7  # of three numbers each: ball, its velocity, two goals, a team-mate, two enemies
BEGINNING = {"anymal": 45, "leatherback": 3}  # numbers before them: what it feels of itself; a rover's velocity alone
MATES, ENEMIES = 1, 2  # who of them has a place of his own
NOTHING = "nothing: zeros"
GOAL_HEIGHT = 0.05  # m above the ground, where HARL-A has the goals


def size(kind: str, extra: int = 0, buffer: int = 0) -> int:
    """Numbers in the observation of a robot that sees `extra` robots more than have places."""
    return BEGINNING[kind] + 3 * VECTORS + max(buffer, 3 * extra)


def extra(own: int, other: int) -> int:
    """How many robots have no place, in the eyes of one of a team of `own` against one of `other`."""
    return max(0, own - 1 - MATES) + max(0, other - ENEMIES)


def parts(kind: str, felt: Sequence[Part], seen: Sequence[str], buffer: int = 0) -> tuple[Part, ...]:
    """A robot kind's observation in words. It feels `felt`; `seen` says what the vectors and then the tail show.

    What is "" is zeros.
    """
    named = ("ball", "ball's velocity", "target goal", "own goal", "team-mate", "enemy 0", "enemy 1")
    units = ("m", "m/s", *["m"] * len(seen))
    begins = felt if kind == "anymal" else (Part("velocity", 3, "m/s", "in its own frame"),)
    names = [*named, *(f"tail {i}" for i in range(len(seen) - VECTORS))]
    rest = [Part(name, 3, unit, what or NOTHING) for name, unit, what in zip(names, units, seen, strict=False)]
    unused = buffer - 3 * (len(seen) - VECTORS)
    ends = (Part("buffer", unused, "", "zeros, for what later stages may show"),) if unused > 0 else ()
    return (*begins, *rest, *ends)
