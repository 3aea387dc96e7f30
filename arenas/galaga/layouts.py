"""What Galaga's robots see, in words: which number stands where. Light; `sight.py` fills it in.

Slots "1v1" are HARL-A's observations of the game of one tank and one drone, "2v2" those of the game of two. Stages that
lead to a game have its slots, with zeros where nobody is.
"""

from collections.abc import Sequence
from typing import Literal

from arenas.about import Part, numbers

Slots = Literal["1v1", "2v2"]
NOTHING = "nothing: zeros"
CONSTANT = 2.0  # the last number of a drone's slots of the game of two, always

_OWN = {
    "minitank": (
        Part("joint speeds", 2, "rad/s", "arm, rotor: the targets just applied"),
        Part("aim", 4, "", "quaternion, w first: the shortest turn from the world's x to the way to the target"),
        Part("barrel", 4, "", "the same to where the barrel points"),
    ),
    "crazyflie": (
        Part("velocity", 3, "m/s", "in its own frame"),
        Part("rates", 3, "rad/s", "in its own frame"),
        Part("down", 3, "", "the way down, a unit vector in its own frame"),
        Part("goal", 3, "m", "where, in its own frame"),
    ),
}
_PAIRED = {
    "minitank": (
        Part("target", 3, "m", "where, in its base's frame"),
        Part("team-mate", 3, "m", "where, in its base's frame"),
        Part("other", 2, "m", "ahead and left of the second team-mate, of one alone again"),
    ),
    "crazyflie": (
        Part("team-mate", 3, "m", "where, in its own frame"),
        Part("other", 3, "m", "the second team-mate, of one alone again"),
        Part("distance", 1, "m", "from the field's centre on the ground, along the height too"),
        Part("constant", 1, "", f"{CONSTANT:g}, as HARL-A's"),
    ),
}
_MATES = ("team-mate", "other")
_RICH = {
    "minitank": (
        Part("position", 3, "m", "in the tank's frame"),
        Part("velocity", 3, "m/s", "in the tank's frame"),
        Part("alive", 1, "", "1, or 0 when it is out of the game"),
    ),
    "crazyflie": (
        Part("position", 3, "m", "of the barrel's pivot, in the drone's frame"),
        Part("barrel", 3, "", "where it points, a unit vector in the drone's frame"),
    ),
}
_ENEMY = {"minitank": "drone", "crazyflie": "tank"}


def size(kind: str, slots: Slots, enemies: int = 0, buffer: int = 0) -> int:
    """Numbers in the observation of a robot that sees all about so many `enemies` behind its slots."""
    tail = enemies * numbers(_RICH[kind])
    return numbers(_OWN[kind]) + (numbers(_PAIRED[kind]) if slots == "2v2" else 0) + max(buffer, tail)


def parts(kind: str, slots: Slots, mates: int = 0, enemies: int = 0, buffer: int = 0) -> tuple[Part, ...]:
    """A robot kind's observation in words, with so many team-mates; `enemies` as in `size`."""
    found: list[Part] = [*_OWN[kind]]
    if slots == "2v2":
        found += [
            each._replace(meaning=NOTHING) if each.name in _MATES and not mates else each for each in _PAIRED[kind]
        ]
    found += _of_enemies(kind, enemies)
    unused = buffer - enemies * numbers(_RICH[kind])
    return (*found, Part("buffer", unused, "", "zeros, for what later stages may show")) if unused > 0 else tuple(found)


def _of_enemies(kind: str, enemies: int) -> Sequence[Part]:
    names = [_ENEMY[kind]] if enemies == 1 else [f"{_ENEMY[kind]} {i}" for i in range(enemies)]
    return [part._replace(name=f"{name}'s {part.name}") for name in names for part in _RICH[kind]]
