"""The whole experiment as one frozen dataclass: league.toml, the command line and the run's record are all this.

`arena` holds the settings that the arena itself defines, so its keys depend on the arena that is named.
"""

import difflib
import math
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import arenas
from agents.happo import HappoConfig
from agents.networks import Architecture
from arenas.engines import EngineName, choose
from league import toml
from league.durations import seconds
from league.settings import ConfigError
from matchmaking.opponents import Opponents
from matchmaking.schedule import Schedule


def _is_duration(value: Any) -> None:
    seconds(value)


@dataclass(frozen=True)
class Training:
    """How players learn."""

    worlds: int = field(default=256, metadata={"low": 2})
    """Worlds simulated at once."""
    rollout: int = field(default=32, metadata={"low": 1})
    """Decisions per world between two updates."""
    turn: int = field(default=16, metadata={"low": 1})
    """Learning iterations between two checkpoints at most: what a crash can cost."""
    schedule: Schedule = field(default_factory=Schedule)
    """Which teams learn when."""
    opponents: Opponents = field(default_factory=Opponents)
    """Whom they learn against."""
    shaping_steps: int = field(default=500_000, metadata={"low": 0})
    """Environment steps over which the dense reward fades from full weight to none (0: outcome only)."""
    snapshots_per_doubling: int = field(default=1, metadata={"low": 1, "high": 16})
    """A snapshot at iterations 1, 2, 4, 8, ...; more of them in between with 2 or more."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where torch learns: auto, cpu or cuda."""


@dataclass(frozen=True)
class Rating:
    """How snapshots are rated."""

    worlds: int = field(default=512, metadata={"low": 2})
    """Episodes per batch, shared by its pairings; half of each pairing's play with sides swapped."""
    pairings: int = field(default=4, metadata={"low": 1})
    """Pairs of snapshots that meet in one batch."""
    quota: int = field(default=128, metadata={"low": 2})
    """Episodes after which two snapshots have met enough."""
    final_quota: int = field(default=512, metadata={"low": 2})
    """The same for each player's newest snapshot against the opponents by which progress is told."""
    milestones: tuple[str, ...] = ("10s", "30s")
    """Training times whose snapshots the newest one is compared with."""
    scripts: tuple[str, ...] = ("idle", "random", "pusher", "centre-holder")
    """Scripted opponents in the rating pool."""
    record: bool = True
    """Keep a recording of one episode per pairing."""

    def __post_init__(self) -> None:
        """Refuse milestones that are no durations."""
        for mark in self.milestones:
            try:
                seconds(mark)
            except ValueError as error:
                raise ValueError(f"milestones: {error}") from None

    @property
    def milestone_seconds(self) -> tuple[float, ...]:
        """The milestones in seconds of training."""
        return tuple(seconds(mark) for mark in self.milestones)


@dataclass(frozen=True)
class Budget:
    """When a league has had enough; a league goes on for ever where nothing is set."""

    train: str | None = field(default=None, metadata={"valid": _is_duration})
    """Training time in all, e.g. 5m or 1h30m."""
    steps: int | None = field(default=None, metadata={"low": 1})
    """Environment steps (decisions × worlds) in all."""
    rate: str | None = field(default=None, metadata={"valid": _is_duration})
    """Time for rating matches after training."""

    @property
    def train_seconds(self) -> float:
        """Training time in seconds; infinite where it is not bounded."""
        return math.inf if self.train is None else seconds(self.train)

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

    train: int = field(default=1, metadata={"low": 0, "high": 64})
    """Processes that train."""
    match: int = field(default=1, metadata={"low": 0, "high": 64})
    """Processes that play rating matches, at a lower priority of the operating system."""
    threads: int = field(default=0, metadata={"low": 0, "high": 1024})
    """Threads of the C engine in each (0: all cores)."""
    lease: float = field(default=30.0, metadata={"low": 3.0, "high": 3600.0})
    """Seconds after which a silent worker's job goes to another; it says it is alive four times as often."""


@dataclass(frozen=True)
class Config:
    """A league."""

    league: str = "main"
    """The league's name in its store."""
    seed: int = field(default=1, metadata={"low": 0, "high": 2**31 - 1})
    """Seeds everything that is random."""
    deterministic: bool = False
    """On a CPU: end byte for byte the same however often the league is killed. Turns then start from fresh worlds."""
    engine: EngineName = "auto"
    """Physics: auto, c, jax or warp."""
    arena: Any = field(default_factory=lambda: arenas.settings("sumo-2v2"))
    """The game; `name` chooses it."""
    training: Training = field(default_factory=Training)
    """How players learn."""
    learner: HappoConfig = field(default_factory=HappoConfig)
    """HAPPO."""
    rating: Rating = field(default_factory=Rating)
    """How snapshots are rated."""
    budget: Budget = field(default_factory=Budget)
    """When the league has had enough."""
    workers: Workers = field(default_factory=Workers)
    """Processes on this machine."""

    def __post_init__(self) -> None:
        """Check what depends on several settings."""
        if self.deterministic and self.training.opponents.kind == "prioritized":
            raise ValueError(
                "deterministic: opponents.kind = 'prioritized' follows ratings, whose matches end in no fixed order;"
                " use latest, uniform or delta_uniform"
            )
        if self.rating.worlds % (2 * self.rating.pairings):
            raise ValueError(
                f"rating: worlds {self.rating.worlds} must be a multiple of 2 × pairings, {2 * self.rating.pairings};"
                " every pairing plays as many episodes on either side"
            )


def default(arena: str = "sumo-2v2") -> Config:
    """The default settings of a league in that arena. Raises ArenaError for an unknown one."""
    return Config(arena=arenas.settings(arena))


def quickstart() -> Config:
    """2v2 rovers that learn to push each other out of a shrinking ring: five minutes on two cores, then ratings."""
    config = default()
    # Below 2,000 worlds a GPU waits for launches; on a CPU more worlds only make updates rarer.
    training = replace(config.training, worlds=2048 if choose("auto") == "warp" else config.training.worlds)
    return replace(config, league="quickstart", training=training, budget=Budget(train="5m", rate="3m"))


def duel() -> Config:
    """1v1 rovers: twice as fast to simulate, and flat after half a minute."""
    config = default("sumo-1v1")
    return replace(config, league="duel", budget=Budget(train="2m", rate="1m"))


def paper() -> Config:
    """HARL-A's learner and leapfrog schedule (its table of settings) on 2v2 rovers, in our arena at its 50 Hz."""
    config = default()
    arena = config.arena
    rules = replace(
        arena.rules, ring=(3.0, 6.0), episode=30.0, shrink_after=30.0, decide_every=1, timestep=0.005,
        drive_scale=10.0, steer_scale=0.1,
    )  # fmt: skip
    learner = HappoConfig(
        Architecture((128, 128), "relu", True), lr=5e-4, critic_lr=5e-4, gamma=0.99, entropy=0.01, epochs=5,
        minibatches=1, max_grad_norm=10.0, initial_std=0.3655, fixed_order=True,
    )  # fmt: skip
    training = replace(
        config.training, worlds=5000, rollout=200, schedule=Schedule("leapfrog", 50), shaping_steps=0, device="auto"
    )
    arena = replace(arena, rules=rules, reward=replace(arena.reward, timeout_penalty=1.0))
    return replace(config, league="paper", arena=arena, learner=learner, training=training)


PRESETS = {"quickstart": quickstart, "duel": duel, "paper": paper}


def preset(name: str) -> Config:
    """A preset by name. Raises ConfigError, one line with what exists, for an unknown one."""
    if name not in PRESETS:
        near = difflib.get_close_matches(name, PRESETS, 1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise ConfigError(("preset",), f"unknown preset {name!r}: {hint}(presets: {', '.join(PRESETS)})")
    return PRESETS[name]()


def loads(text: str, source: str = "league.toml") -> Config:
    """A configuration from TOML; what it leaves out is as in the defaults of the arena that it names."""
    arena = re.search(r"^\s*\[arena\][^\[]*?^\s*name\s*=\s*[\"']([^\"'\n]+)", text, re.MULTILINE)
    return toml.loads(text, Config, source, default(arena[1]) if arena else default())


def load(path: Path) -> Config:
    """A configuration from a file."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError((), f"cannot read {path}: {error}; `league init` writes a file to start from") from error
    return loads(text, str(path))


def dumps(config: Config) -> str:
    """The configuration as a commented file that `loads` reads back unchanged."""
    return toml.dumps(config)
