"""Settings of 3D Galaga's matches: tanks that aim against drones that fly. The game itself is
`arenas/games/galaga/match.py`.

Nothing here loads jax or mujoco. `docs/arenas/galaga.md` explains each setting, and lists the parts of HARL-A's game
that could not be read and are assumed.
"""

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, Unpack

from arenas.arena_settings import EngineOptions, Timing
from arenas.description import AgentOutline, Outline
from arenas.games.galaga.observation_layout import Slots, size
from arenas.games.terms import RewardTerms, WithTerms, with_terms
from arenas.scene.randomisation import Randomisation

if TYPE_CHECKING:
    from arenas.games.galaga.match import Galaga

CONTROL, TIMESTEP = 0.02, 0.005  # s, HARL-A's
FIELD = (9.75, 4.75)  # m from the centre to the walls along x and y
MARGIN = 0.3  # m, minimum distance to a wall at the start: half a tank with its barrel ahead
HULLS = {"tank": 0.5, "drone": 0.15}  # m, diameter of the circle that each needs, in any heading
ACTION_SIZES = {"minitank": 2, "crazyflie": 4}  # numbers in an action

Span = tuple[float, float]


@dataclass(frozen=True)
class Area:
    """A box in metres in which places are drawn uniformly; a span [3, 3] is a single value."""

    x: Span = (0.0, 0.0)
    """Lowest and highest x, m."""
    y: Span = (0.0, 0.0)
    """Lowest and highest y, m."""
    z: Span = (0.0, 0.0)
    """Lowest and highest z, m; for tanks: height above standing at the start (HARL-A: 0.15, and they drop)."""

    def __post_init__(self) -> None:
        """Check that each span is valid."""
        for name, span in (("x", self.x), ("y", self.y), ("z", self.z)):
            if not (len(span) == 2 and -1000.0 <= span[0] <= span[1] <= 1000.0):
                raise ValueError(f"{name}: {list(span)} must be two numbers in metres, lowest and highest")
        if self.z[0] < 0.0:
            raise ValueError(f"z: {list(self.z)} must begin at the ground, 0, or above")


@dataclass(frozen=True)
class Defects:
    """Defects of HARL-A's Galaga that change learning; each, when true, is reproduced. See `faithful`."""

    late_end: bool = False
    """1v1: a game ends one control step after the deciding one, so that a drone at its goal is paid twice."""
    revive: bool = False
    """2v2: drones are judged anew in each control step: a drone that leaves the ray lives again."""
    paid_while_dead: bool = False
    """2v2: `hit` is paid in every control step for every dead drone, not once."""
    drift: bool = False
    """2v2: a dead drone's action is zeros, which is 0.95 weights: it sinks slowly instead of falling."""


@dataclass(frozen=True)
class GalagaRules:
    """Rules that decide a match: with the bodies, these make the arena's configuration hash."""

    hit: Literal["aim", "ray"] = "aim"
    """Condition of a hit: the barrel's quaternion is close to that of the drone's direction, or its ray passes near it.
    """
    aim_error: float = field(default=0.05, metadata={"above": 0.0, "high": 4.0})
    """`aim`: sum of the absolute differences of the two quaternions, or of their opposites, must be below this."""
    ray: float = field(default=1.5, metadata={"above": 0.0, "high": 10.0})
    """`ray`: maximum distance in metres from the drone to the barrel's ray."""
    goal: Literal["point", "tank"] = "point"
    """A drone's goal: a point drawn at the start, or above the tank of its index, which may move."""
    goal_radius: float = field(default=0.2, metadata={"above": 0.0, "high": 5.0})
    """Distance to its goal, in metres, at which a drone has reached it."""
    goal_above: float = field(default=2.0, metadata={"low": 0.5, "high": 10.0})
    """`tank`: height of the goal above the tank's base, in metres."""
    goals: int = field(default=1, metadata={"low": 1, "high": 16})
    """Number of drones that must reach their goals for their team to win; the tanks win when that is out of reach."""
    floor: float | None = field(default=0.25, metadata={"low": 0.0, "high": 5.0})
    """Height in metres at or below which a drone is dead; none, as in HARL-A's 1v1 game: it may land and rise."""
    timeout: Literal["draw", "tanks", "drones"] = "draw"
    """End of time: a draw that cuts the game off (truncated), or a win of the tanks or of the drones."""
    episode: float = field(default=20.0, metadata={"low": 1.0, "high": 600.0})
    """Seconds until time is up."""
    walls: bool = False
    """Four walls 2 m high round 20 x 10 m, as in soccer; drones can fly over them."""
    tank_speed: float = field(default=5.0, metadata={"low": 0.1, "high": 20.0})
    """Maximum speed of a tank's joints, rad/s (HARL-A's 2v2 game: 2)."""
    tanks_at: Area = Area()
    """Area of the tanks' starts; several tanks start side by side in lanes along y."""
    drones_at: Area = Area((-10.0, 10.0), (-10.0, 10.0), (3.0, 3.0))
    """Area of the drones' starts, level and at rest; several drones start in lanes along y."""
    goals_at: Area = Area((-10.0, 10.0), (-10.0, 10.0), (3.0, 6.0))
    """`point`: area in which each goal is drawn."""
    scatter: bool = True
    """Robots start anywhere in randomly assigned lanes; otherwise each in the middle of the lane of its index."""
    heading: Literal["random", "fixed"] = "random"
    """Headings at the start; fixed: +x, as HARL-A's."""
    barrel: Literal["random", "ahead"] = "random"
    """Barrels at the start: anywhere, as after a game (HARL-A's single tank is never reset), or ahead."""
    defects: Defects = Defects()
    """Defects of the original to reproduce."""


@dataclass(frozen=True)
class GalagaReward(RewardTerms):
    """Weights of the reward's terms; `aim` and `approach` are shaping that training.shaping_steps anneals."""

    ENDINGS = ("loss",)

    hit: float = 1.0
    """To the tanks, once for each drone that dies (HARL-A: 1; in 2v2 200, in every control step)."""
    goal: float = 1.0
    """To the drones, once for each that reaches its goal (HARL-A: 1; in 2v2 100)."""
    loss: float = -1.0
    """To the losing team (HARL-A: 0)."""
    time: float = 0.0
    """To both per decision, in any case (HARL-A's 2v2: 1)."""
    aim: float = 0.1
    """Shaping for the tanks: per radian by which barrels approached their targets, mean over the tanks."""
    approach: float = 0.05
    """Shaping for the drones: per metre gained towards the goals, mean over the drones."""


PAPER_1V1 = GalagaReward(loss=0.0, aim=0.0, approach=0.0)
"""HARL-A's reward of the 1v1 game."""
PAPER_2V2 = GalagaReward(hit=200.0, goal=100.0, loss=0.0, time=1.0, aim=0.0, approach=0.0)
"""HARL-A's reward of the 2v2 game."""


DUEL = GalagaRules(floor=None)
"""HARL-A's rules of the 1v1 game, without its defects."""
PAIRS = GalagaRules(
    hit="ray", goal="tank", goal_radius=0.5, walls=True, tank_speed=2.0, barrel="ahead",
    tanks_at=Area((2.0, 8.0), (-3.5, 3.5)), drones_at=Area((-8.0, -2.0), (-3.5, 3.5), (2.0, 4.0)),
)  # fmt: skip
"""HARL-A's rules of the 2v2 game, without its defects."""


@dataclass(frozen=True)
class GalagaSettings(WithTerms):
    """A game of 3D Galaga: numbers of robots, rules, observations and rewards."""

    name: str = "galaga-1v1"
    """The arena's name."""
    tanks: int = field(default=1, metadata={"low": 1, "high": 16})
    """MiniTanks, the team blue."""
    drones: int = field(default=1, metadata={"low": 1, "high": 16})
    """Crazyflies, the team red; tank k aims at drone k, drone k flies to the goal of tank k, modulo their numbers."""
    slots: Slots = "1v1"
    """HARL-A's observation of the 1v1 game (a tank 10 numbers, a drone 12) or of the 2v2 game (18 and 20)."""
    rich: bool = False
    """After the slots, tanks observe every drone and its velocity, and drones every tank and its barrel's direction."""
    buffer: int = field(default=0, metadata={"low": 0, "high": 1000})
    """Numbers after the slots, zeros if nothing needs them (the paper's ablation: 0, 50, 100)."""
    rules: GalagaRules = field(default_factory=GalagaRules)
    """Rules that decide a match."""
    reward: GalagaReward = field(default_factory=GalagaReward)
    """Rewards for learning."""
    randomisation: Randomisation = field(default_factory=Randomisation)
    """Random differences between episodes in the robots' bodies."""

    def __post_init__(self) -> None:
        """Check the number of goals, and that there is room for all at the start."""
        rules = self.rules
        if rules.goals > max(1, self.drones):
            raise ValueError(f"rules.goals: {rules.goals} is more than the drones, {self.drones}; 1 to all of them")
        for what, count, area in (("tank", self.tanks, rules.tanks_at), ("drone", self.drones, rules.drones_at)):
            check_lanes(f"rules.{what}s_at", area, count, HULLS[what])
            if rules.walls:
                check_walls(f"rules.{what}s_at", area)
        if rules.floor is not None and rules.drones_at.z[0] <= rules.floor:
            raise ValueError(
                f"rules.drones_at.z: {list(rules.drones_at.z)} must begin above rules.floor = {rules.floor}"
            )

    @property
    def timing(self) -> Timing:
        """Decisions at HARL-A's 50 Hz."""
        return timing(self.rules.episode)

    def outline(self) -> Outline:
        """Summarise the game."""
        rules = self.rules
        how = f"whose ray passes within {rules.ray:g} m of" if rules.hit == "ray" else "that aim at"
        where = "a point" if rules.goal == "point" else f"{rules.goal_above:g} m above a tank"
        what = f"tanks {how} drones, which fly to {where}{', within walls' if rules.walls else ''}"
        seats = {
            "blue": (self._agent_outline("minitank", self.drones),) * self.tanks,
            "red": (self._agent_outline("crazyflie", self.tanks),) * self.drones,
        }
        return Outline(what, seats, self.timing, "galaga")

    def _agent_outline(self, kind: str, enemies: int) -> AgentOutline:
        return AgentOutline(kind, size(kind, self.slots, enemies if self.rich else 0, self.buffer), ACTION_SIZES[kind])

    def build(self, **options: Unpack[EngineOptions]) -> "Galaga":
        """Build the arena."""
        from arenas.games.galaga.match import Galaga

        return with_terms(Galaga(self, **options), self)


def timing(episode: float) -> Timing:
    """Return decisions at 50 Hz, physics at 200, an episode of so many seconds."""
    return Timing(TIMESTEP, round(CONTROL / TIMESTEP), 1, episode)


def check_lanes(name: str, area: Area, count: int, hull: float) -> None:
    """Raise ValueError if lanes along y for so many robots are narrower than `hull`, m."""
    if count > 1 and (area.y[1] - area.y[0]) / count < hull - 1e-9:
        raise ValueError(
            f"{name}.y: {list(area.y)} is too narrow for {count} side by side, each {hull:g} m;"
            f" at least {math.ceil(100 * count * hull) / 100:g} m"
        )


def check_walls(name: str, area: Area) -> None:
    """Raise ValueError if an area reaches into a wall, or beyond it."""
    for axis, span, wall in (("x", area.x, FIELD[0]), ("y", area.y, FIELD[1])):
        room = wall - MARGIN
        if span[0] < -room or span[1] > room:
            raise ValueError(f"{name}.{axis}: {list(span)} reaches into a wall; between {-room:g} and {room:g}")


def faithful(settings: GalagaSettings) -> GalagaSettings:
    """Return the same arena with every defect and the start places of the original's game of that size.

    The 1v1 game keeps its random barrels, because the original's tank is never reset.
    """
    rules = settings.rules
    if settings.slots == "1v1":
        return replace(settings, rules=replace(rules, heading="fixed", defects=Defects(late_end=True)))
    defects = Defects(revive=True, paid_while_dead=True, drift=True)
    tanks, drones = Area((3.0, 3.0), (-1.0, 1.0), (0.15, 0.15)), Area((-3.0, -3.0), (-0.2, 0.2), (3.0, 3.0))
    started = replace(
        rules, tanks_at=tanks, drones_at=drones, scatter=False, heading="fixed", barrel="ahead", defects=defects
    )
    return replace(settings, rules=started)


ARENAS = (GalagaSettings(rules=DUEL), GalagaSettings("galaga-2v2", 2, 2, "2v2", rules=PAIRS))
