"""Who is who in a match: a player keeps its colour on whichever side it plays, a side has a shape of its own."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from arenas.colours import TEAM_COLOURS
from storage.recording import RecordingHeader

Colour = tuple[int, int, int]

COLOURS: tuple[Colour, ...] = (
    (64, 132, 255), (255, 78, 66), (70, 190, 110), (240, 180, 50),
    (170, 110, 245), (50, 190, 205), (245, 120, 185), (170, 125, 85),
)  # fmt: skip
"""Red, green and blue by a player's number; a ninth player has those of the first."""
SHAPES = (("circle", 48), ("square", 4), ("triangle", 3), ("hexagon", 6))
"""What is drawn on the ground round the robots of each side, and how many corners it has."""


@dataclass(frozen=True)
class Performer:
    """Who plays a side."""

    name: str  # of the snapshot
    colour: Colour
    role: str = ""
    rating: str = ""  # as it was before the match, e.g. "1234 ± 56"

    @property
    def label(self) -> str:
        """What stands over each of its robots."""
        return " · ".join(filter(None, (self.name, self.rating.partition(" ±")[0], self.role)))


def strangers(header: RecordingHeader) -> tuple[Performer, ...]:
    """The sides of a recording of whose players nothing is known but their names: coloured by side."""
    return tuple(Performer(name, COLOURS[side % len(COLOURS)]) for side, name in enumerate(header.sides))


def told_apart(cast: Sequence[Performer], age: Sequence[float]) -> tuple[Performer, ...]:
    """The same performers, but of those with one colour all are paler than the one of the largest `age`.

    So a player that meets its own past is told from it by the shade, on whichever side either plays.
    """
    newest = {who.colour: max(a for a, other in zip(age, cast, strict=True) if other.colour == who.colour)
              for who in cast}  # fmt: skip
    kept: set[Colour] = set()
    found = []
    for who, a in zip(cast, age, strict=True):
        pale = a < newest[who.colour] or who.colour in kept
        kept.add(who.colour)
        found.append(replace(who, colour=_pale(who.colour)) if pale else who)
    return tuple(found)


def shape(side: int) -> tuple[str, int]:
    """The shape of a side: its name and its corners."""
    return SHAPES[side % len(SHAPES)]


def team_colour(side: int) -> tuple[float, ...]:
    """The colour that a side's things have in a recording's MJCF, red, green and blue from 0 to 1."""
    return TEAM_COLOURS[side % len(TEAM_COLOURS)][:3]


def _pale(colour: Colour) -> Colour:
    red, green, blue = (round(0.4 * part + 0.6 * 255) for part in colour)
    return red, green, blue
