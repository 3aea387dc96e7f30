"""Layout of Galaga's observations: order, size and description of their parts. Light; used by `observation.py`.

Slots "1v1" are HARL-A's observations of the game of one tank and one drone, "2v2" those of the game of two each. Stages
that lead to a game have its slots, with zeros for absent robots.
"""

from collections.abc import Sequence
from typing import Literal

from arenas.description import Part, total_size

Slots = Literal["1v1", "2v2"]
NOTHING = "unused: zeros"
CONSTANT = 2.0  # the last number of a drone's slots of the 2v2 game, always

_OWN = {
    "minitank": (
        Part("joint speeds", 2, "rad/s", "arm, rotor: the targets just applied"),
        Part("aim", 4, "", "quaternion, w first: the shortest rotation from the world's x to the target's direction"),
        Part("barrel", 4, "", "the same for the barrel's direction"),
    ),
    "crazyflie": (
        Part("velocity", 3, "m/s", "in its own frame"),
        Part("rates", 3, "rad/s", "in its own frame"),
        Part("down", 3, "", "the down direction, a unit vector in its own frame"),
        Part("goal", 3, "m", "position in its own frame"),
    ),
}
_PAIRED = {
    "minitank": (
        Part("target", 3, "m", "position in its base's frame"),
        Part("team-mate", 3, "m", "position in its base's frame"),
        Part("other", 2, "m", "the second team-mate, ahead and left; repeats a single one"),
    ),
    "crazyflie": (
        Part("team-mate", 3, "m", "position in its own frame"),
        Part("other", 3, "m", "the second team-mate; repeats a single one"),
        Part("distance", 1, "m", "from the field's centre on the ground, including height"),
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
        Part("barrel", 3, "", "its direction, a unit vector in the drone's frame"),
    ),
}
_ENEMY = {"minitank": "drone", "crazyflie": "tank"}


def size(kind: str, slots: Slots, enemies: int = 0, buffer: int = 0) -> int:
    """Return the size of the observation of a robot that also fully observes so many `enemies`."""
    tail = enemies * total_size(_RICH[kind])
    return total_size(_OWN[kind]) + (total_size(_PAIRED[kind]) if slots == "2v2" else 0) + max(buffer, tail)


def parts(kind: str, slots: Slots, mates: int = 0, enemies: int = 0, buffer: int = 0) -> tuple[Part, ...]:
    """Describe a robot kind's observation, with so many team-mates; `enemies` as in `size`."""
    found: list[Part] = [*_OWN[kind]]
    if slots == "2v2":
        found += [
            each._replace(meaning=NOTHING) if each.name in _MATES and not mates else each for each in _PAIRED[kind]
        ]
    found += _of_enemies(kind, enemies)
    unused = buffer - enemies * total_size(_RICH[kind])
    return (*found, Part("buffer", unused, "", "zeros, reserved for later stages")) if unused > 0 else tuple(found)


def _of_enemies(kind: str, enemies: int) -> Sequence[Part]:
    names = [_ENEMY[kind]] if enemies == 1 else [f"{_ENEMY[kind]} {i}" for i in range(enemies)]
    return [part._replace(name=f"{name}'s {part.name}") for name in names for part in _RICH[kind]]
