"""Settings of games in which two players act in turn and see only a part of the game. The games themselves are in
`arenas/games/matrix/turns/poker.py` and `dark_hex.py`.

Nothing here loads jax or mujoco: a configuration is read and written without them.
"""

import importlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NamedTuple, Unpack

from arenas.arena_settings import EngineOptions, Timing
from arenas.description import AgentOutline, Outline
from arenas.games.terms import RewardTerms, WithTerms, with_terms

if TYPE_CHECKING:
    from arenas.games.matrix.turns.match import TurnGame

TEAMS = ("blue", "red")
CELLS = 3  # rows and columns of the board of dark hex


class TurnGameKind(NamedTuple):
    """A game of turns, as it is described and found."""

    kind: str  # of both agents
    choices: tuple[str, ...]
    observation_size: int
    decisions: int  # of both players in the longest game
    where: str  # module:class under arenas.games.matrix.turns
    what: str  # a short description


GAMES = {
    "kuhn-poker": TurnGameKind(
        "kuhn", ("pass", "bet"), 10, 3, "poker:Kuhn", "three cards, one each, and at most one bet"
    ),
    "leduc-poker": TurnGameKind(
        "leduc", ("fold", "call", "raise"), 31, 8, "poker:Leduc", "six cards, two rounds of bets, a public card"
    ),
    "dark-hex-3": TurnGameKind(
        "hex", tuple(f"{row}{column}" for row in "abc" for column in "123"), 20, 17, "dark_hex:DarkHexGame",
        "hex on 3 × 3 cells; stones of the other player are seen where one's own would go",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class TurnRules:
    """Rules that decide a match."""

    game: str = "kuhn-poker"
    """The game: kuhn-poker, leduc-poker or dark-hex-3."""
    score: Literal["hands", "chips"] = "hands"
    """Score of a match: hands, the winner of the hand wins, ½ each without one; chips, a lottery that a team wins with
    probability ½ + (chips won) / (2 · most that can be won), so that win rates measure chips."""

    def __post_init__(self) -> None:
        """Check the game's name."""
        if self.game not in GAMES:
            raise ValueError(f"game: {self.game!r} is none of {', '.join(GAMES)}")


@dataclass(frozen=True)
class TurnReward(RewardTerms):
    """The reward is the game's return, in chips, and what terms of your own add to it."""


@dataclass(frozen=True)
class TurnSettings(WithTerms):
    """A small game of hidden information, whose exploitability `league exploitability` computes exactly."""

    name: str = "kuhn-poker"
    """The arena's name."""
    rules: TurnRules = field(default_factory=TurnRules)
    """Rules that decide a match."""
    reward: TurnReward = field(default_factory=TurnReward)
    """Rewards for learning."""

    @property
    def timing(self) -> Timing:
        """One second for each action."""
        return Timing(timestep=1.0, substeps=1, hold=1, episode=float(GAMES[self.rules.game].decisions))

    def outline(self) -> Outline:
        """Summarise the game."""
        game = GAMES[self.rules.game]
        seat = (AgentOutline(game.kind, game.observation_size, len(game.choices)),)
        return Outline(f"a game of turns without bodies: {game.what}", dict.fromkeys(TEAMS, seat), self.timing, "turns")

    def build(self, **options: Unpack[EngineOptions]) -> "TurnGame":
        """Build the arena. It needs no engine and accepts any engine's name."""
        module, _, name = GAMES[self.rules.game].where.partition(":")
        game = getattr(importlib.import_module(f"arenas.games.matrix.turns.{module}"), name)
        return with_terms(game(self, **options), self)


ARENAS = tuple(TurnSettings(game, TurnRules(game)) for game in GAMES)
