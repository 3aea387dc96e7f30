"""Settings of the gate race: number of drones, track, rules, rewards. The game itself is `arenas/games/race/match.py`.

Nothing here loads jax or mujoco: a configuration is read and written without them. Numbers are those of 2512.11781 (two
Crazyflies), unless noted otherwise.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, Unpack

from arenas.arena_settings import EngineOptions, Timing
from arenas.description import AgentOutline, Outline
from arenas.games.race.tracks import TrackName
from arenas.games.terms import RewardTerms, WithTerms, with_terms

if TYPE_CHECKING:
    from arenas.games.race.match import Race

TEAMS = ("blue", "red", "green", "yellow")
KIND, ACTION_SIZE = "crazyflie-rates", 4
OWN_SIZE = 18  # numbers that a drone observes of itself and the game
GATES_SIZE = 24  # of the corners of the next two gates
OTHER_SIZE = 8  # of each other drone


@dataclass(frozen=True)
class RaceRules:
    """Rules that decide a race: with the bodies, these make the arena's configuration hash."""

    track: TrackName = "complex"
    """Six gates: one after the other with steep turns, one above another; or in a figure of eight."""
    walls: bool = False
    """Walls between gates, four on the complex track and two on the lemniscate, which cut the straight way to them."""
    laps: int = field(default=1, metadata={"low": 1, "high": 100})
    """Laps to the end. The first drone that completes them ends the race."""
    episode: float = field(default=30.0, metadata={"low": 1.0, "high": 600.0})
    """Seconds until time is up."""
    start: Literal["any gate", "first gate"] = "any gate"
    """The gate before which all start, and which thus is the first of their lap; our own: drawn in each episode."""
    contacts: int = field(default=100, metadata={"low": 0, "high": 100_000})
    """Control steps, 0.02 s each, in which a drone may touch a wall, the ground or another drone; one more ends its
    flight."""
    take_off: float = field(default=1.0, metadata={"low": 0.0, "high": 60.0})
    """Seconds from the start on after which a height of 0.1 m or less ends a flight."""


@dataclass(frozen=True)
class RaceReward(RewardTerms):
    """Rewards, which shape learning and never decide a race."""

    ENDINGS = ("death",)

    first: float = 10.0
    """For each gate, to the drone that passes it first."""
    later: float = 5.0
    """For each gate, to a drone that passes it second; half of it to the third, a quarter to the fourth, our own."""
    lap: float = 50.0
    """To the drone that completes the laps, which ends the race."""
    death: float = -2.0
    """Once, when a flight ends early."""
    contact: float = -0.1
    """For each control step in which the drone touches something."""
    rates: float = -0.15
    """Per second and per (rad/s)² of its rates about x and y."""
    yaw: float = -0.05
    """The same for its rate about z."""
    progress: float = 0.0
    """Shaping: per metre nearer to the centre of its next gate. It is the dense reward of races alone."""


@dataclass(frozen=True)
class RaceSettings(WithTerms):
    """A race of drones, each a team of its own."""

    name: str = "gate-race"
    """The arena's name."""
    teams: int = field(default=2, metadata={"low": 1, "high": len(TEAMS)})
    """Drones, each a team of its own. One alone flies against the clock, and succeeds if it completes its laps."""
    room: int = field(default=1, metadata={"low": 1, "high": len(TEAMS) - 1})
    """Other drones that observations have places for, if fewer race: a policy then also fits a race of more."""
    rules: RaceRules = field(default_factory=RaceRules)
    """Rules that decide a race."""
    reward: RaceReward = field(default_factory=RaceReward)
    """Rewards for learning."""

    @property
    def others(self) -> int:
        """Blocks for other drones in an observation; a drone that learnt alone therefore fits the duel."""
        return max(self.room, self.teams - 1)

    @property
    def timing(self) -> Timing:
        """Decisions at 50 Hz; physics at 200 Hz and not at 500, as in our other games of drones."""
        return Timing(timestep=0.005, substeps=4, hold=1, episode=self.rules.episode)

    @property
    def observation_size(self) -> int:
        """Numbers that each drone observes: see `arenas/games/race/observation.py`."""
        return OWN_SIZE + GATES_SIZE + OTHER_SIZE * self.others

    def outline(self) -> Outline:
        """Summarise the game."""
        what = f"be the first to complete the {self.rules.track} track of six gates{' and walls' * self.rules.walls}"
        seats = (AgentOutline(KIND, self.observation_size, ACTION_SIZE),)
        return Outline(what, dict.fromkeys(TEAMS[: self.teams], seats), self.timing, "gate-race")

    def build(self, **options: Unpack[EngineOptions]) -> "Race":
        """Build the arena."""
        from arenas.games.race.match import Race

        return with_terms(Race(self, **options), self)


ARENAS = (RaceSettings(), RaceSettings("gate-race-4", 4))
