"""The tables of a configuration: players, training, rating, budget, workers, storage. Imports nothing heavy."""

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

from arenas.arena_settings import Table
from league.config.durations import seconds
from matchmaking.opponents import Opponents
from matchmaking.pbt import Pbt
from matchmaking.schedule import Schedule

if TYPE_CHECKING:  # for its type only: a query does not import arenas
    from arenas.arena_settings import BufferSizes

MAX_LAYERS = 32  # equal to that of agents.settings, which a query does not import
MOST_WORLDS = 2**20  # more exceeds the memory of today's machines and is likely a typing error

LONGEST_NAME = 100  # characters: leagues and players name files, whose names have at most 255 bytes

POLICY_FILE = ".safetensors"  # ends the name of a file that `league export` wrote
SHAPING_DURATION = 500_000  # environment steps over which the dense reward fades by default


def _is_duration(value: Any) -> None:
    seconds(value)


def _lasts(value: Any) -> None:
    if seconds(value) == 0:
        raise ValueError("must be longer than nothing")


def _names_learner(value: str | None) -> None:
    from agents.settings import check_class  # late: a query does not import agents

    check_class(value)


def check_name(value: str) -> None:
    """Raise ValueError unless a text can be part of names such as blue@16 and of file names. Empty text is valid."""
    if len(value) > LONGEST_NAME:
        raise ValueError(f"a name has at most {LONGEST_NAME} characters")
    if not re.fullmatch(r"[\w.+-]*", value) or value in (".", ".."):
        raise ValueError("a name is made of letters, digits and . _ + -, and not . or .. alone")


def check_forerunner(value: str) -> None:
    """Raise ValueError unless a text can name a league or a frozen policy, or a snapshot of a league after a slash.

    A policy's file may have any name that ends as such files do.
    """
    if value.endswith(POLICY_FILE):
        return
    league, slash, snapshot = value.partition("/")
    check_name(league)
    if slash and not (league and re.fullmatch(r"[\w.+@:-]+", snapshot)):
        raise ValueError(
            "a snapshot is named by its league, a slash and its own name: main/blue@49, a file by its path:"
            f" my/policy{POLICY_FILE}"
        )


def check_forerunners(names: Sequence[str]) -> None:
    """Raise ValueError unless `check_forerunner` accepts each of these names."""
    for name in names:
        check_forerunner(name)


def check_after_parts(values: Sequence[str]) -> None:
    """Raise ValueError unless each text names a part of observations, or two as THERE=HERE."""
    for value in values:
        if not re.fullmatch("[^=]+(=[^=]+)?", value):
            raise ValueError(
                f'{value!r} is no part: give its name, "THERE=HERE" where it has another name here, or "*"'
            )


@dataclass(frozen=True)
class PlayerSettings:
    """A player: a learning lineage of policies for one team."""

    team: str = field(metadata={"valid": check_name})
    """The arena's team that it plays."""
    name: str = field(default="", metadata={"valid": check_name})
    """Its name; empty: that of its team, and team-2, team-3, ... for further players of the team."""
    role: str = field(default="main", metadata={"valid": check_name})
    """Its role: main, main_exploiter, league_exploiter, fixed (never learns), or one of [[roles]]."""
    group: str = field(default="", metadata={"valid": check_name})
    """Players of one group learn together, at most one of each team; empty: its number within its team, 1, 2, ..."""
    hidden: tuple[int, ...] | None = field(default=None, metadata={"low": 1, "high": 8192, "most": MAX_LAYERS})
    """Widths of its networks' hidden layers (none: those of learner.architecture)."""
    lr: float | None = field(default=None, metadata={"low": 0.0, "high": 1.0})
    """Learning rate of its actors (none: learner.lr)."""
    class_: str | None = field(default=None, metadata={"key": "class", "valid": _names_learner})
    """Its learner, as learner.class (none: that of the league)."""
    settings: Table = field(default_factory=Table)
    """Settings of its learner, over those of learner.settings where it is the same class."""
    flat: bool = False
    """Act by its own networks alone, without the skills of learner.skill."""
    after: tuple[str, ...] | None = field(
        default=None, metadata={"valid": lambda names: check_forerunners(names or ())}
    )
    """Leagues, snapshots or policies that it starts from, as in `after` of the league (none: those, and in a
    curriculum the stages before; []: nothing)."""

    def __post_init__(self) -> None:
        """Raise ValueError for a network without layers and for a player without a team."""
        if self.hidden == ():
            raise ValueError("hidden: must be at least one width")
        if not self.team:
            raise ValueError("team: must name one of the arena's teams")


ENOUGH = 1.5
"""The arena's longest episodes that worlds must run for between two starts: half of them then see one that is whole."""


@dataclass(frozen=True)
class Training:
    """Training of players."""

    worlds: int | None = field(default=None, metadata={"low": 2, "high": MOST_WORLDS})
    """Worlds simulated at once (none: 256 on a CPU, and on each GPU as many as suit the arena, some thousand)."""
    rollout_length: int = field(default=32, metadata={"low": 1, "high": 100_000, "formerly": "rollout"})
    """Decisions per world between two updates."""
    iterations_per_turn: int = field(default=16, metadata={"low": 1, "high": 100_000, "formerly": "turn"})
    """Learning iterations between two checkpoints at most: what a crash can cost."""
    schedule: Schedule = field(default_factory=Schedule)
    """The schedule: which teams learn, and when."""
    opponents: Opponents = field(default_factory=Opponents)
    """Opponents of learning players."""
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
    """In leapfrog, critics and value normalisers of resting teams learn on, so that none is stale at its turn."""
    record_every: int | None = field(default=None, metadata={"low": 0})
    """Learning iterations between two recordings of an episode as it is played while players learn (0: none are made;
    none: 100 on a CPU, and none are made elsewhere)."""
    stagger: bool = True
    """First episodes begin at different times, so that long ones do not all end together."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """The device on which torch learns."""
    devices: int = field(default=1, metadata={"low": 1, "high": 64})
    """GPUs over which one turn is spread, each with a process of its own and an equal part of the worlds; on a CPU
    processes."""

    def __post_init__(self) -> None:
        """Raise ValueError if the dense reward would fade in two ways at once."""
        if self.shaping_until is not None and self.shaping_steps is not None:
            raise ValueError(
                'shaping_until: the dense reward fades by success or over shaping_steps, not both; set one to "none"'
            )

    def outlasts(self, decisions: int) -> bool:
        """Return whether worlds that begin anew every turn can play episodes of so many decisions to their end."""
        return self.iterations_per_turn * self.rollout_length >= ENOUGH * decisions

    @property
    def shaping_duration(self) -> int:
        """Environment steps over which the dense reward fades, unless it fades by success."""
        return SHAPING_DURATION if self.shaping_steps is None else self.shaping_steps


@dataclass(frozen=True)
class Rating:
    """Rating of snapshots."""

    worlds: int | None = field(default=None, metadata={"low": 2, "high": MOST_WORLDS})
    """Episodes per batch, shared by its pairings; half of each pairing's play with sides swapped (none: 512 on a CPU,
    4096 on a GPU)."""
    pairings: int | None = field(default=None, metadata={"low": 1, "high": 4096})
    """Pairs of snapshots that meet in one batch (none: 4 on a CPU, 32 on a GPU)."""
    episodes_per_pair: int = field(default=128, metadata={"low": 2, "formerly": "quota"})
    """Episodes after which two snapshots have met enough."""
    final_episodes_per_pair: int = field(default=512, metadata={"low": 2, "formerly": "final_quota"})
    """The same, once training has ended, for each player's newest snapshot against the opponents by which progress is
    measured."""
    milestones: tuple[str, ...] = ("10s", "30s")
    """Training times whose snapshots the newest one is compared with."""
    scripts: tuple[str, ...] | None = None
    """Scripted opponents in the rating pool (none: all that the arena has)."""
    trained: bool = True
    """Policies that come with the league are in the rating pool of the arena in which they learnt, unless their actions
    mean another speed or angle there."""
    share: float = field(default=0.1, metadata={"low": 0.0, "high": 1.0})
    """Share of the time of the devices that train which matches may take meanwhile (1: as much as they get)."""
    void_limit: float = field(default=0.02, metadata={"low": 0.0, "high": 1.0})
    """Share of void episodes above which a snapshot is flagged: it may gain from breaking physics."""
    record: bool = True
    """Keep a recording of each pairing."""
    recordings: int = field(default=2, metadata={"low": 1, "high": MOST_WORLDS})
    """Number of episodes to record per pairing, alternating sides, at most all of them."""

    def __post_init__(self) -> None:
        """Raise ValueError for batches that cannot be shared evenly, and for milestones that are not durations."""
        if self.worlds is not None and self.worlds % (2 * (self.pairings or 1)):
            times = f"2 × rating.pairings, {2 * self.pairings}" if self.pairings else "2"
            raise ValueError(
                f"worlds: must be a multiple of {times}; every pairing plays as many episodes on either side"
            )
        for mark in self.milestones:
            try:
                seconds(mark)
            except ValueError as error:
                raise ValueError(f"milestones: {error}") from None


@dataclass(frozen=True)
class Budget:
    """Conditions that end a league; without any it trains until it is stopped."""

    training_time: str | None = field(default=None, metadata={"valid": _lasts, "formerly": "train"})
    """Training time in all, e.g. 5m or 1h30m."""
    steps: int | None = field(default=None, metadata={"low": 1})
    """Environment steps (decisions × worlds) in all."""
    rating_time: str | None = field(default=None, metadata={"valid": _is_duration, "formerly": "rate"})
    """Time for rating matches after training."""
    success: float | None = field(default=None, metadata={"above": 0.0, "below": 1.0})
    """In an arena of one team: enough when the 95 % interval of a frozen policy's success rate begins above this."""
    score: float | None = field(default=None, metadata={"above": 0.0, "below": 1.0})
    """In an arena of several teams: enough when the 95 % interval of each player's score against initial begins above
    this."""
    against: tuple[str, ...] = ()
    """Scripts, such as idle, against which score and plateau are measured instead of initial opponents: by the mean of
    the scores against each."""
    plateau: int | None = field(default=None, metadata={"low": 1})
    """Enough when no snapshot of so many has been better than the best one before them, once that one surely succeeds
    or scores in more than half of its games."""
    reward: float | None = None
    """Enough when each player's reward per episode, without shaping, was this much on average in 10 iterations, or in
    as many as the longest episode lasts."""

    @property
    def train_seconds(self) -> float:
        """Training time in seconds; infinite if there is no bound."""
        return math.inf if self.training_time is None else seconds(self.training_time)

    def within(self, other: "Budget") -> "Budget":
        """Return this budget with no more steps and no more training time than another one."""
        steps = [n for n in (self.steps, other.steps) if n is not None]
        times = [each for each in (self.training_time, other.training_time) if each is not None]
        return replace(self, steps=min(steps, default=None), training_time=min(times, key=seconds, default=None))

    @property
    def window(self) -> int:
        """Least number of iterations over which rewards and successes of training are averaged; 0: none needed."""
        if self.reward is not None:
            return 10
        return 0 if self.success is None else 16

    @property
    def ends(self) -> bool:
        """True if a setting of this budget ends training."""
        ends = (self.training_time, self.steps, self.success, self.score, self.plateau, self.reward)
        return any(each is not None for each in ends)

    @property
    def by_rating(self) -> bool:
        """True if rating matches can end training."""
        return any(each is not None for each in (self.success, self.score, self.plateau))

    def spent(self, seconds: float, steps: int) -> bool:
        """Return whether training of that many seconds and environment steps uses up the budget."""
        return seconds >= self.train_seconds or (self.steps is not None and steps >= self.steps)

    @property
    def rate_seconds(self) -> float:
        """Rating time in seconds; infinite if there is no bound."""
        return math.inf if self.rating_time is None else seconds(self.rating_time)


@dataclass(frozen=True)
class Workers:
    """The processes on this machine."""

    train: int = field(default=1, metadata={"low": 0, "high": 64})
    """Processes that train; each takes a GPU of its own where there are several (0: `league worker` trains)."""
    match: int = field(default=1, metadata={"low": 0, "high": 64})
    """Processes that play rating matches."""
    nice: int = field(default=19, metadata={"low": 0, "high": 19})
    """Niceness of match workers in the operating system: how far they give way to learning (0: not at all)."""
    threads: int = field(default=0, metadata={"low": 0, "high": 1024})
    """Threads of the C engine in each (0: all cores)."""
    lease: float = field(default=60.0, metadata={"low": 3.0, "high": 3600.0})
    """Seconds without a renewal after which a worker's job goes to another; renewed every quarter of that."""
    max_attempts: int = field(default=3, metadata={"low": 1, "high": 100, "formerly": "tries"})
    """Attempts at a failing job before it is set aside; the league continues without it."""


@dataclass(frozen=True)
class Buffers:
    """Warp's buffers for contacts, where an arena's own sizes are too small. They change no result of a world that
    fits.
    """

    contacts: int | None = field(default=None, metadata={"low": 1, "high": 100_000})
    """Slots per world in the contact pool of all worlds, for contacts and for pairs of near geoms (none: the arena's
    own)."""
    rows: int | None = field(default=None, metadata={"low": 1, "high": 100_000})
    """Constraint rows per world (none: the arena's own)."""

    def where(self) -> "BufferSizes":
        """Return the sizes that are set, as keyword arguments for building an arena."""
        found: BufferSizes = {}
        if self.contacts is not None:
            found["contacts"] = self.contacts
        if self.rows is not None:
            found["rows"] = self.rows
        return found


@dataclass(frozen=True)
class Storage:
    """Limits and places of what the store keeps."""

    blobs: str | None = None
    """Folder or URL for policies and recordings (none: ROBOT_LEAGUE_BLOBS if set, else beside a SQLite store)."""
    checkpoints: int = field(default=8, metadata={"low": 1})
    """Resume states kept of each player."""
    cached_policies: int = field(default=256, metadata={"low": 2, "formerly": "policies"})
    """Policies that a process which plays matches keeps in memory."""
    worker_retention: str = field(default="1d", metadata={"valid": _lasts, "formerly": "workers"})
    """Time for which the store remembers a process that has stopped reporting."""

    @property
    def worker_retention_seconds(self) -> float:
        """That time in seconds."""
        return seconds(self.worker_retention)


def named_players(players: tuple[PlayerSettings, ...]) -> tuple[PlayerSettings, ...]:
    """Return the players with default names and groups filled in."""
    seen: Counter[str] = Counter()
    named = []
    for player in players:
        seen[player.team] += 1
        number = seen[player.team]
        name = player.name or (player.team if number == 1 else f"{player.team}-{number}")
        named.append(replace(player, name=name, group=player.group or str(number)))
    return tuple(named)


def check_players(players: tuple[PlayerSettings, ...]) -> None:
    """Raise ValueError unless names are unique, and a group has at most one player per team."""
    roster = named_players(players)
    name, count = Counter(p.name for p in roster).most_common(1)[0] if roster else ("", 0)
    if count > 1:
        raise ValueError(f"players: {count} are called {name}; give each a name of its own")
    (group, team), count = Counter((p.group, p.team) for p in roster).most_common(1)[0] if roster else (("", ""), 0)
    if count > 1:
        raise ValueError(f"players: group {group} has {count} of team {team}; one of each team learns together")


def mains(teams: tuple[str, ...]) -> tuple[PlayerSettings, ...]:
    """Return the players of a configuration that names none: one main player for each team."""
    return named_players(tuple(PlayerSettings(team) for team in teams))


def section(name: str) -> type | None:
    """Return the class of a table of a configuration that holds settings of its own; None for any other key."""
    if name == "learner":
        from agents.settings import HappoConfig  # late: a query does not import agents unless it asks for the learner

        return HappoConfig
    return {"training": Training, "rating": Rating, "budget": Budget, "workers": Workers, "storage": Storage}.get(name)
