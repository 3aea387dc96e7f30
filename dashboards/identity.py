"""The appearance of players in a match: a player has its colour on either side, and each side has a shape."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from arenas.scene.colours import TEAM_COLOURS
from storage.recordings.recording import Recording, RecordingHeader

Colour = tuple[int, int, int]

COLOURS: tuple[Colour, ...] = (
    (64, 132, 255), (255, 78, 66), (70, 190, 110), (245, 230, 110),
    (130, 40, 160), (245, 145, 20), (150, 175, 180), (235, 250, 250),
)  # fmt: skip
"""Red, green and blue by a player's number; a ninth player gets the first colour again.

Colour-blind people can tell any two apart, as those of teams (`arenas.scene.colours`): they are 20 or more apart.
"""
SHAPES = (("circle", 48), ("square", 4), ("triangle", 3), ("hexagon", 6))
"""Shapes drawn on the ground around the robots of each side, with their numbers of corners."""


@dataclass(frozen=True)
class MatchPlayer:
    """The player of a side."""

    name: str  # of the snapshot
    colour: Colour
    role: str = ""
    rating: str = ""  # before the match, e.g. "1234 ± 56"

    @property
    def label(self) -> str:
        """The label above each of its robots."""
        return " · ".join(filter(None, (self.name, self.rating.partition(" ±")[0], self.role)))


def anonymous_players(header: RecordingHeader) -> tuple[MatchPlayer, ...]:
    """Return the players of a recording of which only the names are known: coloured by side."""
    return tuple(MatchPlayer(name, COLOURS[side % len(COLOURS)]) for side, name in enumerate(header.sides))


def with_distinct_colours(players: Sequence[MatchPlayer], age: Sequence[float]) -> tuple[MatchPlayer, ...]:
    """Return the same players; of those with one colour, all but the one with the largest `age` are paler.

    A player that meets its own past is thereby distinguished by shade, on either side.
    """
    newest = {who.colour: max(a for a, other in zip(age, players, strict=True) if other.colour == who.colour)
              for who in players}  # fmt: skip
    kept: set[Colour] = set()
    found = []
    for who, a in zip(players, age, strict=True):
        pale = a < newest[who.colour] or who.colour in kept
        kept.add(who.colour)
        found.append(replace(who, colour=_pale(who.colour)) if pale else who)
    return tuple(found)


def named_events(recording: Recording, players: Sequence[MatchPlayer]) -> list[tuple[int, str]]:
    """Return a recording's events as (step, text), with the name of the player in place of its side.

    Robots have the colours of their players, and a side may be called by the colour of another one. A snapshot that
    plays several sides is named with its side.
    """
    names = [player.name for player in players]
    called = {
        team: name if names.count(name) == 1 else f"{name} as {team}"
        for team, name in zip(recording.header.teams, names, strict=True)
    }
    parts = [(step, *text.rpartition(": ")) for step, text in recording.events]
    return [(step, f"{what}{colon}{called.get(team, team) if colon else team}") for step, what, colon, team in parts]


def shape(side: int) -> tuple[str, int]:
    """Return the shape of a side: its name and its number of corners."""
    return SHAPES[side % len(SHAPES)]


def team_colour(side: int) -> tuple[float, ...]:
    """Return the colour of a side's bodies in a recording's MJCF, red, green and blue from 0 to 1."""
    return TEAM_COLOURS[side % len(TEAM_COLOURS)][:3]


def _pale(colour: Colour) -> Colour:
    red, green, blue = (round(0.4 * part + 0.6 * 255) for part in colour)
    return red, green, blue
