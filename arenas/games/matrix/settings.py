"""Settings of matrix games: both teams choose at once, and a table gives the payoff. The game itself is
`arenas/games/matrix/match.py`.

Nothing here loads jax or mujoco: a configuration is read and written without them.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, Unpack

from arenas.arena_settings import EngineOptions, Timing
from arenas.description import AgentOutline, Outline
from arenas.games.terms import RewardTerms, WithTerms, with_terms

if TYPE_CHECKING:
    from arenas.games.matrix.match import MatrixGame

TEAMS = ("blue", "red")
OBSERVATION_SIZE = 1  # numbers in an observation


class Table(NamedTuple):
    """A zero-sum game: the payoff to blue, and loss of red, for blue's choice (row) and red's (column)."""

    choices: tuple[str, ...]
    payoff: tuple[tuple[float, ...], ...]
    kinds: tuple[str, str]  # of the two sides: equal if a policy for one can play the other
    what: str  # a short description


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
    """Rules that decide a match."""

    table: str = "rock-paper-scissors"
    """The game: rock-paper-scissors or matching-pennies."""
    rounds: int = field(default=1, metadata={"low": 1, "high": 1000})
    """Choices in an episode; the team with the larger total payoff wins."""

    def __post_init__(self) -> None:
        """Check the table's name."""
        if self.table not in TABLES:
            raise ValueError(f"table: {self.table!r} is none of {', '.join(TABLES)}")


@dataclass(frozen=True)
class MatrixReward(RewardTerms):
    """The reward is the payoff, and what terms of your own add to it."""


@dataclass(frozen=True)
class MatrixSettings(WithTerms):
    """A game without bodies, for leagues with a known solution: the uniform mixture cannot be beaten."""

    name: str = "rock-paper-scissors"
    """The arena's name."""
    rules: MatrixRules = field(default_factory=MatrixRules)
    """Rules that decide a match."""
    reward: MatrixReward = field(default_factory=MatrixReward)
    """Rewards for learning."""

    @property
    def timing(self) -> Timing:
        """One second for each round."""
        return Timing(timestep=1.0, substeps=1, hold=1, episode=float(self.rules.rounds))

    def outline(self) -> Outline:
        """Summarise the game."""
        table = TABLES[self.rules.table]
        seats = {
            team: (AgentOutline(kind, OBSERVATION_SIZE, len(table.choices)),)
            for team, kind in zip(TEAMS, table.kinds, strict=True)
        }
        return Outline(f"a game without bodies: {table.what}", seats, self.timing, "matrix")

    def build(self, **options: Unpack[EngineOptions]) -> "MatrixGame":
        """Build the arena. It needs no engine and accepts any engine's name."""
        from arenas.games.matrix.match import MatrixGame

        return with_terms(MatrixGame(self, **options), self)


ARENAS = tuple(MatrixSettings(table, MatrixRules(table)) for table in TABLES)
