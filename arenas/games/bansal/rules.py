"""Rules and rewards of Bansal et al.'s games (arXiv 1710.03748). Loads neither jax nor mujoco.

Their code adds per-step dense terms to a result of ±1000, in steps of 50 ms (ants that run) or 15 ms. Here a result is
±1 and dense terms are per second, so that timing does not change them: their weight 1 per step is 0.02 per second of
ants that run, and 0.067 in the other games. Ours is 0.1 in the other games, because the result counts from the first
step on here, where they fade it in. For ants that run it is 0.3 for the way forward and less for all else, with which
they move sooner.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from arenas.games.terms import RewardTerms

Roles = Literal["drawn", "fixed"]
LINE = 4.0  # m from the middle to each goal line
LINE_HALF = 5.0  # m, half the width of a goal line


@dataclass(frozen=True)
class ContestRules:
    """Rules of all these games."""

    episode: float = field(default=10.0, metadata={"low": 0.5, "high": 600.0})
    """Seconds until time is up; theirs are 500 decisions, 25 s of ants that run and 7.5 s in the other games."""
    timestep: float = field(default=0.01, metadata={"low": 0.0005, "high": 0.02})
    """Physics timestep in seconds; theirs is 0.01 for ants that run and 0.003 in the other games."""
    substeps: int = field(default=5, metadata={"low": 1, "high": 50})
    """Physics timesteps in a control step, after which the game is judged; theirs are 5."""
    hold: int = field(default=1, metadata={"low": 1, "high": 50})
    """Control steps for which an action is held; theirs is 1."""
    noise: float = field(default=0.1, metadata={"low": 0.0, "high": 0.3})
    """Largest change of places, joint angles and quaternions at the start (m, rad), and standard deviation of speeds
    (m/s, rad/s)."""
    start_height: float = field(default=0.75, metadata={"low": 0.05, "high": 5.0})
    """Height of the bases above the ground at the start, m."""
    fall_height: float = field(default=0.28, metadata={"low": 0.0, "high": 5.0})
    """A base at or below this height has fallen, m."""
    cone: Literal["pyramidal", "elliptic"] = "elliptic"
    """Shape of the friction cones.

    A pyramid's sides lie along axes that the C engine and MJX choose differently for capsules on the ground, an ant's
    feet: their bases were 29 mm apart after 0.2 s of random play. A humanoid stands on spheres, and a pyramid takes
    two thirds of the time on the C engine.
    """


@dataclass(frozen=True)
class RunToGoalRules(ContestRules):
    """Rules of run to goal."""


@dataclass(frozen=True)
class YouShallNotPassRules(ContestRules):
    """Rules of you shall not pass."""

    roles: Roles = "drawn"
    """drawn: each episode draws the team that runs, both teams learn both roles and may change places; fixed: the first
    team runs and the second blocks, each with a ladder of its own."""


@dataclass(frozen=True)
class RingSumoRules(ContestRules):
    """Rules of sumo in a ring that is drawn anew for each episode."""

    ring: tuple[float, float] = (2.5, 4.5)
    """Radius in metres, drawn uniformly per episode."""
    edge: float = field(default=0.9, metadata={"low": 0.0, "high": 5.0})
    """Metres between a base and the edge at the start, at least; theirs is 0.3 and half the smallest radius."""
    apart: float = field(default=1.0, metadata={"low": 0.0, "high": 5.0})
    """Metres between a base and the line through the centre that divides the sides at the start, at least; theirs is
    0.3, where bodies can start inside each other."""
    touch: float = field(default=0.02, metadata={"low": 0.0, "high": 0.5})
    """Bodies touch when their shapes are this near at the end of a control step, m."""
    auto_contact: bool = False
    """Count both as having touched from the start, as Gleave et al. 2020 do; otherwise a fall or a step out before the
    first touch is a draw."""

    def __post_init__(self) -> None:
        """Check the ring's radii and that there is room at the start."""
        if not 0.5 <= self.ring[0] <= self.ring[1] <= 20.0:
            raise ValueError(f"ring: {list(self.ring)} must be two radii in metres, 0.5 <= smallest <= largest <= 20")
        if self.apart > self.ring[0] - self.edge:
            raise ValueError(
                f"apart: {self.apart:g} m from the middle is not {self.edge:g} m from the edge of a ring of"
                f" {self.ring[0]:g} m; make apart or edge smaller, or the ring larger"
            )


@dataclass(frozen=True)
class KickAndDefendRules(ContestRules):
    """Rules of kick and defend."""

    roles: Roles = "drawn"
    """drawn: each episode draws the team that kicks, both teams learn both roles and may change places; fixed: the
    first team kicks and the second defends, each with a ladder of its own."""
    mouth: float = field(default=3.0, metadata={"low": 0.5, "high": 5.0})
    """Half the width of the goal, m."""
    box: float = field(default=2.5, metadata={"low": 0.5, "high": 4.0})
    """A keeper farther than this from its line loses, m; 2.5 is their code's, 3 the paper's."""
    spread: float = field(default=1.0, metadata={"low": 0.0, "high": 1.0})
    """Share of the full ranges in which kicker, keeper and ball start; theirs grows while they learn."""
    least_spread: float | None = field(default=None, metadata={"low": 0.0, "high": 1.0})
    """Each episode draws its share between this and `spread`, so that near starts stay among far ones; none: all have
    `spread`."""
    touch: float = field(default=0.02, metadata={"low": 0.0, "high": 0.5})
    """The keeper touches the ball when they are this near at the end of a control step, m."""
    falls_lose: bool = False
    """Let who falls lose at once, for a first stage of learning: else most of a rollout is of bodies that lie on the
    ground, and nobody learns to walk."""

    def __post_init__(self) -> None:
        """Check that the least spread is not above the largest; raises ValueError."""
        if self.least_spread is not None and self.least_spread > self.spread:
            raise ValueError(
                f"least_spread: {self.least_spread:g} is above spread, {self.spread:g}; lower it or raise spread"
            )


@dataclass(frozen=True)
class ContestReward(RewardTerms):
    """Rewards of all these games, which shape learning and never decide a game."""

    ENDINGS = ("result",)

    result: float = field(default=1.0, metadata={"above": 0.0})
    """To the winner, and from the loser."""
    control: float = -0.01
    """Shaping: per second, times the sum of the squares of the action."""
    alive: float = 0.05
    """Shaping: per second above `alive_height`, and its negative below."""
    alive_height: float = field(default=0.28, metadata={"low": 0.0, "high": 5.0})
    """Height of the base for `alive`, m."""


@dataclass(frozen=True)
class EqualsReward(ContestReward):
    """Rewards of games in which both have the same task."""

    ENDINGS = ("result", "draw")

    draw: float = -1.0
    """To both where neither wins."""


@dataclass(frozen=True)
class RolesReward(ContestReward):
    """Rewards of games in which each has a task of its own."""

    REMOVED: ClassVar[Mapping[str, str]] = {"draw": "it was removed, because this game has no term of that name"}


@dataclass(frozen=True)
class RunToGoalReward(EqualsReward):
    """Rewards of run to goal."""

    forward: float = 0.3
    """Shaping: per metre towards the own goal line."""
    distance: float = 0.0
    """Shaping: per second and metre to the own goal line."""


@dataclass(frozen=True)
class YouShallNotPassReward(RolesReward):
    """Rewards of you shall not pass."""

    timeout: float = 0.0
    """To the blocker when time is up; the runner then pays `result`."""
    forward: float = 0.125
    """Shaping: to the runner per metre towards the line."""
    distance: float = -0.1
    """Shaping: to the runner per second and metre to the line; the blocker gets its negative."""


@dataclass(frozen=True)
class RingSumoReward(EqualsReward):
    """Rewards of sumo."""

    centre: float = -0.1
    """Shaping: per second and metre from the ring's centre."""


@dataclass(frozen=True)
class KickAndDefendReward(RolesReward):
    """Rewards of kick and defend."""

    touch: float = 0.5
    """To the keeper at a save, if it has touched the ball."""
    stand: float = 0.5
    """To the keeper at a save, if it stands above `fall_height`."""
    forward: float = 0.125
    """Shaping: to the kicker per metre towards the goal."""
    approach: float = -0.1
    """Shaping: to the kicker per second and metre to the ball."""
    ball: float = -0.1
    """Shaping: to the kicker per second and metre from the ball to the goal line; the keeper gets its negative."""
