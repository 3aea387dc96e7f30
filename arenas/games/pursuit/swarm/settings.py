"""Settings of the swarm: numbers of pucks and rovers, sizes, speeds. The game is `arenas/games/pursuit/swarm/match.py`.

Nothing here loads jax or mujoco: a configuration is read and written without them.
"""

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Unpack

from arenas.arena_settings import EngineOptions, Timing
from arenas.description import AgentOutline, Outline
from arenas.games.terms import RewardTerms, WithTerms, with_terms

if TYPE_CHECKING:
    from arenas.games.pursuit.swarm.match import Swarm

TEAMS = ("swarm", "guards")
KINDS = ("puck", "leatherback")
ACTION_SIZE = 2  # numbers in an action, of either kind
OWN_SIZES = {"puck": 7, "leatherback": 14}  # numbers that each observes of itself and of the game
OTHER_SIZES = {"puck": 5, "leatherback": 7}  # and of each other robot of a kind
EDGE = 0.3  # m from pucks to the walls at the start
MOST = 16  # robots of a side


@dataclass(frozen=True)
class SwarmRules:
    """Rules that decide a game: with the bodies, these make the arena's configuration hash."""

    side: float = field(default=8.0, metadata={"low": 3.0, "high": 50.0})
    """Distance between opposite walls of the square field, in metres."""
    zone: float = field(default=0.8, metadata={"low": 0.1, "high": 10.0})
    """Radius in metres of the zone in the middle that pucks want to reach."""
    episode: float = field(default=15.0, metadata={"low": 1.0, "high": 600.0})
    """Seconds until time is up, and the rovers have won."""
    reach: float = field(default=0.5, metadata={"low": 0.05, "high": 2.0})
    """Distance in metres from a rover's middle to that of a puck up to which it catches it."""
    radius: float = field(default=0.1, metadata={"low": 0.02, "high": 0.12})
    """Radius of a puck, in metres; walls are 0.2 m high."""
    speed: float = field(default=0.9, metadata={"low": 0.01, "high": 4.0})
    """Speed in m/s that a puck approaches at full thrust."""
    thrust: float = field(default=4.0, metadata={"low": 0.01, "high": 1000.0})
    """N at full thrust; a puck weighs 1 kg."""
    drive: float = field(default=60.0, metadata={"low": 1.0, "high": 100.0})
    """Speed of a rover's wheels at full throttle, in rad/s: 60 is 3.1 m/s."""


@dataclass(frozen=True)
class SwarmReward(RewardTerms):
    """Rewards, which shape learning and never decide a game: one team's gain is the other's loss."""

    win: float = 1.0
    """To the team that wins."""
    through: float = 1.0
    """To the swarm for all pucks together, in equal shares for each that reaches the zone."""
    caught: float = 1.0
    """From the swarm for all pucks together, in equal shares for each that is caught."""
    approach: float = 1.0
    """Shaping: to the swarm per metre that pucks in the game come nearer to the zone, mean over them."""


@dataclass(frozen=True)
class SwarmSettings(WithTerms):
    """A game of pucks against rovers, in any numbers."""

    name: str = "swarm"
    """The arena's name."""
    pucks: int = field(default=8, metadata={"low": 1, "high": MOST})
    """Robots of the first team, small, which drop out one by one."""
    rovers: int = field(default=2, metadata={"low": 1, "high": MOST})
    """Robots of the second team."""
    room_pucks: int | None = field(default=None, metadata={"low": 1, "high": MOST})
    """Pucks for which observations have room (none: those that play). With more room a policy can play other numbers
    without learning anew: an observation has zeros for those that are not there."""
    room_rovers: int | None = field(default=None, metadata={"low": 1, "high": MOST})
    """The same for rovers."""
    rules: SwarmRules = field(default_factory=SwarmRules)
    """Rules that decide a game."""
    reward: SwarmReward = field(default_factory=SwarmReward)
    """Rewards for learning."""

    def __post_init__(self) -> None:
        """Check that there is room for all, in the field and in observations."""
        rules = self.rules
        for name, room, number in (
            ("room_pucks", self.room_pucks, self.pucks), ("room_rovers", self.room_rovers, self.rovers)
        ):  # fmt: skip
            if room is not None and room < number:
                raise ValueError(f"{name}: {room} is fewer than play, {number}; give {number} or more, or none")
        # Rovers of 0.59 m start round the zone; pucks start round them, beyond their reach
        inner = self.inner + 0.3 + rules.reach
        outer = self.pucks * 2.5 * rules.radius / (2 * math.pi)
        needed = 2 * (max(inner, outer) + EDGE)
        if rules.side < needed:
            raise ValueError(
                f"rules.side: {rules.side} m is too narrow for {self.pucks} pucks and {self.rovers} rovers round a zone"
                f" of {rules.zone} m to start apart; it must be {math.ceil(10 * needed) / 10} m or more"
            )

    @property
    def inner(self) -> float:
        """Radius in metres of the circle on which rovers start."""
        return max(self.rules.zone + 0.3, self.rovers * 0.7 / (2 * math.pi))

    @property
    def needed(self) -> int:
        """Pucks that must reach the zone: half of them, rounded up."""
        return (self.pucks + 1) // 2

    @property
    def room(self) -> dict[str, int]:
        """Robots of each kind, itself included, for which an observation has room."""
        return dict(zip(KINDS, (self.room_pucks or self.pucks, self.room_rovers or self.rovers), strict=True))

    @property
    def timing(self) -> Timing:
        """Ten decisions per second, judged fifty times per second."""
        return Timing(timestep=0.005, substeps=4, hold=5, episode=self.rules.episode)

    def observation_size(self, kind: str) -> int:
        """Numbers that a robot of a kind observes: see `arenas/games/pursuit/swarm/observation.py`."""
        return OWN_SIZES[kind] + sum(OTHER_SIZES[k] * (room - (k == kind)) for k, room in self.room.items())

    def outline(self) -> Outline:
        """Summarise the game."""
        what = f"reach a zone with {self.needed} of {self.pucks} pucks; rovers catch them within {self.rules.reach:g} m"
        seats = {
            team: (AgentOutline(kind, self.observation_size(kind), ACTION_SIZE),) * number
            for team, kind, number in zip(TEAMS, KINDS, (self.pucks, self.rovers), strict=True)
        }
        return Outline(what, seats, self.timing, "swarm")

    def build(self, **options: Unpack[EngineOptions]) -> "Swarm":
        """Build the arena."""
        from arenas.games.pursuit.swarm.match import Swarm

        return with_terms(Swarm(self, **options), self)


ARENAS = (SwarmSettings(),)
