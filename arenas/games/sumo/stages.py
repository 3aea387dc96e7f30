"""Settings of sumo's first two stages: walking to a point, and pushing a block out of the ring.

Nothing here loads jax or mujoco. `docs/arenas/anymal-walk.md` and `docs/arenas/block-push.md` explain each setting. A
reward's fields are its terms: each weight multiplies the term of its name, sign included.
"""

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, Unpack

from arenas.arena_settings import EngineOptions, Timing
from arenas.description import AgentOutline, Outline
from arenas.games.sumo.observation_layout import size
from arenas.games.sumo.settings import CONTROL, OVERLAPPING, TIMESTEP, lattice_ring
from arenas.games.terms import RewardTerms, WithTerms, with_terms
from arenas.robots.kinds import KINDS
from arenas.scene.randomisation import Randomisation

if TYPE_CHECKING:
    from arenas.games.sumo.block import BlockPush
    from arenas.games.sumo.walk import Walk


# Stage 1 --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class WalkRules:
    """Definition of success: with the body, these make the arena's configuration hash."""

    goal: float = field(default=10.0, metadata={"above": 0.0, "high": 100.0})
    """Metres from the start, along x and y, within which the goal is drawn uniformly."""
    reach: float = field(default=1.0, metadata={"above": 0.0, "high": 10.0})
    """Success is being this near to the goal, in metres (HARL-A's branch of September 2025: 0.35)."""
    episode: float = field(default=20.0, metadata={"low": 1.0, "high": 600.0})
    """Maximum duration in seconds; then the episode is cut."""
    heading: Literal["random", "fixed"] = "random"
    """Heading of the robot at the start; fixed: +90 degrees, as HARL-A's."""
    fall_up: float = field(default=0.3, metadata={"low": -1.0, "high": 1.0})
    """An up axis with world z below this is a fall, as is a torso on the ground (HARL-A: -1, no such rule)."""


@dataclass(frozen=True)
class WalkReward(RewardTerms):
    """Weights of the reward's terms. The paper's are in `PAPER_WALK`; none of them is annealed."""

    ENDINGS = ("fall",)

    reached: float = 10.0
    """Once, when the goal is reached."""
    fall: float = -2.0
    """Once, when it falls (not in the paper): otherwise lying down early would end all penalties."""
    progress: float = 2.0
    """Per metre gained towards the goal (not in the paper)."""
    tracking: float = 1.5
    """Per second: exp(-(error/0.5 m/s)²) of the velocity against `speed` towards the goal (HARL-A: defined, unused)."""
    turning: float = 0.5
    """Per second: exp(-(error/0.5 rad/s)²) of the yaw rate against one that faces the goal (HARL-A: the same)."""
    distance: float = 0.5
    """Per second: 1 - tanh(metres to the goal / 5) (HARL-A: 2, its only incentive to approach)."""
    vertical: float = -2.0
    """Per second: square of the vertical velocity, m/s."""
    roll_pitch: float = -0.05
    """Per second: squares of roll and pitch rates, rad/s."""
    torque: float = -2.5e-5
    """Per second: squares of the joints' torques, N·m."""
    acceleration: float = -2.5e-7
    """Per second: squares of the joints' accelerations over the control step, rad/s²."""
    action_change: float = -0.01
    """Per second: squares of the action's change from one decision to the next."""
    air_time: float = 0.5
    """Per second: over feet that touch down, their time in the air in excess of 0.5 s."""
    thigh_contact: float = -1.0
    """Per second: thighs that touch the ground."""
    tilt: float = -5.0
    """Per second: square of the sine of the torso's tilt."""
    speed: float = field(default=1.0, metadata={"low": 0.1, "high": 3.0})
    """No term: the target speed in m/s of `tracking`."""


PAPER_WALK = WalkReward(fall=0.0, progress=0.0, tracking=0.0, turning=0.0, distance=2.0)
"""HARL-A's reward of stage 1, term by term."""


@dataclass(frozen=True)
class WalkSettings(WithTerms):
    """An ANYmal alone on an open plane that must reach a point in time."""

    name: str = "anymal-walk"
    """The arena's name."""
    buffer: int = field(default=0, metadata={"low": 0, "high": 1000})
    """Zeros at the end of the observation, as in later stages (the paper's ablation: 0, 50, 100)."""
    rules: WalkRules = field(default_factory=WalkRules)
    """Definition of success."""
    reward: WalkReward = field(default_factory=WalkReward)
    """Rewards for learning."""
    randomisation: Randomisation = field(default_factory=Randomisation)
    """Random differences between episodes in the robot's body."""

    @property
    def timing(self) -> Timing:
        """Decisions at HARL-A's 50 Hz."""
        return _timing(self.rules.episode)

    def outline(self) -> Outline:
        """Summarise the walk."""
        rules = self.rules
        what = f"walk to within {rules.reach:g} m of a point that is up to {rules.goal:g} m away along either axis"
        return Outline(what, {"blue": (_agent_outline("anymal", self.buffer),)}, self.timing, "anymal-walk")

    def build(self, **options: Unpack[EngineOptions]) -> "Walk":
        """Build the arena."""
        from arenas.games.sumo.walk import Walk

        return with_terms(Walk(self, **options), self)


# Stage 2 --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class BlockPushRules:
    """Rules that decide a game: with the bodies, these make the arena's configuration hash."""

    ring: tuple[float, float] = (2.0, 5.5)
    """Ring radius in metres, drawn uniformly per episode."""
    episode: float = field(default=20.0, metadata={"low": 1.0, "high": 600.0})
    """Seconds until time is up: a draw, and the episode is cut."""
    block_mass: float = field(default=10.0, metadata={"above": 0.0, "high": 1000.0})
    """kg; HARL-A's ANYmals push 10 kg, its rovers 0.01 kg."""
    block_side: float = field(default=0.4, metadata={"low": 0.05, "high": 2.0})
    """Length of a block's edges, in metres."""
    spawn: float = field(default=0.9, metadata={"low": 0.1, "high": 1.0})
    """Share of the ring's radius within which robots and blocks start (HARL-A's ANYmals: 0.9, its rovers: 1)."""
    overlap: bool = False
    """Robots and blocks start 0.6 m apart whatever their size, as HARL-A's, and may overlap."""
    heading: Literal["random", "fixed"] = "random"
    """Headings of robots at the start; fixed as HARL-A's: ANYmals +y, rovers +x."""
    falls: Literal["lose", "end"] = "lose"
    """A fall counts as being out of the ring, or ends the game as a draw at no cost, as with HARL-A's ANYmals."""
    fall_height: float = field(default=0.17, metadata={"low": 0.0, "high": 0.5})
    """ANYmals: a robot has fallen if its torso's centre of mass is below this, in metres."""
    fall_up: float = field(default=0.3, metadata={"low": -1.0, "high": 1.0})
    """ANYmals: a robot has also fallen if world z of its up axis is below this (HARL-A: -1, no such rule)."""
    drive_scale: float = field(default=10.0, metadata={"low": 1.0, "high": 100.0})
    """Rovers: wheel speed for throttle 1, rad/s."""
    steer_scale: float = field(default=0.1, metadata={"low": 0.01, "high": 0.75})
    """Rovers: steering angle for steering 1, rad."""
    wheel_limit: float | None = field(default=50.0, metadata={"above": 0.0})
    """Rovers: wheel speed is clamped to ± this after scaling, rad/s. None: not at all."""

    def __post_init__(self) -> None:
        """Check the order of the ring's two radii."""
        if not 0.5 <= self.ring[0] <= self.ring[1] <= 20.0:
            raise ValueError(f"ring: {list(self.ring)} must be two radii in metres, 0.5 <= smallest <= largest <= 20")

    def clear(self, robot: str) -> tuple[float, float, float, float]:
        """Return radii in metres of the circles that two robots of this kind and two blocks need at the start.

        Bodies in two adjacent circles do not overlap, in any orientation.
        """
        if self.overlap:
            each = OVERLAPPING / 2
            return each, each, each, each
        hull, block = KINDS[robot].hull / 2, self.block_side / math.sqrt(2)
        return hull, hull, block, block


@dataclass(frozen=True)
class BlockPushReward(RewardTerms):
    """Weights of HARL-A's reward terms; `approach` and `push` are shaping that training.shaping_steps anneals."""

    ENDINGS = ("robot_out",)

    block_out: float = 10.0
    """Once, when the team's own block is out of the ring."""
    robot_out: float = -10.0
    """Once, when its robot is out of the ring, or has fallen if that loses."""
    block: float = 1.0
    """Per second: tanh(metres from the centre to the own block / largest ring radius)."""
    near: float = 1.0
    """Per second: 1 - tanh(metres from the robot to the own block / largest ring radius)."""
    time: float = 0.0
    """Per decision, in any case; HARL-A's rovers: -0.01. The paper has it for all, its ANYmals' code for none."""
    approach: float = 0.5
    """Shaping: per metre gained towards the own block."""
    push: float = 1.0
    """Shaping: per metre that the own block moved outwards."""


@dataclass(frozen=True)
class BlockPushSettings(WithTerms):
    """Two robots with a block each in one ring: the first to push its own block out wins."""

    name: str = "block-push-anymal"
    """The arena's name."""
    robot: Literal["anymal", "leatherback"] = "anymal"
    """The kind of both robots."""
    buffer: int = field(default=0, metadata={"low": 0, "high": 1000})
    """Zeros at the end of the observation, as in later stages (the paper's ablation: 0, 50, 100)."""
    rules: BlockPushRules = field(default_factory=BlockPushRules)
    """Rules that decide a game."""
    reward: BlockPushReward = field(default_factory=BlockPushReward)
    """Rewards for learning."""
    randomisation: Randomisation = field(default_factory=Randomisation)
    """Random differences between episodes in the robots' bodies."""

    def __post_init__(self) -> None:
        """Check that there is room for robots and blocks at the start."""
        smallest = lattice_ring(self.rules.clear(self.robot)) / self.rules.spawn
        if self.rules.ring[0] < smallest:
            raise ValueError(
                f"rules.ring: robots and blocks could start inside each other in a ring of {self.rules.ring[0]} m;"
                f" it must begin at {math.ceil(100 * smallest) / 100} m or more"
            )

    @property
    def timing(self) -> Timing:
        """Decisions at HARL-A's 50 Hz."""
        return _timing(self.rules.episode)

    def outline(self) -> Outline:
        """Summarise the game."""
        low, high = self.rules.ring
        what = f"push one's own block of {self.rules.block_mass:g} kg out of a ring of {low:g} to {high:g} m"
        seat = _agent_outline(self.robot, self.buffer)
        return Outline(what, {"blue": (seat,), "red": (seat,)}, self.timing, "block-push")

    def build(self, **options: Unpack[EngineOptions]) -> "BlockPush":
        """Build the arena."""
        from arenas.games.sumo.block import BlockPush

        return with_terms(BlockPush(self, **options), self)


def _timing(episode: float) -> Timing:
    return Timing(TIMESTEP, round(CONTROL / TIMESTEP), 1, episode)


def _agent_outline(kind: str, buffer: int) -> AgentOutline:
    return AgentOutline(kind, size(kind, 0, buffer), KINDS[kind].action_size)


ARENAS = (
    WalkSettings(),
    BlockPushSettings(),
    BlockPushSettings(
        "block-push-leatherback",
        "leatherback",
        rules=BlockPushRules(ring=(2.0, 5.0), episode=30.0, block_mass=0.01, spawn=1.0),
        reward=BlockPushReward(time=-0.01),
    ),
)
