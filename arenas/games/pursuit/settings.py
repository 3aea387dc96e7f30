"""Settings of pursuit: numbers, speeds and sizes of robots. The game itself is `arenas/games/pursuit/match.py`.

Nothing here loads jax or mujoco: a configuration is read and written without them. Unless noted otherwise, numbers are
those of MADDPG's simple tag (Lowe et al. 2017, multiagent-particle-envs), with metres and seconds for its units.
"""

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Unpack

from arenas.arena_settings import EngineOptions, Timing
from arenas.description import AgentOutline, Outline
from arenas.games.terms import RewardTerms, WithTerms, with_terms

if TYPE_CHECKING:
    from arenas.games.pursuit.match import Pursuit

TEAMS = ("predators", "prey")
ACTION_SIZE = 2  # numbers in an action
FASTEST = 4.0  # m/s: a tenth of a metre in a step of physics, half the thickness of a wall
CROWDED = 0.75  # share of the field that may be ruled out for the last robot by those already placed


@dataclass(frozen=True)
class PursuitRules:
    """Rules that decide a game: with the bodies, these make the arena's configuration hash."""

    side: float = field(default=2.0, metadata={"low": 0.5, "high": 100.0})
    """Distance between opposite walls of the square field, in metres."""
    episode: float = field(default=10.0, metadata={"low": 1.0, "high": 600.0})
    """Seconds that prey must survive; the original's 25 steps are 2.5 s, and a touch does not end them."""
    obstacles: int = field(default=2, metadata={"low": 0, "high": 32})
    """Number of pillars, which have new places in each episode."""
    obstacle_radius: float = field(default=0.2, metadata={"low": 0.01, "high": 10.0})
    """Radius of a pillar, in metres."""
    apart: float = field(default=0.5, metadata={"low": 0.0, "high": 50.0})
    """Minimum gap in metres between prey and predators at the start; the original draws places anywhere."""
    predator_radius: float = field(default=0.075, metadata={"low": 0.02, "high": 0.12})
    """Radius of a predator, in metres; walls are 0.12 m high."""
    predator_speed: float = field(default=1.0, metadata={"low": 0.01, "high": FASTEST})
    """Speed in m/s that a predator approaches at full thrust."""
    predator_thrust: float = field(default=3.0, metadata={"low": 0.01, "high": 1000.0})
    """N at full thrust; a predator weighs 1 kg."""
    prey_radius: float = field(default=0.05, metadata={"low": 0.02, "high": 0.12})
    """Radius of prey, in metres."""
    prey_speed: float = field(default=1.3, metadata={"low": 0.01, "high": FASTEST})
    """Speed in m/s that prey approaches at full thrust."""
    prey_thrust: float = field(default=4.0, metadata={"low": 0.01, "high": 1000.0})
    """N at full thrust; prey weighs 1 kg."""


@dataclass(frozen=True)
class PursuitReward(RewardTerms):
    """Rewards, which shape learning and never decide a game: one team's gain is the other's loss."""

    capture: float = 1.0
    """To the predators for all prey together, in equal shares at each capture; the same from the prey."""
    escape: float = 1.0
    """From the predators when time is up; the same to the prey."""
    approach: float = 0.2
    """Shaping: to the predators per metre by which the nearest predator approached free prey, mean over prey; from the
    prey."""


@dataclass(frozen=True)
class PursuitSettings(WithTerms):
    """A pursuit: numbers of predators and prey, and the rules."""

    name: str = "pursuit"
    """The arena's name."""
    predators: int = field(default=3, metadata={"low": 1, "high": 32})
    """Robots of the first team, slow and large."""
    prey: int = field(default=1, metadata={"low": 1, "high": 32})
    """Robots of the second team, quick and small."""
    rules: PursuitRules = field(default_factory=PursuitRules)
    """Rules that decide a game."""
    reward: PursuitReward = field(default_factory=PursuitReward)
    """Rewards for learning."""

    def __post_init__(self) -> None:
        """Check that there is room for all at the start."""
        needed = self._needed()
        if self.rules.side < needed:
            raise ValueError(
                f"rules.side: {self.rules.side} m is too narrow for {self.predators} predators, {self.prey} prey and"
                f" {self.rules.obstacles} obstacles to start in; it must be {math.ceil(100 * needed) / 100} m or more"
            )

    def _needed(self) -> float:
        """Return the smallest side in metres: at most CROWDED of the field is ruled out for the last object of each
        kind.
        """
        rules, (pillar, prey, predator) = self.rules, self.clear
        ruled_out = {
            pillar: (rules.obstacles - 1) * (2 * pillar) ** 2,
            prey: rules.obstacles * (pillar + prey) ** 2 + (self.prey - 1) * (2 * prey) ** 2,
            predator: rules.obstacles * (pillar + predator) ** 2
            + self.prey * (prey + rules.apart + predator) ** 2
            + (self.predators - 1) * (2 * predator) ** 2,
        }
        return max(2 * own + math.sqrt(math.pi * max(0.0, area) / CROWDED) for own, area in ruled_out.items())

    @property
    def clear(self) -> tuple[float, float, float]:
        """Clearances in metres of a pillar, prey and a predator at the start.

        A pillar's includes half of what a predator needs to pass, so there are no gaps to hide or get stuck in.
        """
        rules = self.rules
        return rules.obstacle_radius + rules.predator_radius, rules.prey_radius, rules.predator_radius

    @property
    def timing(self) -> Timing:
        """Decisions at the original's 10 Hz."""
        return Timing(timestep=0.025, substeps=1, hold=4, episode=self.rules.episode)

    def observation_size(self, team: str) -> int:
        """Return the size of a robot's observation: see `arenas/games/pursuit/observation.py`."""
        others, seen_moving = self.predators + self.prey - 1, self.prey - (team == "prey")
        return 2 * (2 + self.rules.obstacles + others + seen_moving) + 1

    def outline(self) -> Outline:
        """Summarise the game."""
        rules = self.rules
        among = f" among {rules.obstacles} pillars" if rules.obstacles else ""
        what = f"catch faster prey{among} in a walled field of {rules.side:g} m within {rules.episode:g} s"
        sizes = zip(TEAMS, (self.predators, self.prey), strict=True)
        kinds = {"predators": "predator", "prey": "prey"}
        teams = {
            team: (AgentOutline(kinds[team], self.observation_size(team), ACTION_SIZE),) * size for team, size in sizes
        }
        return Outline(what, teams, self.timing, "pursuit")

    def build(self, **options: Unpack[EngineOptions]) -> "Pursuit":
        """Build the arena."""
        from arenas.games.pursuit.match import Pursuit

        return with_terms(Pursuit(self, **options), self)


ARENAS = (PursuitSettings(),)
