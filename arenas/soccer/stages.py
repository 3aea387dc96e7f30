"""Settings of the stages that lead to soccer: walking to a point, going to the ball, scoring. One robot, one team.

Nothing here loads jax or mujoco. `docs/arenas/soccer.md` says why each setting is what it is. A reward's fields are its
terms: each weight is that of the term of its name, with the sign it is added by.
"""

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, Unpack

from arenas.about import Outline
from arenas.options import Timing, Where
from arenas.randomisation import HARL_A, Randomisation
from arenas.soccer.rules import PitchRules, seat, timing
from arenas.soccer.settings import ALL_DEFECTS
from arenas.sumo.stages import WalkSettings

if TYPE_CHECKING:
    from arenas.soccer.drill import Drill
    from arenas.sumo.walk import Walk


@dataclass(frozen=True)
class SoccerWalkSettings(WalkSettings):
    """Stage 0: an ANYmal alone on an open plane, that shall reach a point in time and sees as in soccer."""

    name: str = "soccer-walk"
    """The arena's name."""

    @property
    def timing(self) -> Timing:
        """HARL-A's 50 Hz, and soccer's steps of physics."""
        return timing(self.rules.episode)

    def outline(self) -> Outline:
        """The walk in a line."""
        return replace(super().outline(), teams={"blue": (seat("anymal", 0, self.buffer),)}, page="soccer")

    def build(self, **where: Unpack[Where]) -> "Walk":
        """The arena itself: sumo's walk with another layout of what is seen."""
        from arenas.soccer.sight import walking
        from arenas.sumo.walk import Walk

        return Walk(self, walking(self.buffer), **where)


@dataclass(frozen=True)
class DrillRules(PitchRules):
    """What success is: with the bodies, these make the arena's configuration hash."""

    aim: Literal["ball", "score"] = "score"
    """What shall be done: get to the ball, or have it in the target goal, which is drawn for each episode."""
    episode: float = field(default=20.0, metadata={"low": 1.0, "high": 600.0})
    """Seconds that it may take; then the episode is cut."""
    spread: float | None = field(default=None, metadata={"above": 1.5, "high": 100.0})
    """Metres to either side of the robot, along x and y, within which the ball starts; none: anywhere."""
    ease: float = field(default=0.0, metadata={"low": 0.0, "high": 1.0})
    """Share of episodes that begin easier (not in HARL-A): the ball part of its way to the target goal, evenly from all
    of it to none, and the robot the more behind it."""
    reach: float = field(default=0.8, metadata={"above": 0.0, "high": 10.0})
    """Aim "ball": as near to the ball as this, in metres from base to ball, is to be there; a nose is 0.5 m ahead."""
    stay: bool = False
    """Aim "ball": to be there ends nothing, as in HARL-A; success is to be there when the episode ends."""


@dataclass(frozen=True)
class DrillReward:
    """Weights of the reward's terms; `approach` and `push` are hints that training.shaping_steps anneals."""

    reached: float = 0.0
    """Once, when the robot is at the ball and that ends the episode (not in HARL-A)."""
    goal: float = 0.0
    """Once, when the ball is in the target goal."""
    wrong: float = 0.0
    """Once, when the ball is in the other goal."""
    fall: float = -2.0
    """Once, when the robot falls (not in HARL-A, where that only ends the episode)."""
    time: float = 0.0
    """Per decision, whatever happens."""
    near: float = 0.0
    """Per second: 1 - tanh(metres from the robot to the ball / 0.8)."""
    ball: float = 0.0
    """Per second: 1 - tanh(metres from the ball to the target goal / 0.8)."""
    approach: float = 0.5
    """Hint: per metre that the robot gained towards the ball (not in HARL-A)."""
    push: float = 0.0
    """Hint: per metre that the ball gained towards the target goal (not in HARL-A)."""


@dataclass(frozen=True)
class DrillSettings:
    """A robot alone on the field, with a ball."""

    name: str = "soccer-score"
    """The arena's name."""
    robot: Literal["anymal", "leatherback"] = "anymal"
    """The robot's kind."""
    buffer: int = field(default=0, metadata={"low": 0, "high": 1000})
    """Zeros at the end of the observation, as later stages have them (the paper's ablation: 0, 50, 100)."""
    rules: DrillRules = field(default_factory=DrillRules)
    """What success is."""
    reward: DrillReward = field(default_factory=DrillReward)
    """What learning is told."""
    randomisation: Randomisation = field(default_factory=Randomisation)
    """What differs between episodes in the robot's body."""

    @property
    def timing(self) -> Timing:
        """HARL-A's 50 Hz."""
        return timing(self.rules.episode)

    def outline(self) -> Outline:
        """The drill in a line."""
        rules = self.rules
        goal = "score in the goal that is asked for, of two"
        what = f"get to within {rules.reach:g} m of the ball" if rules.aim == "ball" else goal
        return Outline(what, {"blue": (seat(self.robot, 0, self.buffer),)}, self.timing, "soccer")

    def build(self, **where: Unpack[Where]) -> "Drill":
        """The arena itself."""
        from arenas.soccer.drill import Drill

        return Drill(self, **where)


def faithful(settings: DrillSettings) -> DrillSettings:
    """The same drill with every defect of the original; goals, falls and success at the ball as there."""
    rules = replace(settings.rules, defects=ALL_DEFECTS, heading="fixed", stay=True, fall_up=-1.0)
    if settings.robot == "anymal":
        rules = replace(rules, goal_at=9.0)
    return replace(settings, rules=rules)


ARENAS = (
    SoccerWalkSettings(),
    DrillSettings(
        "soccer-ball",
        rules=DrillRules(aim="ball", episode=10.0, spread=3.0),
        reward=DrillReward(reached=10.0, near=1.0),
        randomisation=HARL_A,
    ),
    DrillSettings(reward=DrillReward(goal=20.0, wrong=-20.0, ball=1.0, push=1.0), randomisation=HARL_A),
    DrillSettings(
        "soccer-score-leatherback",
        "leatherback",
        reward=DrillReward(goal=20.0, wrong=-20.0, fall=0.0, near=1.0, ball=1.0, push=1.0),
    ),
)
