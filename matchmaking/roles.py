"""Roles: what kind of player a learning lineage is. A role is a record; its behaviour is in the values it holds."""

from dataclasses import dataclass, field

from matchmaking.opponents import Opponents


@dataclass(frozen=True)
class Role:
    """A kind of player: whose policies it learns against, and which of their snapshots it meets."""

    name: str
    """As it stands in the player's row, e.g. main."""

    meets: tuple[str, ...] = ("main",)
    """Roles whose players are its opponents; an exploiter of the main players would say the same."""

    opponents: Opponents = field(default_factory=Opponents)
    """Present policies, past snapshots or a share of both."""


MAIN = Role("main")


def is_exploiter(role: str) -> bool:
    """Whether a player of that role looks for others' weaknesses: main_exploiter, league_exploiter and the like."""
    return "exploiter" in role
