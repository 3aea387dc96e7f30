"""Settings of soccer's matches: robots and rules. The game itself is `arenas/games/soccer/match.py`.

Nothing here loads jax or mujoco. `docs/arenas/soccer.md` explains each setting. A reward's fields are its terms: each
weight multiplies the term of its name, sign included.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Literal, Unpack

from arenas.arena_settings import EngineOptions, Timing
from arenas.description import AgentOutline, Outline
from arenas.games.soccer.observation_layout import OWN_SIZE, agents_without_vector
from arenas.games.soccer.rules import Defects, PitchRules, agent_outline, timing
from arenas.games.sumo.settings import check_roster
from arenas.games.terms import RewardTerms, WithTerms, with_terms
from arenas.scene.randomisation import Randomisation

if TYPE_CHECKING:
    from arenas.games.soccer.match import Soccer


@dataclass(frozen=True)
class SoccerRules(PitchRules):
    """Rules that decide a match: with the bodies, these make the arena's configuration hash."""

    episode: float = field(default=30.0, metadata={"low": 1.0, "high": 600.0})
    """Seconds until time is up: a draw."""
    clock: Literal["cut", "end"] = "cut"
    """End of time: the match is cut, because the clock is not observed, or it is terminal for the learner, as HARL-A's.
    """
    falls: Literal["play", "lose", "end"] = "play"
    """A robot's fall: play continues, as in HARL-A and in soccer; its team loses; or the match ends as a draw."""


@dataclass(frozen=True)
class RewardDefects:
    """Defects of HARL-A's soccer that change learning but not the game."""

    own_goal: bool = False
    """`ball` pays both teams for a ball near the goal at -x, which is blue's own, as in HARL-A's ANYmals v rovers."""
    per_step: bool = False
    """`ball` is paid in full at every control step and not per second: fifty times as much, as in its 2v2."""


@dataclass(frozen=True)
class SoccerReward(RewardTerms):
    """Weights of the reward's terms; `ball`, `approach` and `push` are shaping that training.shaping_steps anneals."""

    ENDINGS = ("concede",)

    goal: float = 20.0
    """Once, for the winning team: by a goal, or by a fall if that loses."""
    concede: float = -20.0
    """Once, for the losing team."""
    time: float = -0.01
    """Per decision, for both teams, in any case."""
    ball: float = 1.0
    """Shaping, per second: 1 - tanh(metres from the ball to the target goal / 0.8) (HARL-A: in its 2v2 matches alone).
    """
    approach: float = 0.5
    """Shaping: per metre that the team's nearest robot gained towards the ball (not in HARL-A)."""
    push: float = 1.0
    """Shaping: per metre that the ball gained towards the target goal (not in HARL-A)."""
    defects: RewardDefects = field(default_factory=RewardDefects)
    """Defects of the original to reproduce."""


@dataclass(frozen=True)
class SoccerSettings(WithTerms):
    """A soccer match: robots, rules and rewards."""

    name: str = "soccer-1v1"
    """The arena's name."""
    blue: tuple[str, ...] = ("anymal",)
    """Blue's robots, which play towards +x, by kind: anymal, leatherback, ant, go1, ... or a file (docs/robots.md)."""
    red: tuple[str, ...] = ("leatherback",)
    """Red's robots, which play towards -x; the teams may differ in size and kind."""
    buffer: int = field(default=0, metadata={"low": 0, "high": 1000})
    """Numbers at the end of the observation, zeros if no robot needs them; the paper's ablation has 0, 50, 100."""
    rules: SoccerRules = field(default_factory=SoccerRules)
    """Rules that decide a match."""
    reward: SoccerReward = field(default_factory=SoccerReward)
    """Rewards for learning."""
    randomisation: Randomisation = field(default_factory=Randomisation)
    """Random differences between episodes in the robots' bodies."""

    def __post_init__(self) -> None:
        """Check the rosters, and that there is room for all at the start."""
        check_roster("blue", self.blue, OWN_SIZE)
        check_roster("red", self.red, OWN_SIZE)
        self.rules.check_room(self.blue + self.red)

    @property
    def timing(self) -> Timing:
        """Decisions at HARL-A's 50 Hz."""
        return timing(self.rules.episode)

    def outline(self) -> Outline:
        """Summarise a match."""
        length, width = self.rules.pitch
        what = f"soccer on a walled field of {length:g} by {width:g} m; the first goal wins"
        teams = {"blue": self._team_outline(self.blue, self.red), "red": self._team_outline(self.red, self.blue)}
        return Outline(what, teams, self.timing, "soccer")

    def _team_outline(self, own: Sequence[str], other: Sequence[str]) -> tuple[AgentOutline, ...]:
        return tuple(agent_outline(kind, agents_without_vector(len(own), len(other)), self.buffer) for kind in own)

    def build(self, **options: Unpack[EngineOptions]) -> "Soccer":
        """Build the arena."""
        from arenas.games.soccer.match import Soccer

        return with_terms(Soccer(self, **options), self)


ALL_DEFECTS = Defects(**{each.name: True for each in fields(Defects)})


def faithful(settings: SoccerSettings) -> SoccerSettings:
    """Return the same match with every defect of the original, a terminal end of time, and all robots facing -x."""
    rules = replace(settings.rules, defects=ALL_DEFECTS, heading="fixed", clock="end", fall_up=-1.0)
    reward = replace(settings.reward, defects=RewardDefects(own_goal=True, per_step=True))
    return replace(settings, rules=rules, reward=reward)


OUTCOME = SoccerReward(ball=0.0, approach=0.0, push=0.0)
"""HARL-A's reward of 1v1: goals and time. In its 2v2 `ball` is 1 as well."""

ARENAS = (
    SoccerSettings(),
    SoccerSettings("soccer-2v2-leatherback", ("leatherback",) * 2, ("leatherback",) * 2),
    SoccerSettings("soccer-2v2", ("anymal",) * 2, ("leatherback",) * 2),
)
