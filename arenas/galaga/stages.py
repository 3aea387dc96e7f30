"""Settings of the stages before Galaga's matches: a tank alone that aims at a point, a drone alone that flies to one.

Nothing here loads jax or mujoco. Each stage has the observation of the match that it leads to (`slots`, `buffer`), with
zeros where nobody is. A reward's fields are its terms. `docs/arenas/galaga.md` says why each setting is what it is.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, Unpack

from arenas.about import Outline, Seat
from arenas.galaga.layouts import Slots, size
from arenas.galaga.settings import ACTS, PAIRS, Area, GalagaRules, check_walls, timing
from arenas.options import Timing, Where
from arenas.randomisation import Randomisation

if TYPE_CHECKING:
    from arenas.galaga.aim import Aim
    from arenas.galaga.fly import Fly


TARGETS = Area((-10.0, 10.0), (-10.0, 10.0), (0.5, 10.0))  # m, HARL-A's

# A tank that aims -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class AimRules:
    """What success is: with the body, these make the arena's configuration hash."""

    aim_error: float = field(default=0.05, metadata={"above": 0.0, "high": 4.0})
    """As in a match: the two quaternions' L1 distance must be below this."""
    target: Area = TARGETS
    """Where the target is drawn, m; the tank stands at the centre."""
    nearest: float = field(default=3.0, metadata={"low": 0.0, "high": 10.0})
    """A target's x and y are each pushed out to this distance from the tank, m."""
    episode: float = field(default=20.0, metadata={"low": 1.0, "high": 600.0})
    """Seconds that it may take; then the attempt is cut."""
    tank_speed: float = field(default=5.0, metadata={"low": 0.1, "high": 20.0})
    """The tank's joints turn at most this fast, rad/s, as in the match to come."""
    heading: Literal["random", "fixed"] = "random"
    """Which way the tank faces at the start; fixed: +x, as HARL-A's."""
    barrel: Literal["random", "ahead"] = "random"
    """Where its barrel points at the start."""


@dataclass(frozen=True)
class AimReward:
    """Weights of the reward's terms; all stay, none is annealed."""

    hit: float = 1.0
    """Once, when the barrel points at the target (HARL-A: 0)."""
    progress: float = 0.5
    """Per radian that the barrel came nearer to the target (HARL-A: 0)."""
    aim: float = 0.0
    """Per second: exp(-L1 distance of the quaternions) (HARL-A: 1, where nothing else is paid and nothing ends it)."""


@dataclass(frozen=True)
class AimSettings:
    """A tank alone that shall point at a target in time."""

    name: str = "galaga-aim-1v1"
    """The arena's name."""
    slots: Slots = "1v1"
    """The observation, that of the match to come: 10 numbers or 18."""
    buffer: int = field(default=0, metadata={"low": 0, "high": 1000})
    """Zeros behind it, as many as the match to come has numbers there."""
    rules: AimRules = field(default_factory=AimRules)
    """What success is."""
    reward: AimReward = field(default_factory=AimReward)
    """What learning is told."""
    randomisation: Randomisation = field(default_factory=Randomisation)
    """What differs between episodes in the robot's body."""

    @property
    def timing(self) -> Timing:
        """HARL-A's 50 Hz."""
        return timing(self.rules.episode)

    def outline(self) -> Outline:
        """The task in a line."""
        seat = Seat("minitank", size("minitank", self.slots, 0, self.buffer), ACTS["minitank"])
        what = f"point at a target up to {self.rules.target.x[1]:g} m away along either axis"
        return Outline(what, {"blue": (seat,)}, self.timing, "galaga")

    def build(self, **where: Unpack[Where]) -> "Aim":
        """The arena itself."""
        from arenas.galaga.aim import Aim

        return Aim(self, **where)


# A drone that flies ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FlyRules:
    """What success is: with the body, these make the arena's configuration hash."""

    goal_radius: float = field(default=0.2, metadata={"above": 0.0, "high": 5.0})
    """As near to its goal as this the drone has reached it, m."""
    floor: float | None = field(default=0.25, metadata={"low": 0.0, "high": 5.0})
    """At this height in metres or below it has crashed; none: it may lie and rise."""
    drone: Area = GalagaRules.drones_at
    """Where it begins, level and at rest, m."""
    goal: Area = GalagaRules.goals_at
    """Where its goal is drawn, m."""
    episode: float = field(default=20.0, metadata={"low": 1.0, "high": 600.0})
    """Seconds that it may take; then the attempt is cut."""
    walls: bool = False
    """The walls of the match of two."""
    heading: Literal["random", "fixed"] = "random"
    """Which way it faces at the start; fixed: +x, as HARL-A's."""


@dataclass(frozen=True)
class FlyReward:
    """Weights of the reward's terms; all stay, none is annealed."""

    reached: float = 5.0
    """Once, when it is at its goal."""
    crash: float = -5.0
    """Once, when it has come too low."""
    progress: float = 1.0
    """Per metre gained towards the goal."""
    near: float = 0.0
    """Per second: exp(-metres to the goal) (HARL-A's task of a drone alone: 15)."""
    speed: float = 0.0
    """Per second: square of the velocity, m/s (the same: -0.05)."""
    rates: float = -0.01
    """Per second: squares of the rates, rad/s (the same: -0.01)."""


@dataclass(frozen=True)
class FlySettings:
    """A drone alone that shall fly to a point in time."""

    name: str = "galaga-fly-1v1"
    """The arena's name."""
    slots: Slots = "1v1"
    """The observation, that of the match to come: 12 numbers or 20."""
    buffer: int = field(default=0, metadata={"low": 0, "high": 1000})
    """Zeros behind it, as many as the match to come has numbers there."""
    rules: FlyRules = field(default_factory=FlyRules)
    """What success is."""
    reward: FlyReward = field(default_factory=FlyReward)
    """What learning is told."""
    randomisation: Randomisation = field(default_factory=Randomisation)
    """What differs between episodes in the robot's body."""

    def __post_init__(self) -> None:
        """Check that the drone begins in the air, and both within the walls."""
        rules = self.rules
        if rules.floor is not None and rules.drone.z[0] <= rules.floor:
            raise ValueError(f"rules.drone.z: {list(rules.drone.z)} must begin above rules.floor = {rules.floor}")
        for name, area in (("rules.drone", rules.drone), ("rules.goal", rules.goal)):
            if rules.walls:
                check_walls(name, area)

    @property
    def timing(self) -> Timing:
        """HARL-A's 50 Hz."""
        return timing(self.rules.episode)

    def outline(self) -> Outline:
        """The task in a line."""
        seat = Seat("crazyflie", size("crazyflie", self.slots, 0, self.buffer), ACTS["crazyflie"])
        (low, high), within = self.rules.goal.z, ", within walls" if self.rules.walls else ""
        height = f"{low:g} m" if low == high else f"{low:g} to {high:g} m"
        what = f"fly to within {self.rules.goal_radius:g} m of a point at {height}{within}"
        return Outline(what, {"red": (seat,)}, self.timing, "galaga")

    def build(self, **where: Unpack[Where]) -> "Fly":
        """The arena itself."""
        from arenas.galaga.fly import Fly

        return Fly(self, **where)


PAPER_AIM = AimReward(hit=0.0, progress=0.0, aim=1.0)
"""HARL-A's reward of a tank that aims at a point."""
PAPER_FLY = FlyReward(reached=0.0, crash=0.0, progress=0.0, near=15.0, speed=-0.05)
"""HARL-A's reward of a drone that flies alone, a task of its own that leads to no match there."""

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
