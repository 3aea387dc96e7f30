"""Kinds of robots by name: what settings need to know of a robot without building it. Loads neither jax nor mujoco.

A kind is the name of a robot in code (`anymal`), of a robot whose model comes in a wheel (`go1`), or a file: MJCF
(.xml), URDF (.urdf) or a robot file (.toml) that `league robot` wrote.
"""

import difflib
from collections.abc import Collection, Sequence
from typing import NamedTuple

from arenas.errors import ArenaError, RosterError


class Kind(NamedTuple):
    """Properties of a robot kind that settings need."""

    hull: float  # m, diameter of the circle that it covers at rest in any heading: robots closer than this may overlap
    contacts: int  # Warp's contact slots for it where there are many worlds, besides a few per world
    rows: int  # and constraint rows
    proprioception_size: int  # numbers in its proprioception
    action_size: int  # numbers in its action
    planar: bool = False  # it moves in the world's x and z alone
    name: str = ""  # of a robot from a file: its kind in rosters; empty: as it is called in settings


KINDS = {
    # Pairs of near geoms need slots; there are more of them than contacts. The largest mean over worlds at any time, of
    # four robots, untrained, random, crowded and trained (`benchmarks/buffers.py`): four ANYmals 53 pairs, two and two
    # rovers 35, four rovers 20. Rows of a world: at most 116, of rovers that lie on one another.
    "leatherback": Kind(hull=0.59, contacts=7, rows=36, proprioception_size=2, action_size=2),
    "anymal": Kind(hull=1.18, contacts=16, rows=44, proprioception_size=45, action_size=12),
    "minitank": Kind(hull=0.50, contacts=7, rows=36, proprioception_size=6, action_size=2),  # twice its barrel's length
}


def kind_of(name: str) -> Kind:
    """Return the properties of a kind by its name in a roster. Raises ArenaError, one line, for a bad robot file."""
    if name in KINDS:
        return KINDS[name]
    from arenas.robots.files.catalogue import robot_file

    found = robot_file(name)
    joints = len(found.drives)
    sizes = (found.contacts, found.rows, found.proprioception_size, joints)
    return Kind(found.width, *sizes, found.planar, found.name)


def is_file(name: str) -> bool:
    """Return whether a roster's name is that of a robot from a file or a wheel, and not of one in code."""
    from arenas.robots.files.catalogue import SUFFIXES, shipped

    return name not in KINDS and (name.endswith(SUFFIXES) or name in shipped())


def roster_name(name: str) -> str:
    """Return the kind of a robot as rosters and tables show it: of `my/go2.xml` it is `go2`."""
    return kind_of(name).name or name


def check_roster(
    field: str, kinds: Sequence[str], players: Collection[str] = tuple(KINDS), planar: bool = False
) -> None:
    """Raise RosterError, one line with the field's name, for an empty team, an unknown kind or a bad robot file.

    `players` are the robots in code that can play; robots from files always can, those that move in a plane if
    `planar`.
    """
    from arenas.robots.files.catalogue import shipped

    if not kinds:
        raise RosterError(f"{field}: a team needs at least one robot ({_known(players)})")
    for kind in kinds:
        if kind in players:
            continue
        if not is_file(kind):
            near = difflib.get_close_matches(kind, (*players, *shipped()), 1)
            hint = f"did you mean {near[0]}? " if near else ""
            raise RosterError(f"{field}: unknown robot {kind!r}: {hint}(robots: {_known(players)})")
        try:
            found = kind_of(kind)
        except ArenaError as error:
            raise RosterError(f"{field}: {error}") from None
        if found.planar and not planar:
            raise RosterError(f"{field}: {kind} moves in a plane alone, and plays in arena disturbance only")


def _known(players: Collection[str]) -> str:
    from arenas.robots.files.catalogue import shipped

    return f"{', '.join((*players, *shipped()))}; a file of your own: my/robot.xml"
