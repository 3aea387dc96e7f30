"""Settings of Bansal et al.'s games: bodies, rules, rewards. The games are in the files beside this one.

Nothing here loads jax or mujoco. `docs/arenas/bansal.md` has the original's numbers beside ours.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, Literal, TypeVar, Unpack

from arenas.arena_settings import EngineOptions, Timing
from arenas.description import AgentOutline, Outline
from arenas.errors import ArenaError
from arenas.games.bansal.rules import (
    ContestReward,
    ContestRules,
    KickAndDefendReward,
    KickAndDefendRules,
    RingSumoReward,
    RingSumoRules,
    RunToGoalReward,
    RunToGoalRules,
    YouShallNotPassReward,
    YouShallNotPassRules,
)
from arenas.games.terms import WithTerms, with_terms
from arenas.robots.files.robot_file import RobotFile, torque_driven
from arenas.robots.kinds import check_roster, is_file, kind_of

if TYPE_CHECKING:
    from arenas.arena import Arena

IN_CODE = ("anymal",)  # robots in code with legs
PLAYERS = ("blue", "red")  # teams that play both roles
OWN, OPPONENT, TIME = 6, 12, 1  # numbers of the observation besides proprioception and the opponent's joints


@dataclass(frozen=True)
class ContestSettings(WithTerms, ABC):
    """Settings of all these games."""

    name: str
    """The arena's name."""
    robot: str = "ant"
    """The kind of both bodies: ant, humanoid, go1, anymal, ... or a file (docs/robots.md)."""
    drive: Literal["file", "torque"] = "file"
    """file: joints are driven as the robot file says, humanoids by targets of their angles; torque: an action is a
    share of each joint's largest torque, as in the original."""
    rules: ContestRules = field(default_factory=ContestRules)
    """Rules that decide a game."""
    reward: ContestReward = field(default_factory=ContestReward)
    """Rewards for learning."""

    extra: ClassVar[int] = 0
    """Numbers of the observation that only this game has."""
    sides: ClassVar[tuple[str, str]] = PLAYERS
    """Names of the two roles, the first of which starts at negative x."""

    def __post_init__(self) -> None:
        """Check the body."""
        check_roster("robot", (self.robot,), IN_CODE)
        if self.drive == "torque":
            try:
                self.robot_file()
            except ArenaError as error:
                raise ValueError(f"drive: {error}") from None

    @property
    def teams(self) -> tuple[str, str]:
        """Names of the teams: of their roles where these are fixed."""
        return self.sides if getattr(self.rules, "roles", "drawn") == "fixed" else PLAYERS

    @property
    def timing(self) -> Timing:
        """Steps and duration by the rules."""
        rules = self.rules
        return Timing(rules.timestep, rules.substeps, rules.hold, rules.episode)

    def robot_file(self) -> RobotFile | None:
        """Return the settings of the body with its drive; None for a robot in code. Raises ArenaError, one line."""
        from arenas.robots.files.catalogue import robot_file

        if not is_file(self.robot):
            if self.drive == "torque":
                raise ArenaError(f"{self.robot} is a robot in code, whose drive is its own")
            return None
        found = robot_file(self.robot)
        return torque_driven(found) if self.drive == "torque" else found

    def outline(self) -> Outline:
        """Summarise the game."""
        kind, file = kind_of(self.robot), self.robot_file()
        size = kind.proprioception_size + OWN + OPPONENT + kind.action_size + self.extra + TIME
        agent = AgentOutline(file.name if file else self.robot, size, kind.action_size)
        return Outline(self.summary(), dict.fromkeys(self.teams, (agent,)), self.timing, "bansal")

    @abstractmethod
    def summary(self) -> str:
        """Describe the game in a few words."""

    def build(self, **options: Unpack[EngineOptions]) -> "Arena":
        """Build the arena."""
        return with_terms(self._make(**options), self)

    @abstractmethod
    def _make(self, **options: Unpack[EngineOptions]) -> "Arena":
        """Build the arena without terms of others."""


@dataclass(frozen=True)
class RunToGoalSettings(ContestSettings):
    """Two bodies face each other; each must reach the line behind the other first."""

    name: str = "run-to-goal"
    """The arena's name."""
    rules: RunToGoalRules = field(default_factory=RunToGoalRules)
    """Rules that decide a game."""
    reward: RunToGoalReward = field(default_factory=RunToGoalReward)
    """Rewards for learning."""

    def summary(self) -> str:
        """Describe the game in a few words."""
        return "reach the line behind the other first"

    def _make(self, **options: Unpack[EngineOptions]) -> "Arena":
        from arenas.games.bansal.run_to_goal import RunToGoal

        return RunToGoal(self, **options)


@dataclass(frozen=True)
class YouShallNotPassSettings(ContestSettings):
    """A runner must pass a line, a blocker must keep it from there."""

    name: str = "you-shall-not-pass"
    """The arena's name."""
    robot: str = "humanoid"
    """The kind of both bodies: ant, humanoid, go1, anymal, ... or a file (docs/robots.md)."""
    rules: YouShallNotPassRules = field(default_factory=YouShallNotPassRules)
    """Rules that decide a game."""
    reward: YouShallNotPassReward = field(default_factory=YouShallNotPassReward)
    """Rewards for learning."""

    extra = 1  # the role
    sides = "runner", "blocker"

    def summary(self) -> str:
        """Describe the game in a few words."""
        return f"run past a blocker within {self.rules.episode:g} s, or block"

    def _make(self, **options: Unpack[EngineOptions]) -> "Arena":
        from arenas.games.bansal.you_shall_not_pass import YouShallNotPass

        return YouShallNotPass(self, **options)


@dataclass(frozen=True)
class RingSumoSettings(ContestSettings):
    """Two bodies push each other out of a ring, or down."""

    name: str = "sumo-ants"
    """The arena's name."""
    rules: RingSumoRules = field(default_factory=RingSumoRules)
    """Rules that decide a game."""
    reward: RingSumoReward = field(default_factory=RingSumoReward)
    """Rewards for learning."""

    extra = 4  # radius, own edge, opponent's edge, touched

    def summary(self) -> str:
        """Describe the game in a few words."""
        low, high = self.rules.ring
        return f"push the other over or out of a ring of {low:g} to {high:g} m"

    def _make(self, **options: Unpack[EngineOptions]) -> "Arena":
        from arenas.games.bansal.ring_sumo import RingSumo

        return RingSumo(self, **options)


@dataclass(frozen=True)
class KickAndDefendSettings(ContestSettings):
    """A kicker must bring a ball into a goal, a keeper must keep it out."""

    name: str = "kick-and-defend"
    """The arena's name."""
    robot: str = "humanoid"
    """The kind of both bodies: ant, humanoid, go1, anymal, ... or a file (docs/robots.md)."""
    rules: KickAndDefendRules = field(default_factory=KickAndDefendRules)
    """Rules that decide a game."""
    reward: KickAndDefendReward = field(default_factory=KickAndDefendReward)
    """Rewards for learning."""

    extra = 7  # the role, the ball's place and velocity
    sides = "kicker", "keeper"

    def summary(self) -> str:
        """Describe the game in a few words."""
        return f"kick a ball into a goal of {2 * self.rules.mouth:g} m past a keeper, or keep it out"

    def _make(self, **options: Unpack[EngineOptions]) -> "Arena":
        from arenas.games.bansal.kick_and_defend import KickAndDefend

        return KickAndDefend(self, **options)


R = TypeVar("R", bound=ContestRules)
W = TypeVar("W", bound=ContestReward)


def _biped(rules: R) -> R:
    """Return rules with the pace of humanoids: 200 physics steps and 50 decisions per second, the original's 333 and
    67.
    """
    return replace(rules, timestep=0.005, substeps=4, episode=7.5, start_height=1.4, cone="pyramidal")


def _fighter(reward: W) -> W:
    """Return a reward with the original's weights of all but ants that run."""
    return replace(reward, alive=0.5)


def _humanoid(reward: W) -> W:
    return replace(_fighter(reward), alive_height=1.0)


ARENAS = (
    RunToGoalSettings(),
    RunToGoalSettings(
        "run-to-goal-humanoids",
        "humanoid",
        rules=_biped(RunToGoalRules(fall_height=0.8)),
        reward=_humanoid(RunToGoalReward(forward=0.125, distance=-0.1)),
    ),
    RingSumoSettings(rules=RingSumoRules(substeps=3, episode=7.5, fall_height=0.3), reward=_fighter(RingSumoReward())),
    RingSumoSettings(
        "sumo-humanoids",
        "humanoid",
        rules=_biped(RingSumoRules(fall_height=0.5, ring=(1.5, 3.5), edge=0.6, apart=0.5)),
        reward=_humanoid(RingSumoReward()),
    ),
    YouShallNotPassSettings(
        rules=_biped(YouShallNotPassRules(fall_height=0.3)), reward=_humanoid(YouShallNotPassReward())
    ),
    KickAndDefendSettings(rules=_biped(KickAndDefendRules(fall_height=0.8)), reward=_humanoid(KickAndDefendReward())),
)


def original_timing(settings: ContestSettings) -> ContestSettings:
    """Return the same arena with the steps and the duration with which the original ran: 500 decisions, of 50 ms for
    ants that run to a goal, else of 15 ms.
    """
    slow = isinstance(settings, RunToGoalSettings) and settings.robot == "ant"
    timestep, episode = (0.01, 25.0) if slow else (0.003, 7.5)
    rules = replace(settings.rules, timestep=timestep, substeps=5, hold=1, episode=episode)
    return replace(settings, rules=rules)
