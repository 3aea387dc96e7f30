"""Settings of the stages before Galaga's matches: a tank that aims at a point, a drone that flies to one.

Nothing here loads jax or mujoco. Each stage has the observation of the match that it leads to (`slots`, `buffer`), with
zeros for absent robots. A reward's fields are its terms. `docs/arenas/galaga.md` explains each setting.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, Unpack

from arenas.arena_settings import EngineOptions, Timing
from arenas.description import AgentOutline, Outline
from arenas.games.galaga.observation_layout import Slots, size
from arenas.games.galaga.settings import ACTION_SIZES, PAIRS, Area, GalagaRules, check_walls, timing
from arenas.games.terms import RewardTerms, WithTerms, with_terms
from arenas.scene.randomisation import Randomisation

if TYPE_CHECKING:
    from arenas.games.galaga.aim import Aim
    from arenas.games.galaga.fly import Fly


TARGETS = Area((-10.0, 10.0), (-10.0, 10.0), (0.5, 10.0))  # m, HARL-A's

# A tank that aims -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class AimRules:
    """Definition of success: with the body, these make the arena's configuration hash."""

    aim_error: float = field(default=0.05, metadata={"above": 0.0, "high": 4.0})
    """As in a match: the L1 distance of the two quaternions must be below this."""
    target: Area = TARGETS
    """Area of the target, m; the tank stands at the centre."""
    nearest: float = field(default=3.0, metadata={"low": 0.0, "high": 10.0})
    """Minimum distance in metres of the target from the tank along x and along y; nearer coordinates are moved out."""
    episode: float = field(default=20.0, metadata={"low": 1.0, "high": 600.0})
    """Maximum duration in seconds; then the attempt is cut."""
    tank_speed: float = field(default=5.0, metadata={"low": 0.1, "high": 20.0})
    """Maximum speed of the tank's joints, rad/s, as in the match."""
    heading: Literal["random", "fixed"] = "random"
    """Heading of the tank at the start; fixed: +x, as HARL-A's."""
    barrel: Literal["random", "ahead"] = "random"
    """Direction of the barrel at the start."""


@dataclass(frozen=True)
class AimReward(RewardTerms):
    """Weights of the reward's terms; none is annealed."""

    hit: float = 1.0
    """Once, when the barrel points at the target (HARL-A: 0)."""
    progress: float = 0.5
    """Per radian by which the barrel approached the target (HARL-A: 0)."""
    aim: float = 0.0
    """Per second: exp(-L1 distance of the quaternions) (HARL-A: 1, its only reward, and no success ends the episode).
    """


@dataclass(frozen=True)
class AimSettings(WithTerms):
    """A single tank that must point at a target in time."""

    name: str = "galaga-aim-1v1"
    """The arena's name."""
    slots: Slots = "1v1"
    """The observation of the match: 10 numbers or 18."""
    buffer: int = field(default=0, metadata={"low": 0, "high": 1000})
    """Zeros after the slots, as many as the match has numbers there."""
    rules: AimRules = field(default_factory=AimRules)
    """Definition of success."""
    reward: AimReward = field(default_factory=AimReward)
    """Rewards for learning."""
    randomisation: Randomisation = field(default_factory=Randomisation)
    """Random differences between episodes in the robot's body."""

    @property
    def timing(self) -> Timing:
        """Decisions at HARL-A's 50 Hz."""
        return timing(self.rules.episode)

    def outline(self) -> Outline:
        """Summarise the task."""
        seat = AgentOutline("minitank", size("minitank", self.slots, 0, self.buffer), ACTION_SIZES["minitank"])
        what = f"point at a target up to {self.rules.target.x[1]:g} m away along either axis"
        return Outline(what, {"blue": (seat,)}, self.timing, "galaga")

    def build(self, **options: Unpack[EngineOptions]) -> "Aim":
        """Build the arena."""
        from arenas.games.galaga.aim import Aim

        return with_terms(Aim(self, **options), self)


# A drone that flies ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FlyRules:
    """Definition of success: with the body, these make the arena's configuration hash."""

    goal_radius: float = field(default=0.2, metadata={"above": 0.0, "high": 5.0})
    """Distance to its goal, in metres, at which the drone has reached it."""
    floor: float | None = field(default=0.25, metadata={"low": 0.0, "high": 5.0})
    """Height in metres at or below which it has crashed; none: it may land and rise."""
    drone: Area = GalagaRules.drones_at
    """Area of its start, level and at rest, m."""
    goal: Area = GalagaRules.goals_at
    """Area of its goal, m."""
    episode: float = field(default=20.0, metadata={"low": 1.0, "high": 600.0})
    """Maximum duration in seconds; then the attempt is cut."""
    walls: bool = False
    """The walls of the 2v2 match."""
    heading: Literal["random", "fixed"] = "random"
    """Heading at the start; fixed: +x, as HARL-A's."""


@dataclass(frozen=True)
class FlyReward(RewardTerms):
    """Weights of the reward's terms; none is annealed."""

    ENDINGS = ("crash",)

    reached: float = 5.0
    """Once, when it is at its goal."""
    crash: float = -5.0
    """Once, when it is too low."""
    progress: float = 1.0
    """Per metre gained towards the goal."""
    near: float = 0.0
    """Per second: exp(-metres to the goal) (HARL-A's task of a single drone: 15)."""
    speed: float = 0.0
    """Per second: square of the velocity, m/s (HARL-A's task: -0.05)."""
    rates: float = -0.01
    """Per second: squares of the rates, rad/s (HARL-A's task: -0.01)."""


@dataclass(frozen=True)
class FlySettings(WithTerms):
    """A single drone that must fly to a point in time."""

    name: str = "galaga-fly-1v1"
    """The arena's name."""
    slots: Slots = "1v1"
    """The observation of the match: 12 numbers or 20."""
    buffer: int = field(default=0, metadata={"low": 0, "high": 1000})
    """Zeros after the slots, as many as the match has numbers there."""
    rules: FlyRules = field(default_factory=FlyRules)
    """Definition of success."""
    reward: FlyReward = field(default_factory=FlyReward)
    """Rewards for learning."""
    randomisation: Randomisation = field(default_factory=Randomisation)
    """Random differences between episodes in the robot's body."""

    def __post_init__(self) -> None:
        """Check that the drone starts in the air, and that both areas are within the walls."""
        rules = self.rules
        if rules.floor is not None and rules.drone.z[0] <= rules.floor:
            raise ValueError(f"rules.drone.z: {list(rules.drone.z)} must begin above rules.floor = {rules.floor}")
        for name, area in (("rules.drone", rules.drone), ("rules.goal", rules.goal)):
            if rules.walls:
                check_walls(name, area)

    @property
    def timing(self) -> Timing:
        """Decisions at HARL-A's 50 Hz."""
        return timing(self.rules.episode)

    def outline(self) -> Outline:
        """Summarise the task."""
        seat = AgentOutline("crazyflie", size("crazyflie", self.slots, 0, self.buffer), ACTION_SIZES["crazyflie"])
        (low, high), within = self.rules.goal.z, ", within walls" if self.rules.walls else ""
        height = f"{low:g} m" if low == high else f"{low:g} to {high:g} m"
        what = f"fly to within {self.rules.goal_radius:g} m of a point at {height}{within}"
        return Outline(what, {"red": (seat,)}, self.timing, "galaga")

    def build(self, **options: Unpack[EngineOptions]) -> "Fly":
        """Build the arena."""
        from arenas.games.galaga.fly import Fly

        return with_terms(Fly(self, **options), self)


PAPER_AIM = AimReward(hit=0.0, progress=0.0, aim=1.0)
"""HARL-A's reward of a tank that aims at a point."""
PAPER_FLY = FlyReward(reached=0.0, crash=0.0, progress=0.0, near=15.0, speed=-0.05)
"""HARL-A's reward of a single drone, a task of its own that leads to no match there."""

ARENAS = (
    AimSettings(),
    AimSettings("galaga-aim-2v2", "2v2", rules=AimRules(tank_speed=2.0)),
    FlySettings(),
    FlySettings(
        "galaga-fly-2v2", "2v2",
        rules=FlyRules(
            goal_radius=PAIRS.goal_radius, walls=True, drone=PAIRS.drones_at,
            goal=Area((2.0, 8.0), (-3.5, 3.5), (2.05, 2.05)),
        ),
    ),
)  # fmt: skip
