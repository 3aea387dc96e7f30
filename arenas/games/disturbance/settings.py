"""Settings of the disturbed walk; the game itself is `arenas/games/disturbance/match.py`. Loads nothing heavy.

Nature's forces are those of RARL (Pinto et al. 2017, 1703.02702): ±5 N per component on named bodies. The numbers that
it may set before an episode are those of RRLS (2406.08406): masses of bodies and friction, here as factors.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Unpack

from arenas.arena_settings import EngineOptions, Table, Timing
from arenas.description import AgentOutline, Outline
from arenas.games.sumo.stages import WalkReward
from arenas.games.terms import with_terms
from arenas.games.walk.settings import GOAL, RobotWalkSettings
from arenas.robots.kinds import kind_of, roster_name

if TYPE_CHECKING:
    from arenas.games.disturbance.match import Disturbance

WALKER_TEAM, NATURE = "blue", "nature"
FRICTION, BASE, TERRAIN = "friction", "base", "terrain"
LOWEST, HIGHEST = 0.01, 100.0  # of factors: MuJoCo needs masses above 0


FLAT, FIELDS = "flat", ("bumps", "terraces", "waves")  # those of arenas/scene/height_fields.py
LOW_FIELD, HIGH_FIELD, FAR_FIELD = 0.02, 1.0, 100.0  # m: heights of a field, and the longest way that may have fields


def check_design(table: Mapping[str, Any]) -> None:
    """Raise ValueError, one line, for a table that gives no ranges of factors and no choice of terrain."""
    for name, value in table.items():
        if name == TERRAIN:
            names = isinstance(value, list | tuple) and all(isinstance(each, str) for each in value)
            if not names or len({*value}) < max(2, len(value)):
                raise ValueError(
                    f"{name}: {value!r:.80} must be the names of two or more height fields, as [flat, bumps]"
                )
            continue
        numbers = isinstance(value, list | tuple) and all(type(each) in (int, float) for each in value)
        if not numbers or len(value) != 2 or not LOWEST <= value[0] <= value[1] <= HIGHEST:
            raise ValueError(
                f"{name}: {value!r:.80} must be two factors, lowest and highest, from {LOWEST:g} to {HIGHEST:g}"
            )


def check_terrain(table: Mapping[str, Any]) -> None:
    """Raise ValueError, one line, for a table that gives no heights of height fields."""
    for name, height in table.items():
        if name not in FIELDS:
            raise ValueError(f"{name!r:.80} is no height field: {', '.join(FIELDS)}")
        if type(height) not in (int, float) or not LOW_FIELD <= height <= HIGH_FIELD:
            raise ValueError(
                f"{name}: {height!r:.80} must be its greatest height, from {LOW_FIELD:g} to {HIGH_FIELD:g} m"
            )


@dataclass(frozen=True)
class DisturbanceRules:
    """Rules that decide an episode: with the bodies, these make the arena's configuration hash."""

    distance: float = field(default=10.0, metadata={"above": 0.0, "high": 1000.0})
    """Metres from the start, along +x, to the goal."""
    reach: float = field(default=1.0, metadata={"above": 0.0, "high": 10.0})
    """The walker wins when it is this near to the goal, in metres."""
    episode: float = field(default=15.0, metadata={"low": 1.0, "high": 600.0})
    """Seconds that it has; then nature wins."""
    fall_up: float = field(default=0.3, metadata={"low": -1.0, "high": 1.0})
    """An up axis with world z below this is a fall, as is a torso on the ground: nature wins."""
    force: float = field(default=5.0, metadata={"low": 0.0, "high": 10_000.0})
    """Newtons that nature may push with along each axis on each of `bodies` (RARL: 5)."""
    weight_share: float = field(default=0.1, metadata={"low": 0.0, "high": 10.0})
    """The same as a share of the walker's weight; the larger of the two counts (an ANYmal of 53 kg: 52 N)."""
    axes: Literal["auto", "xy", "xz", "xyz"] = "auto"
    """Axes of the world along which it pushes; auto: x and z for a walker that moves in a plane, else all three."""


@dataclass(frozen=True)
class DisturbanceReward(WalkReward):
    """Weights of the walker's terms, which nature gets with the opposite sign. Gaits are not shaped."""

    vertical: float = -0.2
    """Per second: square of the vertical velocity, m/s."""
    torque: float = 0.0
    """Per second: squares of the joints' torques, N·m."""
    acceleration: float = 0.0
    """Per second: squares of the joints' accelerations over the control step, rad/s²."""
    air_time: float = 0.0
    """Per second: over feet that touch down, their time in the air in excess of 0.5 s."""
    thigh_contact: float = 0.0
    """Per second: limbs that touch the ground."""
    tilt: float = -0.5
    """Per second: square of the sine of the torso's tilt."""
    force: float = -0.1
    """To nature alone, per second: mean square of its forces, as shares of their limit."""


@dataclass(frozen=True)
class DisturbanceSettings(RobotWalkSettings):
    """A robot with feet that walks ahead, against nature."""

    PLANAR: ClassVar[bool] = True

    name: str = "disturbance"
    """The arena's name."""
    blue: tuple[str, ...] = ("anymal",)
    """The walker, by kind: anymal, ant, hopper, walker2d, half_cheetah, ... or a file (docs/robots.md)."""
    bodies: tuple[str, ...] = (BASE,)
    """Bodies of the walker that nature pushes, by their names in its model; base is its base. Empty: it does not."""
    design: Table = field(default_factory=Table, metadata={"valid": check_design})
    """Factors that nature sets before an episode, by lowest and highest: {friction = [0.5, 2], base = [0.7, 1.5]} of
    the walker's friction and of the masses of bodies; terrain = ["flat", "bumps"] is a choice among height fields.
    Empty: it sets none. Without bodies too the walker is alone."""
    terrain: Table = field(default_factory=Table, metadata={"valid": check_terrain})
    """Height fields on the way to the goal, by their greatest heights in metres: {bumps = 0.1, terraces = 0.2, waves =
    0.1}. Unless `design` has a choice among them, each episode draws one, or the flat ground."""
    rules: DisturbanceRules = field(default_factory=DisturbanceRules)  # type: ignore[assignment]
    """Rules that decide an episode."""
    reward: DisturbanceReward = field(default_factory=DisturbanceReward)
    """Rewards for learning."""

    def __post_init__(self) -> None:
        """Check also that a choice of terrain is among the arena's height fields."""
        super().__post_init__()
        if self.terrain and self.rules.distance > FAR_FIELD:
            raise ValueError(f"terrain: its height fields reach {FAR_FIELD:g} m, and the goal is further away")
        if (chosen := self.design.get(TERRAIN)) is None:
            return
        if not self.terrain:
            raise ValueError("design: terrain: the arena has no height field; give it some, terrain = {bumps = 0.1}")
        if strange := [name for name in chosen if name not in (FLAT, *self.terrain)]:
            raise ValueError(
                f"design: terrain: {strange[0]!r:.80} is none of the arena's: {', '.join((FLAT, *self.terrain))}"
            )

    @property
    def bounds(self) -> dict[str, tuple[float, float] | tuple[str, ...]]:
        """Ranges of the factors that nature sets, and the names of its choice of terrain."""
        return {
            name: tuple(value) if name == TERRAIN else (float(value[0]), float(value[1]))
            for name, value in self.design.items()
        }

    @property
    def axes(self) -> str:
        """Axes of the world along which nature pushes."""
        if self.rules.axes != "auto":
            return self.rules.axes
        return "xz" if kind_of(self.blue[0]).planar else "xyz"

    @property
    def timing(self) -> Timing:
        """Decisions at 50 Hz, physics at 200 Hz."""
        return Timing(0.005, 4, 1, self.rules.episode)

    def outline(self) -> Outline:
        """Summarise the game."""
        rules, kind = self.rules, kind_of(self.blue[0])
        seen = kind.proprioception_size + GOAL + self.buffer
        teams = {WALKER_TEAM: (AgentOutline(roster_name(self.blue[0]), seen, kind.action_size),)}
        nature: list[AgentOutline] = []
        if self.bodies:
            pushes = len(self.bodies) * len(self.axes)
            nature.append(AgentOutline("disturbance", seen + len(self.design), pushes))
        if self.design:
            nature.append(AgentOutline("designer", seen + len(self.design), len(self.design)))
        against = " against nature's forces" if self.bodies else ""
        what = f"walk {rules.distance:g} m ahead within {rules.episode:g} s{against}"
        return Outline(what, {**teams, **({NATURE: tuple(nature)} if nature else {})}, self.timing, "disturbance")

    def build(self, **options: Unpack[EngineOptions]) -> "Disturbance":
        """Build the arena."""
        from arenas.games.disturbance.match import DesignedDisturbance, Disturbance

        arena = DesignedDisturbance if self.design else Disturbance
        return with_terms(arena(self, **options), self)


ARENAS = (DisturbanceSettings(),)
