"""Matrix games' settings: both teams choose at once, and a table says who gets what. The game: `arenas/matrix_game.py`.

Nothing here loads jax or mujoco: a configuration is read and written without them.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, Unpack

from arenas.about import Outline, Seat
from arenas.options import Timing, Where

if TYPE_CHECKING:
    from arenas.matrix_game import MatrixGame

TEAMS = ("blue", "red")
SEES = 1  # numbers in an observation


class Table(NamedTuple):
    """A zero-sum game: what blue gets, and red loses, for blue's choice (row) and red's (column)."""

    choices: tuple[str, ...]
    payoff: tuple[tuple[float, ...], ...]
    kinds: tuple[str, str]  # of the two sides: equal where a policy for one can play the other
    what: str  # in words


TABLES = {
    "rock-paper-scissors": Table(
        ("rock", "paper", "scissors"),
        ((0, -1, 1), (1, 0, -1), (-1, 1, 0)),
        ("chooser", "chooser"),
        "rock blunts scissors, scissors cut paper, paper wraps rock",
    ),
    "matching-pennies": Table(
        ("heads", "tails"),
        ((1, -1), (-1, 1)),
        ("matcher", "mismatcher"),
        "blue gains when both choose the same, red when not",
    ),
}


@dataclass(frozen=True)
class MatrixRules:
    """What decides a match."""

    table: str = "rock-paper-scissors"
    """Which game: rock-paper-scissors or matching-pennies."""
    rounds: int = field(default=1, metadata={"low": 1, "high": 1000})
    """Choices in an episode; who got more in all of them has won it."""

    def __post_init__(self) -> None:
        """Check the name."""
        if self.table not in TABLES:
            raise ValueError(f"table: {self.table!r} is none of {', '.join(TABLES)}")


@dataclass(frozen=True)
class MatrixSettings:
    """A game without bodies, for leagues of which the answer is known: nobody can beat an even mixture."""

    name: str = "rock-paper-scissors"
    """The arena's name."""
    rules: MatrixRules = field(default_factory=MatrixRules)
    """What decides a match."""

    @property
    def timing(self) -> Timing:
        """A second for each round."""
        return Timing(timestep=1.0, substeps=1, hold=1, episode=float(self.rules.rounds))

    def outline(self) -> Outline:
        """The game in a line."""
        table = TABLES[self.rules.table]
        seats = {team: (Seat(kind, SEES, len(table.choices)),) for team, kind in zip(TEAMS, table.kinds, strict=True)}
        return Outline(f"a game without bodies: {table.what}", seats, self.timing, "matrix")

    def build(self, **where: Unpack[Where]) -> "MatrixGame":
        """The arena itself; it needs no engine and takes whichever is named."""
        from arenas.matrix_game import MatrixGame

        return MatrixGame(self, **where)


ARENAS = tuple(MatrixSettings(table, MatrixRules(table)) for table in TABLES)
