"""Rules common to all arenas of soccer: field, ball, drives of robots. Loads neither jax nor mujoco."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from arenas.arena_settings import Timing
from arenas.description import AgentOutline
from arenas.games.soccer.observation_layout import own_size, size
from arenas.games.sumo.settings import points_within
from arenas.robots.kinds import kind_of, roster_name

CONTROL = 0.02  # s, a control step, and a decision
WALL, WALL_HEIGHT = 0.5, 2.0  # m
GRAVITY = 9.81  # m/s²
HOLLOW = 2.0 / 3.0  # moment of inertia of a thin shell, of mass · radius²
SPACING = 1.0  # m between the possible start points


@dataclass(frozen=True)
class Ball:
    """The ball. HARL-A's is in no public file: this one is a football on artificial turf."""

    radius: float = field(default=0.11, metadata={"low": 0.03, "high": 0.5})
    """Metres. A football of size 5 measures 68 to 70 cm round: 0.108 to 0.111 m."""
    mass: float = field(default=0.43, metadata={"low": 0.01, "high": 20.0})
    """kg. A football of size 5 weighs 0.41 to 0.45 kg, all of it in its skin."""
    restitution: float = field(default=0.6, metadata={"low": 0.05, "high": 0.95})
    """Share of its speed after a bounce. FIFA's turf: from 2 m it bounces back to 0.6 to 0.85 m, so 0.6."""
    roll_loss: float = field(default=1.0, metadata={"low": 0.0, "high": 10.0})
    """m/s lost per second of rolling. FIFA's turf: off a ramp of 1 m it rolls 4 to 8 m, so 0.7 to 1.5."""
    spin_loss: float = field(default=10.0, metadata={"low": 0.0, "high": 100.0})
    """rad/s lost per second of spinning on the spot (assumed)."""
    sliding: float = field(default=0.5, metadata={"low": 0.05, "high": 2.0})
    """Friction while it slides, on the ground and along robots (assumed)."""

    @property
    def friction(self) -> tuple[float, float, float]:
        """MuJoCo's sliding, torsional and rolling friction, the last two in metres, from the losses above.

        A torque of friction · weight slows the spin by itself over the moment of inertia k·m·r². A rolling ball is also
        slowed by the ground's force that keeps it rolling: by torque / (m·r·(1 + k)).
        """
        spinning = self.spin_loss * HOLLOW * self.radius**2 / GRAVITY
        rolling = self.roll_loss * (1.0 + HOLLOW) * self.radius / GRAVITY
        return self.sliding, spinning, rolling


@dataclass(frozen=True)
class Defects:
    """Defects of HARL-A's soccer that change the game; each, when true, is reproduced. See `faithful`."""

    spawn_overlap: bool = False
    """Robots and ball start on any two points of the lattice, 1 m apart: ANYmals may overlap at the start."""
    dropped: bool = False
    """Robots start above the ground and fall: ANYmals in stages from 0.60 m, rovers from 0.50 m, in matches 0.30 m."""
    throttle_unclamped: bool = False
    """`wheel_limit` is ignored: a large action drives the wheels as fast as the motors can."""
    steering_unclamped: bool = False
    """Steering servos get commands up to ±10 rad, as in its rovers' stage; stops at 0.75 rad hold the wheels."""


@dataclass(frozen=True)
class PitchRules:
    """Field, ball and robots."""

    pitch: tuple[float, float] = (20.0, 10.0)
    """Metres along x and y between the middles of the walls, which are 0.5 m thick and 2 m high."""
    goal: tuple[float, float] = (1.0, 3.0)
    """Metres along x and y of a goal: a part of the ground, without posts or net."""
    goal_at: float = field(default=9.25, metadata={"above": 0.0})
    """Metres from the field's centre to a goal's centre (HARL-A's ANYmals in stages 1 and 2: 9.0)."""
    ball: Ball = field(default_factory=Ball)
    """The ball's properties."""
    heading: Literal["random", "fixed"] = "random"
    """Headings at the start: random for each robot, or all -x, as HARL-A's."""
    ceiling: float = field(default=5.0, metadata={"above": 0.5})
    """A robot higher than this, in metres, was launched: the episode is cut off. HARL-A's rovers did fly."""
    fall_height: float = field(default=0.10, metadata={"low": 0.0, "high": 0.5})
    """ANYmals: a robot has fallen if its torso's centre of mass is below this, m; with the belly on the ground it is at
    0.1."""
    fall_up: float = field(default=0.3, metadata={"low": -1.0, "high": 1.0})
    """ANYmals: a robot has also fallen if world z of its up axis is below this (HARL-A: -1, no such rule)."""
    drive_scale: float = field(default=10.0, metadata={"low": 1.0, "high": 100.0})
    """Rovers: wheel speed for throttle 1, rad/s."""
    steer_scale: float = field(default=0.1, metadata={"low": 0.01, "high": 0.75})
    """Rovers: steering angle for steering 1, rad."""
    wheel_limit: float | None = field(default=50.0, metadata={"above": 0.0})
    """Rovers: wheel speed is clamped to ± this after scaling, rad/s: 50 is 2.6 m/s. None: no clamping."""
    defects: Defects = field(default_factory=Defects)
    """Defects of the original to reproduce."""

    def __post_init__(self) -> None:
        """Check that the goals lie within the walls."""
        length, width = self.pitch
        if not (6.0 <= length <= 200.0 and 6.0 <= width <= 200.0):
            raise ValueError(f"pitch: {list(self.pitch)} must be two lengths in metres, each from 6 to 200")
        (deep, wide), (x, y) = self.goal, self.inside
        if not (deep >= 0.1 and 0.1 <= wide <= 2 * y):
            raise ValueError(
                f"goal: {list(self.goal)} must be two lengths in metres from 0.1 on, the second to {2 * y:g}"
            )
        if not deep / 2 <= self.goal_at <= x - deep / 2 + 1e-9:
            raise ValueError(
                f"goal_at: {self.goal_at} m must be from {deep / 2:g} to {x - deep / 2:g} m, for goals to lie within"
                " the walls"
            )

    @property
    def inside(self) -> tuple[float, float]:
        """Metres from the centre to the walls, along x and y."""
        return self.pitch[0] / 2 - WALL / 2, self.pitch[1] / 2 - WALL / 2

    @property
    def lattice(self) -> list[tuple[float, float]]:
        """Possible start points, 1 m apart, at least 0.75 m from a wall, and not in a goal."""
        nx, ny = (math.floor(side / 2 - 1.0) for side in self.pitch)
        points = ((float(x), float(y)) for x in range(-nx, nx + 1) for y in range(-ny, ny + 1))
        return [at for at in points if not self.in_goal(at)]

    def in_goal(self, at: tuple[float, float]) -> bool:
        """Return whether a point is in one of the two goals."""
        return abs(abs(at[0]) - self.goal_at) <= self.goal[0] / 2 and abs(at[1]) <= self.goal[1] / 2

    def clear(self, kinds: Sequence[str]) -> tuple[float, ...]:
        """Return radii in metres of the circles that robots of these kinds, and then the ball, need."""
        if self.defects.spawn_overlap:
            return (SPACING / 2,) * (len(kinds) + 1)
        return *(kind_of(kind).hull / 2 for kind in kinds), self.ball.radius

    def check_room(self, kinds: Sequence[str]) -> None:
        """Raise ValueError if robots of these kinds might find no place to start."""
        clear, points = self.clear(kinds), len(self.lattice)
        # Each placed object rules out at most the points nearer to it than the sum of the two radii.
        taken = max(sum(points_within(mine + theirs, SPACING) for theirs in clear[:i]) for i, mine in enumerate(clear))
        if taken >= points:
            raise ValueError(
                f"rules.pitch: {len(kinds)} robots may find no room on the {points} points of {list(self.pitch)} m;"
                " make it larger, or the teams smaller"
            )


def timing(episode: float) -> Timing:
    """Return HARL-A's timing: decisions at 50 Hz, physics at 200 Hz."""
    return Timing(0.005, 4, 1, episode)


def agent_outline(kind: str, extra: int, buffer: int) -> AgentOutline:
    """Return the outline of a robot that observes `extra` robots more than have vectors."""
    return AgentOutline(roster_name(kind), size(own_size(kind), extra, buffer), kind_of(kind).action_size)
