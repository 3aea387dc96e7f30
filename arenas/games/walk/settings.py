"""Settings of the walk of any robot with feet; rules and rewards are those of `anymal-walk`. Loads nothing heavy."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Unpack

from arenas.arena_settings import EngineOptions, Timing
from arenas.description import AgentOutline, Outline
from arenas.games.sumo.stages import WalkSettings
from arenas.games.terms import with_terms
from arenas.robots.kinds import check_roster, kind_of, roster_name

if TYPE_CHECKING:
    from arenas.games.walk.match import RobotWalk

WALKERS = ("anymal",)  # robots in code that have feet
GOAL = 3  # numbers of the goal's position


@dataclass(frozen=True)
class RobotWalkSettings(WalkSettings):
    """A robot with feet alone on an open plane that must reach a point in time."""

    PLANAR: ClassVar[bool] = False  # whether a robot that moves in a plane alone can play

    name: str = "walk"
    """The arena's name."""
    blue: tuple[str, ...] = ("anymal",)
    """The robot, by kind: anymal, ant, go1, ... or a file (docs/robots.md)."""

    def __post_init__(self) -> None:
        """Check that there is one robot, and that it can walk."""
        check_roster("blue", self.blue, WALKERS, self.PLANAR)
        if len(self.blue) != 1:
            raise ValueError(f"blue: {len(self.blue)} robots: one walks alone")

    @property
    def timing(self) -> Timing:
        """Decisions at 50 Hz, physics at 200 Hz."""
        return Timing(0.005, 4, 1, self.rules.episode)

    def outline(self) -> Outline:
        """Summarise the walk."""
        kind = kind_of(self.blue[0])
        size = kind.proprioception_size + GOAL + self.buffer
        robot = AgentOutline(roster_name(self.blue[0]), size, kind.action_size)
        what = f"any robot with feet {super().outline().what}"
        return Outline(what, {"blue": (robot,)}, self.timing, "walk")

    def build(self, **options: Unpack[EngineOptions]) -> "RobotWalk":
        """Build the arena."""
        from arenas.games.walk.match import RobotWalk

        return with_terms(RobotWalk(self, **options), self)


ARENAS = (RobotWalkSettings(),)
