"""The tables of a configuration: who plays, how they learn, how they are rated, what it may cost. Nothing heavy."""

import math
import re
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from league.config.durations import seconds
from matchmaking.opponents import Opponents
from matchmaking.pbt import Pbt
from matchmaking.schedule import Schedule

MOST_WORLDS = 2**20  # beyond it no machine of today has the memory, and a slip of the keyboard is likelier

FADE_STEPS = 500_000  # environment steps over which the dense reward fades by default


def _is_duration(value: Any) -> None:
    seconds(value)


def _lasts(value: Any) -> None:
    if seconds(value) == 0:
        raise ValueError("must be longer than nothing")


def check_name(value: str) -> None:
    """Raise ValueError unless the text can be part of names such as blue@16, and the name of a file; empty text can."""
    if not re.fullmatch(r"[\w.+-]*", value) or value in (".", ".."):
        raise ValueError("a name is made of letters, digits and . _ + -, and not . or .. alone")


@dataclass(frozen=True)
class PlayerSettings:
    """A player: a learning lineage of policies for one team."""

    team: str = field(metadata={"valid": check_name})
    """The arena's team that it plays."""
    name: str = field(default="", metadata={"valid": check_name})
    """How it is called; empty: as its team, and team-2, team-3, ... where the team has more of them."""
    role: str = field(default="main", metadata={"valid": check_name})
    """What kind of player it is: main, main_exploiter, league_exploiter, fixed (never learns), or one of [[roles]]."""
    group: str = field(default="", metadata={"valid": check_name})
    """Players of one group learn together, at most one of each team; empty: its number within its team, 1, 2, ..."""
    hidden: tuple[int, ...] | None = field(default=None, metadata={"low": 1, "high": 8192})
    """Widths of its networks' hidden layers (none: as learner.architecture says)."""
    lr: float | None = field(default=None, metadata={"low": 0.0, "high": 1.0})
    """Adam's step size for its actors (none: as learner.lr says)."""

    def __post_init__(self) -> None:
        """Refuse a network without layers and a player without a team."""
        if self.hidden == ():
            raise ValueError("hidden: must be at least one width")
        if not self.team:
            raise ValueError("team: must name one of the arena's teams")


@dataclass(frozen=True)
class Training:
    """How players learn."""

    worlds: int | None = field(default=None, metadata={"low": 2, "high": MOST_WORLDS})
    """Worlds simulated at once (none: 256 on a CPU; 2048 on each GPU, which waits for launches below that)."""
    rollout: int = field(default=32, metadata={"low": 1, "high": 100_000})
    """Decisions per world between two updates."""
    turn: int = field(default=16, metadata={"low": 1, "high": 100_000})
    """Learning iterations between two checkpoints at most: what a crash can cost."""
    schedule: Schedule = field(default_factory=Schedule)
    """Which teams learn when."""
    opponents: Opponents = field(default_factory=Opponents)
    """Whom they learn against."""
    pbt: Pbt = field(default_factory=Pbt)
    """Population based training across the players of a team."""
    shaping_steps: int | None = field(default=None, metadata={"low": 0})
    """Environment steps over which the dense reward fades from full weight to none (0: outcome only; none: 500,000, or
    as shaping_until says)."""
    shaping_until: float | None = field(default=None, metadata={"above": 0.0, "high": 1.0})
    """The dense reward fades as the player's score rises instead, and is gone at this one (none: by steps)."""
    snapshots_per_doubling: int = field(default=1, metadata={"low": 1, "high": 16})
    """A snapshot at iterations 1, 2, 4, 8, ...; more of them in between with 2 or more."""
    resting_critics: bool = True
    """In leapfrog, critics and value normalisers of resting teams learn on, lest they be stale at their turn."""
    record_every: int | None = field(default=None, metadata={"low": 0})
    """Learning iterations between two recordings of an episode as it is played while players learn (0: none are made;
    none: 100 on a CPU, and none are made elsewhere)."""
    stagger: bool = True
    """First episodes begin at different times, so that long ones do not all end together."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where torch learns."""
    devices: int = field(default=1, metadata={"low": 1, "high": 64})
    """GPUs over which one turn is spread, each with a process of its own and an equal part of the worlds; on a CPU
    processes."""

    def __post_init__(self) -> None:
        """Refuse two ways at once in which the dense reward fades."""
        if self.shaping_until is not None and self.shaping_steps is not None:
            raise ValueError(
                'shaping_until: the dense reward fades by success or over shaping_steps, not both; set one to "none"'
            )

    @property
    def fade_steps(self) -> int:
        """Environment steps over which the dense reward fades, where it does not follow success."""
        return FADE_STEPS if self.shaping_steps is None else self.shaping_steps


@dataclass(frozen=True)
class Rating:
    """How snapshots are rated."""

    worlds: int = field(default=512, metadata={"low": 2, "high": MOST_WORLDS})
    """Episodes per batch, shared by its pairings; half of each pairing's play with sides swapped."""
    pairings: int = field(default=4, metadata={"low": 1, "high": 4096})
    """Pairs of snapshots that meet in one batch."""
    quota: int = field(default=128, metadata={"low": 2})
    """Episodes after which two snapshots have met enough."""
    final_quota: int = field(default=512, metadata={"low": 2})
    """The same for each player's newest snapshot against the opponents by which progress is told."""
    milestones: tuple[str, ...] = ("10s", "30s")
    """Training times whose snapshots the newest one is compared with."""
    scripts: tuple[str, ...] | None = None
    """Scripted opponents in the rating pool (none: all that the arena has)."""
    trained: bool = True
    """Policies that come with the league are in the rating pool of the arena in which they learnt."""
    share: float = field(default=0.1, metadata={"low": 0.0, "high": 1.0})
    """Share of the time of the devices that train which matches may take meanwhile (1: as much as they get)."""
    void_limit: float = field(default=0.02, metadata={"low": 0.0, "high": 1.0})
    """Share of void episodes above which a snapshot is flagged: it may gain from breaking physics."""
    record: bool = True
    """Keep a recording of each pairing."""
    recordings: int = field(default=2, metadata={"low": 1, "high": MOST_WORLDS})
    """How many of its episodes that has, the first of either side by turns, up to all of them."""

    def __post_init__(self) -> None:
        """Refuse milestones that are no durations."""
        for mark in self.milestones:
            try:
                seconds(mark)
            except ValueError as error:
                raise ValueError(f"milestones: {error}") from None


@dataclass(frozen=True)
class Budget:
    """When a league has had enough; a league goes on for ever where nothing is set."""

    train: str | None = field(default=None, metadata={"valid": _lasts})
    """Training time in all, e.g. 5m or 1h30m."""
    steps: int | None = field(default=None, metadata={"low": 1})
    """Environment steps (decisions × worlds) in all."""
    rate: str | None = field(default=None, metadata={"valid": _is_duration})
    """Time for rating matches after training."""
    success: float | None = field(default=None, metadata={"above": 0.0, "below": 1.0})
    """In an arena of one team: enough when the 95 % interval of a frozen policy's success rate begins above this."""
    reward: float | None = None
    """Enough when each player's reward per episode, without shaping, was this much on average in 10 iterations."""

    @property
    def train_seconds(self) -> float:
        """Training time in seconds; infinite where it is not bounded."""
        return math.inf if self.train is None else seconds(self.train)

    @property
    def window(self) -> int:
        """Learning iterations whose rewards are looked at."""
        return 0 if self.reward is None else 10

    @property
    def ends(self) -> bool:
        """Whether training comes to an end by itself."""
        return any(each is not None for each in (self.train, self.steps, self.success, self.reward))

    def spent(self, seconds: float, steps: int) -> bool:
        """Whether so much training is all that was asked for."""
        return seconds >= self.train_seconds or (self.steps is not None and steps >= self.steps)

    @property
    def rate_seconds(self) -> float:
        """Rating time in seconds; infinite where it is not bounded."""
        return math.inf if self.rate is None else seconds(self.rate)


@dataclass(frozen=True)
class Workers:
    """The processes on this machine."""

    train: int = field(default=1, metadata={"low": 1, "high": 64})
    """Processes that train; each takes a GPU of its own where there are several."""
    match: int = field(default=1, metadata={"low": 0, "high": 64})
    """Processes that play rating matches."""
    nice: int = field(default=19, metadata={"low": 0, "high": 19})
    """How far they stand back from learning: their niceness, as the operating system counts it (0: not at all)."""
    threads: int = field(default=0, metadata={"low": 0, "high": 1024})
    """Threads of the C engine in each (0: all cores)."""
    lease: float = field(default=60.0, metadata={"low": 3.0, "high": 3600.0})
    """Seconds after which the job of a silent worker goes to another; it says that it holds it four times as often."""
    tries: int = field(default=3, metadata={"low": 1, "high": 100})
    """How often a job that fails is tried before it is set aside; the league goes on without it."""


@dataclass(frozen=True)
class Storage:
    """What the store keeps, and where."""

    blobs: str | None = None
    """Folder or URL for policies and recordings (none: ROBOT_LEAGUE_BLOBS if set, else beside a SQLite store)."""
    checkpoints: int = field(default=8, metadata={"low": 1})
    """Resume states kept of each player."""
    policies: int = field(default=256, metadata={"low": 2})
    """Policies that a process which plays matches keeps in memory."""
    workers: str = field(default="1d", metadata={"valid": _lasts})
    """For how long the store remembers a process that went without a word."""


def named_players(players: tuple[PlayerSettings, ...]) -> tuple[PlayerSettings, ...]:
    """The players with the names and groups filled in that they have when they give none."""
    seen: Counter[str] = Counter()
    named = []
    for player in players:
        seen[player.team] += 1
        number = seen[player.team]
        name = player.name or (player.team if number == 1 else f"{player.team}-{number}")
        named.append(replace(player, name=name, group=player.group or str(number)))
    return tuple(named)


def mains(teams: tuple[str, ...]) -> tuple[PlayerSettings, ...]:
    """Who plays where a configuration names nobody: one main player for each team."""
    return named_players(tuple(PlayerSettings(team) for team in teams))
