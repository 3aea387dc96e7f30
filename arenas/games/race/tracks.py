"""Tracks: gates, and the walls between them. Loads neither jax nor mujoco.

Places and heights of gates are those of 2512.11781, and so are the headings of the complex track, in which a gate is
passed against its published yaw. The lemniscate's headings and all walls are our own: the paper's are not published in
numbers. Each wall cuts the straight line between two gates, is as high as the box, and can be flown round.
"""

from typing import Literal, NamedTuple

TrackName = Literal["complex", "lemniscate"]
SIDE = 1.0  # m, of a gate's opening
X, Y, Z = (-6.0, 5.0), (-9.0, 9.0), (0.1, 3.0)  # m, the box that drones must not leave
THICK = 0.1  # m, half a wall's thickness


class Gate(NamedTuple):
    """A gate, which is upright."""

    x: float  # m, of its centre
    y: float
    z: float
    heading: float  # degrees: the horizontal direction in which it is passed


class Wall(NamedTuple):
    """A wall along x or y, from the ground to the top of the box."""

    x: float  # m, of its centre
    y: float
    along_x: float  # m, half its size
    along_y: float


class Track(NamedTuple):
    """A closed track."""

    gates: tuple[Gate, ...]
    walls: tuple[Wall, ...]


TRACKS: dict[TrackName, Track] = {
    "complex": Track(
        (
            Gate(1.5, 3.5, 0.75, 135.0), Gate(-1.5, 3.5, 0.75, -135.0), Gate(-2.0, -3.5, 2.0, -90.0),
            Gate(-2.0, -3.5, 0.75, 90.0), Gate(1.0, -1.0, 2.0, 0.0), Gate(1.0, -3.5, 0.75, 180.0),
        ),
        (
            Wall(0.0, 3.5, THICK, 0.75), Wall(-1.75, 0.0, 1.0, THICK),
            Wall(-0.6, -2.5, THICK, 0.75), Wall(1.25, 1.0, 1.0, THICK),
        ),
    ),
    "lemniscate": Track(
        (
            Gate(1.5, 3.5, 0.75, 90.0), Gate(0.0, 5.25, 1.5, 135.0), Gate(-2.0, 7.0, 0.75, 90.0),
            Gate(1.5, 7.0, 0.75, -90.0), Gate(0.0, 5.25, 1.5, -135.0), Gate(-2.0, 3.5, 0.75, -90.0),
        ),
        (Wall(-0.25, 7.75, THICK, 1.0), Wall(-0.25, 2.75, THICK, 1.0)),
    ),
}  # fmt: skip
