"""Settings of soccer's matches: which robots, by which rules. The game itself is `arenas/soccer/match.py`.

Nothing here loads jax or mujoco. `docs/arenas/soccer.md` says why each setting is what it is. A reward's fields are its
terms: each weight is that of the term of its name, with the sign it is added by.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Literal, Unpack

from arenas.about import Outline, Seat
from arenas.options import Timing, Where
from arenas.randomisation import Randomisation
from arenas.soccer.layouts import BEGINNING, extra
from arenas.soccer.rules import Defects, PitchRules, seat, timing
from arenas.sumo.settings import check_roster

if TYPE_CHECKING:
    from arenas.soccer.match import Soccer


@dataclass(frozen=True)
class SoccerRules(PitchRules):
    """What decides a match: with the bodies, these make the arena's configuration hash."""

    episode: float = field(default=30.0, metadata={"low": 1.0, "high": 600.0})
    """Seconds until time is up: a draw."""
    clock: Literal["cut", "end"] = "cut"
    """When time is up the match is cut, for nobody sees the clock; or it ends for the learner too, as HARL-A's do."""
    falls: Literal["play", "lose", "end"] = "play"
    """A robot falls: play goes on, as in HARL-A and in soccer; its team loses; or the match ends as a draw."""


@dataclass(frozen=True)
class RewardDefects:
    """Defects of HARL-A's soccer that change what is learnt but not what is played."""

    own_goal: bool = False
    """`ball` pays both teams for a ball near the goal at -x, which is blue's own, as in HARL-A's ANYmals v rovers."""
    per_step: bool = False
    """`ball` is paid in full at every control step and not by the second: fifty times as much, as in its 2v2."""


@dataclass(frozen=True)
class SoccerReward:
    """Weights of the reward's terms; `ball`, `approach` and `push` are hints that training.shaping_steps anneals."""

    goal: float = 20.0
    """Once, for the team that has won: by a goal, or by a fall where that loses."""
    concede: float = -20.0
    """Once, for the team that has lost."""
    time: float = -0.01
    """Per decision, for both teams, whatever happens."""
    ball: float = 1.0
    """Hint, per second: 1 - tanh(metres from the ball to the target goal / 0.8) (HARL-A: in its 2v2 matches alone)."""
    approach: float = 0.5
    """Hint: per metre that the team's nearest robot gained towards the ball (not in HARL-A)."""
    push: float = 1.0
    """Hint: per metre that the ball gained towards the target goal (not in HARL-A)."""
    defects: RewardDefects = field(default_factory=RewardDefects)
    """Defects of the original to be reproduced."""


@dataclass(frozen=True)
class SoccerSettings:
    """A soccer match: which robots, by which rules, and what learning is told."""

    name: str = "soccer-1v1"
    """The arena's name."""
    blue: tuple[str, ...] = ("anymal",)
    """Blue's robots, by kind: anymal, leatherback; as many as you like. They play towards +x."""
    red: tuple[str, ...] = ("leatherback",)
    """Red's robots, which play towards -x; the teams need be neither of one size nor of one kind."""
    buffer: int = field(default=0, metadata={"low": 0, "high": 1000})
    """Numbers at the end of the observation, zeros where no robot needs them; the paper's ablation has 0, 50, 100."""
    rules: SoccerRules = field(default_factory=SoccerRules)
    """What decides a match."""
    reward: SoccerReward = field(default_factory=SoccerReward)
    """What learning is told."""
    randomisation: Randomisation = field(default_factory=Randomisation)
    """What differs between episodes in the robots' bodies."""

    def __post_init__(self) -> None:
        """Check the rosters, and that all find room at the start."""
        check_roster("blue", self.blue, BEGINNING)
        check_roster("red", self.red, BEGINNING)
        self.rules.check_room(self.blue + self.red)

    @property
    def timing(self) -> Timing:
        """HARL-A's 50 Hz."""
        return timing(self.rules.episode)

    def outline(self) -> Outline:
        """A match in a line."""
        length, width = self.rules.pitch
        what = f"soccer on a walled field of {length:g} by {width:g} m; the first goal wins"
        teams = {"blue": self._seats(self.blue, self.red), "red": self._seats(self.red, self.blue)}
        return Outline(what, teams, self.timing, "soccer")

    def _seats(self, own: Sequence[str], other: Sequence[str]) -> tuple[Seat, ...]:
        return tuple(seat(kind, extra(len(own), len(other)), self.buffer) for kind in own)

    def build(self, **where: Unpack[Where]) -> "Soccer":
        """The arena itself."""
        from arenas.soccer.match import Soccer

        return Soccer(self, **where)


ALL_DEFECTS = Defects(**{each.name: True for each in fields(Defects)})


def faithful(settings: SoccerSettings) -> SoccerSettings:
    """The same match with every defect of the original; time ends it for the learner too, and all face -x at first."""
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
