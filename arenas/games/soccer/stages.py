"""Settings of the stages that lead to soccer: walking to a point, going to the ball, scoring. One robot, one team.

Nothing here loads jax or mujoco. `docs/arenas/soccer.md` explains each setting. A reward's fields are its terms: each
weight multiplies the term of its name, sign included.
"""

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, Unpack

from arenas.arena_settings import EngineOptions, Timing
from arenas.description import Outline
from arenas.games.soccer.rules import PitchRules, agent_outline, timing
from arenas.games.soccer.settings import ALL_DEFECTS
from arenas.games.sumo.stages import WalkSettings
from arenas.games.terms import RewardTerms, WithTerms, with_terms
from arenas.scene.randomisation import HARL_A, Randomisation

if TYPE_CHECKING:
    from arenas.games.soccer.drill import Drill
    from arenas.games.sumo.walk import Walk


@dataclass(frozen=True)
class SoccerWalkSettings(WalkSettings):
    """Stage 0: an ANYmal alone on an open plane that must reach a point in time, with soccer's observation."""

    name: str = "soccer-walk"
    """The arena's name."""

    @property
    def timing(self) -> Timing:
        """Decisions at HARL-A's 50 Hz, with soccer's physics timestep."""
        return timing(self.rules.episode)

    def outline(self) -> Outline:
        """Summarise the walk."""
        return replace(super().outline(), teams={"blue": (agent_outline("anymal", 0, self.buffer),)}, page="soccer")

    def build(self, **options: Unpack[EngineOptions]) -> "Walk":
        """Build the arena: sumo's walk with soccer's observation layout."""
        from arenas.games.soccer.observation import walk_observation
        from arenas.games.sumo.walk import Walk

        return with_terms(Walk(self, walk_observation(self.buffer), **options), self)


@dataclass(frozen=True)
class DrillRules(PitchRules):
    """Definition of success: with the bodies, these make the arena's configuration hash."""

    aim: Literal["ball", "score"] = "score"
    """The task: to get to the ball, or to get it into the target goal, which is drawn for each episode."""
    episode: float = field(default=20.0, metadata={"low": 1.0, "high": 600.0})
    """Maximum duration in seconds; then the episode is cut."""
    spread: float | None = field(default=None, metadata={"above": 1.5, "high": 100.0})
    """Metres from the robot, along x and y, within which the ball starts; none: anywhere."""
    ease: float = field(default=0.0, metadata={"low": 0.0, "high": 1.0})
    """Share of episodes that begin easier (not in HARL-A): the ball starts on its way to the target goal, at a
    uniformly drawn part of it, and the robot correspondingly nearer to the place behind the ball."""
    reach: float = field(default=0.8, metadata={"above": 0.0, "high": 10.0})
    """Aim "ball": distance in metres from base to ball that is success; a nose is 0.5 m ahead."""
    stay: bool = False
    """Aim "ball": reaching the ball does not end the episode, as in HARL-A; success is being there at its end."""


@dataclass(frozen=True)
class DrillReward(RewardTerms):
    """Weights of the reward's terms; `approach` and `push` are shaping that training.shaping_steps anneals."""

    ENDINGS = ("wrong", "fall")

    reached: float = 0.0
    """Once, when the robot is at the ball and that ends the episode (not in HARL-A)."""
    goal: float = 0.0
    """Once, when the ball is in the target goal."""
    wrong: float = 0.0
    """Once, when the ball is in the other goal."""
    fall: float = -2.0
    """Once, when the robot falls (not in HARL-A, where that only ends the episode)."""
    time: float = 0.0
    """Per decision, in any case."""
    near: float = 0.0
    """Per second: 1 - tanh(metres from the robot to the ball / 0.8)."""
    ball: float = 0.0
    """Per second: 1 - tanh(metres from the ball to the target goal / 0.8)."""
    approach: float = 0.5
    """Shaping: per metre that the robot gained towards the ball (not in HARL-A)."""
    push: float = 0.0
    """Shaping: per metre that the ball gained towards the target goal (not in HARL-A)."""


@dataclass(frozen=True)
class DrillSettings(WithTerms):
    """A single robot on the field, with a ball."""

    name: str = "soccer-score"
    """The arena's name."""
    robot: Literal["anymal", "leatherback"] = "anymal"
    """The robot's kind."""
    buffer: int = field(default=0, metadata={"low": 0, "high": 1000})
    """Zeros at the end of the observation, as in later stages (the paper's ablation: 0, 50, 100)."""
    rules: DrillRules = field(default_factory=DrillRules)
    """Definition of success."""
    reward: DrillReward = field(default_factory=DrillReward)
    """Rewards for learning."""
    randomisation: Randomisation = field(default_factory=Randomisation)
    """Random differences between episodes in the robot's body."""

    @property
    def timing(self) -> Timing:
        """Decisions at HARL-A's 50 Hz."""
        return timing(self.rules.episode)

    def outline(self) -> Outline:
        """Summarise the drill."""
        rules = self.rules
        goal = "score in the target goal, one of two"
        what = f"get to within {rules.reach:g} m of the ball" if rules.aim == "ball" else goal
        return Outline(what, {"blue": (agent_outline(self.robot, 0, self.buffer),)}, self.timing, "soccer")

    def build(self, **options: Unpack[EngineOptions]) -> "Drill":
        """Build the arena."""
        from arenas.games.soccer.drill import Drill

        return with_terms(Drill(self, **options), self)


def faithful(settings: DrillSettings) -> DrillSettings:
    """Return the same drill with every defect of the original, and its goals, falls and success at the ball."""
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
