"""Settings of tag: number of teams, sizes, speeds, rewards. The game itself is `arenas/games/tag/match.py`.

Nothing here loads jax or mujoco: a configuration is read and written without them.
"""

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Unpack

from arenas.arena_settings import EngineOptions, Timing
from arenas.description import AgentOutline, Outline
from arenas.games.terms import RewardTerms, WithTerms, with_terms

if TYPE_CHECKING:
    from arenas.games.tag.match import Tag

TEAMS = ("blue", "red", "green", "yellow", "purple", "orange", "grey", "white")
KIND = "puck"
ACTION_SIZE = 2  # numbers in an action
OWN_SIZE = 8  # numbers that a puck observes of itself and of the game
IT_SIZE = 4  # numbers that it observes of the puck that is "it"
OTHER_SIZE = 5  # numbers that it observes of each other puck
START = (0.25, 0.4)  # least and largest distance from the middle at the start, as shares of the side


@dataclass(frozen=True)
class TagRules:
    """Rules that decide a game: with the bodies, these make the arena's configuration hash."""

    side: float = field(default=2.5, metadata={"low": 1.0, "high": 100.0})
    """Distance between opposite walls of the square field, in metres."""
    episode: float = field(default=10.0, metadata={"low": 1.0, "high": 600.0})
    """Seconds until the game ends."""
    immunity: float = field(default=1.0, metadata={"low": 0.0, "high": 60.0})
    """Seconds after a touch, and after the start, in which no touch counts."""
    radius: float = field(default=0.1, metadata={"low": 0.02, "high": 0.12})
    """Radius of a puck, in metres; walls are 0.12 m high."""
    reach: float = field(default=0.03, metadata={"low": 0.0, "high": 1.0})
    """Gap in metres between two pucks up to which they touch."""
    speed: float = field(default=1.5, metadata={"low": 0.01, "high": 4.0})
    """Speed in m/s that a puck approaches at full thrust."""
    thrust: float = field(default=6.0, metadata={"low": 0.01, "high": 1000.0})
    """N at full thrust; a puck weighs 1 kg."""


@dataclass(frozen=True)
class TagReward(RewardTerms):
    """Rewards, which shape learning and never decide a game."""

    rank: float = 1.0
    """At the end: to the first; the last gets its negative, and those between them equal steps."""
    it: float = 0.2
    """Per second: to the puck that is "it"; the others share the loss."""
    approach: float = 0.5
    """Shaping: to "it" per metre that it gained on the nearest other puck; to the others per metre by which they
    approached it."""


@dataclass(frozen=True)
class TagSettings(WithTerms):
    """A game of tag, free for all."""

    name: str = "tag"
    """The arena's name."""
    teams: int = field(default=3, metadata={"low": 3, "high": len(TEAMS)})
    """Number of teams, each of one puck."""
    rules: TagRules = field(default_factory=TagRules)
    """Rules that decide a game."""
    reward: TagReward = field(default_factory=TagReward)
    """Rewards for learning."""

    def __post_init__(self) -> None:
        """Check that the pucks start without touching each other."""
        rules = self.rules
        needed = (2 * rules.radius + rules.reach) / (2 * START[0] * math.sin(math.pi / self.teams))
        if rules.side < needed:
            raise ValueError(
                f"rules.side: {rules.side} m is too narrow for {self.teams} pucks of radius {rules.radius} m to start"
                f" apart; it must be {math.ceil(100 * needed) / 100} m or more"
            )

    @property
    def timing(self) -> Timing:
        """Ten decisions per second."""
        return Timing(timestep=0.025, substeps=1, hold=4, episode=self.rules.episode)

    @property
    def observation_size(self) -> int:
        """Numbers that each puck observes: see `arenas/games/tag/observation.py`."""
        return OWN_SIZE + IT_SIZE + OTHER_SIZE * (self.teams - 1)

    def outline(self) -> Outline:
        """Summarise the game."""
        what = f'be "it" for the longest time: {self.teams} pucks in a walled field of {self.rules.side:g} m'
        seats = (AgentOutline(KIND, self.observation_size, ACTION_SIZE),)
        return Outline(what, dict.fromkeys(TEAMS[: self.teams], seats), self.timing, "tag")

    def build(self, **options: Unpack[EngineOptions]) -> "Tag":
        """Build the arena."""
        from arenas.games.tag.match import Tag

        return with_terms(Tag(self, **options), self)


ARENAS = (TagSettings(),)
