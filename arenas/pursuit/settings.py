"""Settings of pursuit: how many against how many, how quick and how large. The game itself is `arenas/pursuit/game.py`.

Nothing here loads jax or mujoco: a configuration is read and written without them. Numbers are those of MADDPG's simple
tag (Lowe et al. 2017, multiagent-particle-envs), with metres and seconds for its units, where nothing else is said.
"""

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Unpack

from arenas.about import Outline, Seat
from arenas.options import Timing, Where

if TYPE_CHECKING:
    from arenas.pursuit.game import Pursuit

TEAMS = ("predators", "prey")
ACTS = 2  # numbers in an action
FASTEST = 4.0  # m/s: a tenth of a metre in a step of physics, half of what a wall is thick
CROWDED = 0.75  # share of the field that those who stand already may keep from who comes last


@dataclass(frozen=True)
class PursuitRules:
    """What decides a game: with the bodies, these make the arena's configuration hash."""

    side: float = field(default=2.0, metadata={"low": 0.5, "high": 100.0})
    """Metres from wall to wall of the square field."""
    episode: float = field(default=10.0, metadata={"low": 1.0, "high": 600.0})
    """Seconds that prey must last; the original's 25 steps are 2.5 s, and a touch does not end them."""
    obstacles: int = field(default=2, metadata={"low": 0, "high": 32})
    """Pillars, somewhere else in each episode."""
    obstacle_radius: float = field(default=0.2, metadata={"low": 0.01, "high": 10.0})
    """Metres."""
    apart: float = field(default=0.5, metadata={"low": 0.0, "high": 50.0})
    """Metres of air between prey and the predators at the start, at least; the original draws places anywhere."""
    predator_radius: float = field(default=0.075, metadata={"low": 0.02, "high": 0.12})
    """Metres; walls are 0.12 m high."""
    predator_speed: float = field(default=1.0, metadata={"low": 0.01, "high": FASTEST})
    """m/s that a predator comes near at full thrust."""
    predator_thrust: float = field(default=3.0, metadata={"low": 0.01, "high": 1000.0})
    """N at full thrust; it weighs 1 kg."""
    prey_radius: float = field(default=0.05, metadata={"low": 0.02, "high": 0.12})
    """Metres."""
    prey_speed: float = field(default=1.3, metadata={"low": 0.01, "high": FASTEST})
    """m/s that prey comes near at full thrust."""
    prey_thrust: float = field(default=4.0, metadata={"low": 0.01, "high": 1000.0})
    """N at full thrust; it weighs 1 kg."""


@dataclass(frozen=True)
class PursuitReward:
    """Rewards, which shape learning and never decide a game: what one team gets the other loses."""

    capture: float = 1.0
    """To the predators for all prey together, a share for each one when it is caught, and from the prey."""
    escape: float = 1.0
    """From the predators when time is up, and to the prey."""
    approach: float = 0.2
    """Hint: to the predators per metre that the nearest came nearer to free prey, mean over prey; from the prey."""


@dataclass(frozen=True)
class PursuitSettings:
    """A pursuit: how many predators, how many prey, by which rules."""

    name: str = "pursuit"
    """The arena's name."""
    predators: int = field(default=3, metadata={"low": 1, "high": 32})
    """Robots of the first team, slow and large."""
    prey: int = field(default=1, metadata={"low": 1, "high": 32})
    """Robots of the second team, quick and small."""
    rules: PursuitRules = field(default_factory=PursuitRules)
    """What decides a game."""
    reward: PursuitReward = field(default_factory=PursuitReward)
    """What shapes learning."""

    def __post_init__(self) -> None:
        """Check that all find room at the start."""
        needed = self._needed()
        if self.rules.side < needed:
            raise ValueError(
                f"rules.side: {self.rules.side} m is too narrow for {self.predators} predators, {self.prey} prey and"
                f" {self.rules.obstacles} obstacles to start in; it must be {math.ceil(100 * needed) / 100} m or more"
            )

    def _needed(self) -> float:
        """The least side in metres: what is put down last, of each kind, may have CROWDED of its field ruled out."""
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
        """Metres that a pillar, prey and a predator keep for themselves at the start.

        A pillar keeps half of what a predator needs to come by; so there are no gaps in which to hide or be wedged.
        """
        rules = self.rules
        return rules.obstacle_radius + rules.predator_radius, rules.prey_radius, rules.predator_radius

    @property
    def timing(self) -> Timing:
        """Decisions at the original's 10 Hz."""
        return Timing(timestep=0.025, substeps=1, hold=4, episode=self.rules.episode)

    def sees(self, team: str) -> int:
        """Numbers in the observation of a robot: see `arenas/pursuit/sight.py`."""
        others, seen_moving = self.predators + self.prey - 1, self.prey - (team == "prey")
        return 2 * (2 + self.rules.obstacles + others + seen_moving) + 1

    def outline(self) -> Outline:
        """The game in a line."""
        rules = self.rules
        among = f" among {rules.obstacles} pillars" if rules.obstacles else ""
        what = f"catch quicker prey{among} in a walled field of {rules.side:g} m within {rules.episode:g} s"
        sizes = zip(TEAMS, (self.predators, self.prey), strict=True)
        kinds = {"predators": "predator", "prey": "prey"}
        teams = {team: (Seat(kinds[team], self.sees(team), ACTS),) * size for team, size in sizes}
        return Outline(what, teams, self.timing, "pursuit")

    def build(self, **where: Unpack[Where]) -> "Pursuit":
        """The arena itself."""
        from arenas.pursuit.game import Pursuit

        return Pursuit(self, **where)


ARENAS = (PursuitSettings(),)
