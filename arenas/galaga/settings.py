"""Settings of 3D Galaga's matches: tanks that aim against drones that fly. The game itself is `arenas/galaga/match.py`.

Nothing here loads jax or mujoco. `docs/arenas/galaga.md` says why each setting is what it is, and what of HARL-A's game
could not be read and is assumed.
"""

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, Unpack

from arenas.about import Outline, Seat
from arenas.galaga.layouts import Slots, size
from arenas.options import Timing, Where
from arenas.randomisation import Randomisation

if TYPE_CHECKING:
    from arenas.galaga.match import Galaga

CONTROL, TIMESTEP = 0.02, 0.005  # s, HARL-A's
FIELD = (9.75, 4.75)  # m from the centre to the walls along x and y
MARGIN = 0.3  # m that all leave to a wall at the start: half a tank with its barrel ahead
HULLS = {"tank": 0.5, "drone": 0.15}  # m, the circle that each needs for itself, whichever way it faces
ACTS = {"minitank": 2, "crazyflie": 4}  # numbers in an action

Span = tuple[float, float]


@dataclass(frozen=True)
class Area:
    """Where something is drawn, evenly: a box in metres; a span [3, 3] is a place."""

    x: Span = (0.0, 0.0)
    """Lowest and highest x, m."""
    y: Span = (0.0, 0.0)
    """Lowest and highest y, m."""
    z: Span = (0.0, 0.0)
    """Lowest and highest z, m; of tanks: of how much higher than standing they begin (HARL-A: 0.15, and drop)."""

    def __post_init__(self) -> None:
        """Check that each span is one."""
        for name, span in (("x", self.x), ("y", self.y), ("z", self.z)):
            if not (len(span) == 2 and -1000.0 <= span[0] <= span[1] <= 1000.0):
                raise ValueError(f"{name}: {list(span)} must be two numbers in metres, lowest and highest")
        if self.z[0] < 0.0:
            raise ValueError(f"z: {list(self.z)} must begin at the ground, 0, or above")


@dataclass(frozen=True)
class Defects:
    """Defects of HARL-A's Galaga that change what is learnt; each, when true, is reproduced. See `faithful`."""

    late_end: bool = False
    """One on one: a game ends a control step after what decided it, so that a drone at its goal is paid twice."""
    revive: bool = False
    """Two on two: who lives is judged anew in each control step: a drone that leaves the ray lives again."""
    paid_while_dead: bool = False
    """Two on two: `hit` is paid in every control step for every drone that is dead, not once."""
    drift: bool = False
    """Two on two: a dead drone's action is zeros, which is 0.95 weights: it sinks slowly instead of falling."""


@dataclass(frozen=True)
class GalagaRules:
    """What decides a match: with the bodies, these make the arena's configuration hash."""

    hit: Literal["aim", "ray"] = "aim"
    """When a drone is hit: the barrel's quaternion is near that of the way to it, or its ray passes near it."""
    aim_error: float = field(default=0.05, metadata={"above": 0.0, "high": 4.0})
    """`aim`: sum of the absolute differences of the two quaternions, or of their opposites, must be below this."""
    ray: float = field(default=1.5, metadata={"above": 0.0, "high": 10.0})
    """`ray`: metres from the drone to the ray that leaves the barrel, at most."""
    goal: Literal["point", "tank"] = "point"
    """Where a drone wants to be: at a point drawn at the start, or above the tank of its number, wherever that is."""
    goal_radius: float = field(default=0.2, metadata={"above": 0.0, "high": 5.0})
    """As near to its goal as this a drone has reached it, m."""
    goal_above: float = field(default=2.0, metadata={"low": 0.5, "high": 10.0})
    """`tank`: metres by which the goal is above the tank's base."""
    goals: int = field(default=1, metadata={"low": 1, "high": 16})
    """So many drones must reach their goals for their team to win; the tanks win when that is out of reach."""
    floor: float | None = field(default=0.25, metadata={"low": 0.0, "high": 5.0})
    """A drone at this height in metres or below is dead; none, as in HARL-A's game of one: it may lie and rise."""
    timeout: Literal["draw", "tanks", "drones"] = "draw"
    """No time left: cut off (truncated) as a draw, or an outcome: the tanks have held, or the drones have lived."""
    episode: float = field(default=20.0, metadata={"low": 1.0, "high": 600.0})
    """Seconds until time is up."""
    walls: bool = False
    """Four walls 2 m high round 20 x 10 m, as soccer's; drones can fly over them."""
    tank_speed: float = field(default=5.0, metadata={"low": 0.1, "high": 20.0})
    """A tank's joints turn at most this fast, rad/s (HARL-A's game of two: 2)."""
    tanks_at: Area = Area()
    """Where tanks begin; several of them side by side in lanes along y."""
    drones_at: Area = Area((-10.0, 10.0), (-10.0, 10.0), (3.0, 3.0))
    """Where drones begin, level and at rest; several of them in lanes along y."""
    goals_at: Area = Area((-10.0, 10.0), (-10.0, 10.0), (3.0, 6.0))
    """`point`: where goals are drawn, each for itself."""
    scatter: bool = True
    """Robots begin anywhere in their lanes, which they draw by lot; or each in the middle of the lane of its number."""
    heading: Literal["random", "fixed"] = "random"
    """Which way robots face at the start; fixed: +x, as HARL-A's."""
    barrel: Literal["random", "ahead"] = "random"
    """Where barrels point at the start: anywhere, as after a game (HARL-A's lone tank is never reset), or ahead."""
    defects: Defects = Defects()
    """Defects of the original to be reproduced."""


@dataclass(frozen=True)
class GalagaReward:
    """Weights of the reward's terms; `aim` and `approach` are hints that training.shaping_steps anneals."""

    hit: float = 1.0
    """To the tanks, once for each drone that dies (HARL-A: 1; two on two 200, in every control step)."""
    goal: float = 1.0
    """To the drones, once for each that reaches its goal (HARL-A: 1; two on two 100)."""
    loss: float = -1.0
    """To a team that has lost (HARL-A: 0)."""
    time: float = 0.0
    """To both per decision, whatever happens (HARL-A, two on two: 1)."""
    aim: float = 0.1
    """Hint to the tanks: per radian that the barrels came nearer to their targets, mean over the tanks."""
    approach: float = 0.05
    """Hint to the drones: per metre gained towards the goals, mean over the drones."""


PAPER_1V1 = GalagaReward(loss=0.0, aim=0.0, approach=0.0)
"""HARL-A's reward of the game of one."""
PAPER_2V2 = GalagaReward(hit=200.0, goal=100.0, loss=0.0, time=1.0, aim=0.0, approach=0.0)
"""HARL-A's reward of the game of two."""


DUEL = GalagaRules(floor=None)
"""HARL-A's rules of the game of one, without its defects."""
PAIRS = GalagaRules(
    hit="ray", goal="tank", goal_radius=0.5, walls=True, tank_speed=2.0, barrel="ahead",
    tanks_at=Area((2.0, 8.0), (-3.5, 3.5)), drones_at=Area((-8.0, -2.0), (-3.5, 3.5), (2.0, 4.0)),
)  # fmt: skip
"""HARL-A's rules of the game of two, without its defects."""


@dataclass(frozen=True)
class GalagaSettings:
    """A game of 3D Galaga: how many on each side, by which rules, what they see, and what learning is told."""

    name: str = "galaga-1v1"
    """The arena's name."""
    tanks: int = field(default=1, metadata={"low": 1, "high": 16})
    """MiniTanks, the team blue."""
    drones: int = field(default=1, metadata={"low": 1, "high": 16})
    """Crazyflies, the team red; tank k aims at drone k, drone k flies to the goal of tank k, modulo their numbers."""
    slots: Slots = "1v1"
    """HARL-A's observation of the game of one (a tank 10 numbers, a drone 12) or of two (18 and 20)."""
    rich: bool = False
    """Behind the slots tanks see every drone and its velocity, and drones every tank and where its barrel points."""
    buffer: int = field(default=0, metadata={"low": 0, "high": 1000})
    """Numbers after the slots, zeros where nothing needs them (the paper's ablation: 0, 50, 100)."""
    rules: GalagaRules = field(default_factory=GalagaRules)
    """What decides a match."""
    reward: GalagaReward = field(default_factory=GalagaReward)
    """What learning is told."""
    randomisation: Randomisation = field(default_factory=Randomisation)
    """What differs between episodes in the robots' bodies."""

    def __post_init__(self) -> None:
        """Check the goals asked for, and that all find room at the start."""
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
        """HARL-A's 50 Hz."""
        return timing(self.rules.episode)

    def outline(self) -> Outline:
        """The game in a line."""
        rules = self.rules
        how = f"whose ray passes within {rules.ray:g} m of" if rules.hit == "ray" else "that aim at"
        where = "a point" if rules.goal == "point" else f"{rules.goal_above:g} m above a tank"
        what = f"tanks {how} drones, which fly to {where}{', within walls' if rules.walls else ''}"
        seats = {
            "blue": (self._seat("minitank", self.drones),) * self.tanks,
            "red": (self._seat("crazyflie", self.tanks),) * self.drones,
        }
        return Outline(what, seats, self.timing, "galaga")

    def _seat(self, kind: str, enemies: int) -> Seat:
        return Seat(kind, size(kind, self.slots, enemies if self.rich else 0, self.buffer), ACTS[kind])

    def build(self, **where: Unpack[Where]) -> "Galaga":
        """The arena itself."""
        from arenas.galaga.match import Galaga

        return Galaga(self, **where)


def timing(episode: float) -> Timing:
    """Decisions at 50 Hz, physics at 200, an episode of so many seconds."""
    return Timing(TIMESTEP, round(CONTROL / TIMESTEP), 1, episode)


def check_lanes(name: str, area: Area, count: int, hull: float) -> None:
    """Raise ValueError where lanes along y for so many are narrower than each needs, m."""
    if count > 1 and (area.y[1] - area.y[0]) / count < hull - 1e-9:
        raise ValueError(
            f"{name}.y: {list(area.y)} is too narrow for {count} side by side, each {hull:g} m;"
            f" at least {math.ceil(100 * count * hull) / 100:g} m"
        )


def check_walls(name: str, area: Area) -> None:
    """Raise ValueError where something would begin in a wall, or beyond it."""
    for axis, span, wall in (("x", area.x, FIELD[0]), ("y", area.y, FIELD[1])):
        room = wall - MARGIN
        if span[0] < -room or span[1] > room:
            raise ValueError(f"{name}.{axis}: {list(span)} reaches into a wall; between {-room:g} and {room:g}")


def faithful(settings: GalagaSettings) -> GalagaSettings:
    """The same arena with every defect of the original's game of that size, and all robots where its robots begin.

    The game of one keeps its barrel, which points anywhere: its tank is never reset.
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
