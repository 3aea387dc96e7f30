"""Settings of sumo's matches: robots and rules. The game itself is `arenas/games/sumo/match.py`.

Nothing here loads jax or mujoco: a configuration is read and written without them. `docs/arenas/sumo.md` explains each
setting.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Literal, Unpack

from arenas.arena_settings import EngineOptions, Timing
from arenas.description import AgentOutline, Outline
from arenas.games.sumo.observation_layout import OWN, PER_OTHER, size
from arenas.games.terms import RewardTerms, WithTerms, with_terms
from arenas.robots.kinds import KINDS, Kind, check_roster, is_file, kind_of, roster_name
from arenas.scene.randomisation import Randomisation

if TYPE_CHECKING:
    from arenas.games.sumo.match import Sumo

__all__ = ["ARENAS", "KINDS", "Kind", "SumoReward", "SumoRules", "SumoSettings", "check_roster"]

CONTROL = 0.02  # s, a control step
TIMESTEP = CONTROL / 3
"""Physics timestep in seconds for matches with ANYmals; HARL-A has 0.005. A GPU then makes a quarter more control
steps, and each of them ends 0.4 mm and 0.04 rad of a joint from a solution with 0.001 s, instead of 0.3 and 0.025
(experiments/notes/speed.md)."""
NEAREST, FARTHEST = 0.35, 0.75  # start range of robots on a diameter, as shares of the ring's radius
WOBBLE = 0.25  # rad, maximum offset of a team from the diameter
PITCH = 0.5  # m between the points of the lattice
OVERLAPPING = 0.6  # m between robots at HARL-A's starts; an ANYmal is 1.05 m long


SPARE_CONTACTS, SPARE_ROWS = 4, 16  # of every world

ITERATIONS = 14
"""Newton's cap in matches. On a GPU all worlds wait for the slowest: with 20, a twentieth of the steps is lost.

One control step ends 0.7 mm from a converged solution (99.99th percentile of 32,768 of trained play of two ANYmals
against two rovers; 3.7 mm at most, as with 20; of scripts within a team 1.2 mm). The timestep causes an error of 5 mm
in one of a thousand steps (experiments/notes/speed.md).
"""


@dataclass(frozen=True)
class SumoReward(RewardTerms):
    """Rewards, which shape learning and never decide a match."""

    ENDINGS = ("scale",)

    scale: float = field(default=1.0, metadata={"above": 0.0})
    """Reward for a win, and cost of a loss; the paper's is 10."""
    timeout_penalty: float = field(default=0.5, metadata={"low": 0.0})
    """Penalty for both teams when the time is up, as a share of `scale`; the paper's is 1, as much as a loss."""
    approach: float = 0.2
    """Shaping: per metre gained towards the nearest enemy, mean over the team."""
    push: float = 1.0
    """Shaping: per metre that enemies moved outwards less that of the own robots, means over the teams."""
    clip: float = field(default=2.0, metadata={"low": 0.0})
    """Shaping is limited to ± this, per second."""


@dataclass(frozen=True)
class Defects:
    """Defects of HARL-A's sumo that change learning; each, when true, is reproduced. See `faithful`."""

    spawn_overlap: bool = False
    """On the lattice robots start 0.6 m apart, whatever their size: ANYmals may overlap at the start."""
    throttle_unclamped: bool = False
    """`wheel_limit` is ignored: a large action drives the wheels as fast as the motors can."""
    falls_uncounted: bool = False
    """A fall ends the match and costs reward, but the score counts ring-outs alone: a fall is a draw."""


@dataclass(frozen=True)
class SumoRules:
    """Rules that decide a match: with the bodies, these make the arena's configuration hash."""

    ring: tuple[float, float] = (1.6, 2.2)
    """Ring radius in metres, drawn uniformly per episode."""
    episode: float = field(default=10.0, metadata={"low": 1.0, "high": 600.0})
    """Seconds until time is up: a draw."""
    shrink_after: float = field(default=5.0, metadata={"low": 0.0})
    """Seconds until the ring starts to shrink (at least `episode`: never)."""
    shrink_to: float = field(default=0.2, metadata={"low": 0.05, "high": 1.0})
    """Share of its radius that the ring keeps when time is up. Two rovers fit into 0.3 m and more, and may wait there.
    """
    spawn: Literal["diameter", "lattice"] = "diameter"
    """Start places: teams on opposite sides of a random diameter, or anywhere on a lattice, as in the paper."""
    spacing: float = field(default=1.2, metadata={"low": 0.1, "high": 10.0})
    """On the lattice: minimum distance in metres between the centres of two robots."""
    heading: Literal["random", "fixed"] = "random"
    """Headings at the start: random for each robot, or all +y, as HARL-A's: a policy then need not turn."""
    decide_every: int = field(default=5, metadata={"low": 1, "high": 50})
    """Control steps (50 Hz) for which an action is held: 5 decides at 10 Hz, 1 is the paper's 50 Hz."""
    timestep: float = field(default=0.01, metadata={"low": 0.001, "high": 0.02})
    """Physics timestep in seconds; a control step of 0.02 s must hold a whole number of them."""
    drive_scale: float = field(default=60.0, metadata={"low": 1.0, "high": 100.0})
    """Rovers: wheel speed for throttle 1, rad/s: 60 is 3.1 m/s; the paper's is 10."""
    steer_scale: float = field(default=0.6, metadata={"low": 0.01, "high": 0.75})
    """Rovers: steering angle for steering 1, rad; the paper's is 0.1."""
    drive_limit: float | None = field(default=1.0, metadata={"above": 0.0})
    """Rovers: throttle and steering are clipped to ± this before scaling; none, the paper's: no clipping."""
    wheel_limit: float | None = field(default=None, metadata={"above": 0.0})
    """Rovers: wheel speed is clamped to ± this after scaling, rad/s; the paper's is 50. None: no clamping."""
    fall_height: float = field(default=0.10, metadata={"low": 0.0, "high": 0.5})
    """ANYmals: a robot has fallen if its torso's centre of mass is below this, m; with the belly on the ground it is at
    0.1."""
    fall_up: float = field(default=-1.0, metadata={"low": -1.0, "high": 1.0})
    """ANYmals: a robot has fallen if world z of its up axis is below this; -1, the paper's: no such rule."""
    defects: Defects = field(default_factory=Defects)
    """Defects of the original to reproduce."""

    def __post_init__(self) -> None:
        """Check constraints between two fields or within one."""
        if not 0.5 <= self.ring[0] <= self.ring[1] <= 20.0:
            raise ValueError(f"ring: {list(self.ring)} must be two radii in metres, 0.5 <= smallest <= largest <= 20")
        steps = 0.02 / self.timestep
        if abs(steps - round(steps)) > 1e-6:
            raise ValueError(
                f"timestep: 0.02 s is no whole number of {self.timestep} s; use 0.02, 0.01, 0.005 or 0.004"
            )

    @property
    def spawn_distance(self) -> float:
        """Metres between the centres of robots that start on the lattice."""
        return OVERLAPPING if self.defects.spawn_overlap else self.spacing


@dataclass(frozen=True)
class SumoSettings(WithTerms):
    """A sumo arena: robots, rules, observations and rewards."""

    name: str = "sumo-2v2"
    """The arena's name."""
    blue: tuple[str, ...] = ("leatherback", "leatherback")
    """Blue's robots, by kind: leatherback, anymal, minitank, ant, go1, ... or a file (docs/robots.md); any number."""
    red: tuple[str, ...] = ("leatherback", "leatherback")
    """Red's robots; the teams may differ in size and kind."""
    observation: Literal["rich", "slots"] = "rich"
    """Observations of robots: everything about all robots, or the paper's slots, which stages of a curriculum share."""
    buffer: int = field(default=0, metadata={"low": 0, "high": 1000})
    """Slots: numbers after them, zeros if no robot needs them; the paper's ablation has 0, 50 and 100."""
    rules: SumoRules = field(default_factory=SumoRules)
    """Rules that decide a match."""
    reward: SumoReward = field(default_factory=SumoReward)
    """Rewards for learning."""
    randomisation: Randomisation = field(default_factory=Randomisation)
    """Random differences between episodes in the robots' bodies."""

    def __post_init__(self) -> None:
        """Check the rosters, and that there is room for all robots at the start."""
        check_roster("blue", self.blue)
        check_roster("red", self.red)
        if self.observation == "slots" and any(map(is_file, self.blue + self.red)):
            raise ValueError(
                'observation: slots are of anymal, leatherback and minitank; a robot from a file needs "rich"'
            )
        hull = max(kind_of(kind).hull for kind in self.blue + self.red)
        if self.rules.spawn == "lattice":
            self._check_lattice(hull)
        elif self.rules.ring[0] < (smallest := diameter_ring((len(self.blue), len(self.red)), hull)):
            raise ValueError(_too_small(self.rules.ring[0], smallest))

    def _check_lattice(self, hull: float) -> None:
        rules, robots = self.rules, len(self.blue) + len(self.red)
        if rules.spawn_distance < hull and not rules.defects.spawn_overlap:
            raise ValueError(
                f"rules.spacing: robots of {hull} m could start inside each other {rules.spacing} m apart; "
                f"{hull} or more, or defects.spawn_overlap = true"
            )
        smallest = lattice_ring([rules.spawn_distance / 2] * robots)
        if rules.ring[0] < smallest:
            raise ValueError(_too_small(rules.ring[0], smallest))

    @property
    def timing(self) -> Timing:
        """Control steps of 0.02 s, as HARL-A's."""
        rules = self.rules
        return Timing(rules.timestep, round(CONTROL / rules.timestep), rules.decide_every, rules.episode)

    def outline(self) -> Outline:
        """Summarise a match."""
        rules, low, high = self.rules, *self.rules.ring
        shrinks = f", which shrinks from {rules.shrink_after:g} s on" if rules.shrink_after < rules.episode else ""
        what = f"push the others out of a ring of {low:g} to {high:g} m{shrinks}"
        sides = {"blue": (self.blue, self.red), "red": (self.red, self.blue)}
        teams = {
            team: tuple(self._agent_outline(kind, own, other) for kind in own) for team, (own, other) in sides.items()
        }
        return Outline(what, teams, self.timing, "sumo")

    def _agent_outline(self, kind: str, own: Sequence[str], other: Sequence[str]) -> AgentOutline:
        """Return the outline of a robot of the team `own` against the team `other`."""
        proprioception_size, action_size = kind_of(kind).proprioception_size, kind_of(kind).action_size
        if self.observation == "rich":
            return AgentOutline(
                roster_name(kind), proprioception_size + OWN + PER_OTHER * (len(own) - 1 + len(other)), action_size
            )
        return AgentOutline(kind, size(kind, max(0, len(own) - 2) + max(0, len(other) - 2), self.buffer), action_size)

    def build(self, **options: Unpack[EngineOptions]) -> "Sumo":
        """Build the arena."""
        from arenas.games.sumo.match import Sumo

        return with_terms(Sumo(self, **options), self)


def pitch(size: int) -> float:
    """Return the angle in radians between team-mates on a diameter: 1.2, or less to leave room between the teams."""
    return min(1.2, (math.pi - 2 * WOBBLE) / size)


def diameter_ring(sizes: tuple[int, int], hull: float) -> float:
    """Return the smallest radius (m) of a ring in which teams of these sizes and robots of this width start without
    overlap.
    """
    halves = [(size - 1) / 2 * pitch(size) for size in sizes]
    between = math.pi - 2 * WOBBLE - sum(halves)  # rad, from the last of a team to the first of the other
    angle = min([between, *(pitch(size) for size in sizes if size > 1)])
    return hull / (2 * NEAREST * math.sin(angle / 2))


def lattice_ring(clear: Sequence[float]) -> float:
    """Return the smallest radius (m) of a ring whose lattice has room for things of these `clear` radii, in their
    order.

    Each thing placed rules out at most the points nearer to it than the sum of the two radii; the ring must have more
    points than that. Each point owns one cell, so the ring has at least as many points as cells cover the disc of the
    ring's radius less half a cell's diagonal.
    """
    ruled_out = max(sum(points_within(mine + theirs) for theirs in clear[:i]) for i, mine in enumerate(clear))
    return PITCH / math.sqrt(2) + PITCH * math.sqrt(ruled_out / math.pi)


def points_within(distance: float, pitch: float = PITCH) -> int:
    """Count the points of a lattice of this pitch that are nearer than `distance` to one of them, including itself."""
    reach = range(-math.ceil(distance / pitch), math.ceil(distance / pitch) + 1)
    return sum(pitch * math.hypot(i, j) < distance - 1e-4 for i in reach for j in reach)


def _too_small(ring: float, smallest: float) -> str:
    return (
        f"rules.ring: robots could start inside each other in a ring of {ring} m;"
        f" it must begin at {math.ceil(100 * smallest) / 100} m or more"
    )


def faithful(settings: SumoSettings) -> SumoSettings:
    """Return the same arena with every defect of the original, all robots facing +y, and its physics timestep."""
    defects = Defects(**{each.name: True for each in fields(Defects)})
    return replace(settings, rules=replace(settings.rules, defects=defects, heading="fixed", timestep=0.005))


PAPER = SumoRules(
    ring=(3.0, 6.0), episode=30.0, shrink_after=30.0, spawn="lattice", decide_every=1, timestep=TIMESTEP,
    drive_scale=10.0, steer_scale=0.1, drive_limit=None, wheel_limit=50.0,
)  # fmt: skip
"""HARL-A's rules, without its defects, and with a longer physics timestep."""
OUTCOME = SumoReward(scale=10.0, timeout_penalty=1.0, approach=0.0, push=0.0)
"""HARL-A's reward: the outcome alone."""


def _paper(name: str, blue: tuple[str, ...], red: tuple[str, ...] | None = None) -> SumoSettings:
    return SumoSettings(name, blue, blue if red is None else red, observation="slots", rules=PAPER, reward=OUTCOME)


ARENAS = (
    SumoSettings("sumo-1v1", ("leatherback",), ("leatherback",), rules=SumoRules(ring=(1.2, 1.8))),
    SumoSettings("sumo-2v2"),
    _paper("sumo-by-team", ("anymal", "anymal"), ("leatherback", "leatherback")),
    _paper("sumo-within-team", ("anymal", "leatherback")),
    _paper("sumo-2v2-anymal", ("anymal", "anymal")),
    _paper("sumo-2v2-leatherback", ("leatherback", "leatherback")),
    _paper("sumo-1v1-anymal", ("anymal",)),
    _paper("sumo-1v1-leatherback", ("leatherback",)),
)
