"""A sweep: settings that all runs share, a grid of those that differ, and seeds, as one TOML file.

    preset = "duel"
    budget.steps = 200_000

    [sweep]
    name = "lr"
    seeds = 3                                    # 1, 2, 3; or a list

    [sweep.grid]
    learner.lr = [1e-4, 3e-4, 1e-3]              # every combination
    training.rollout_length = { low = 16, high = 128, log = true }   # a range: searched by Optuna, `trials` points

Every run is a league, named by the sweep, by what differs and by its seed: `lr.lr-0.0003.s1`.
"""

import hashlib
import itertools
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from league.config import experiment, flags, toml
from league.config.build import build
from league.config.experiment import Config
from league.config.schema import ConfigError, Key, dotted
from league.config.sections import check_name

TABLE = "sweep"
LONGEST = 70  # characters of a run's name: stages and snapshots add to it
DIGITS = 8  # of a digest that stands for a long name
Objective = Literal["vs_initial", "elo", "success"]


@dataclass(frozen=True)
class Range:
    """A setting that is searched between two values, both included; whole numbers if both are."""

    low: float | int
    high: float | int
    log: bool = False


@dataclass(frozen=True)
class SweepSettings:
    """The table [sweep] of a sweep's file, without its grid."""

    name: str = field(default="", metadata={"valid": check_name})
    """The sweep's name, with which the names of its leagues begin (empty: that of the file)."""
    seeds: tuple[int, ...] = field(default=(1,), metadata={"low": 0, "high": 2**31 - 1})
    """Seeds of the runs of each cell: a list, or a number n for 1 to n."""
    parallel: int = field(default=1, metadata={"low": 1, "high": 64})
    """Number of leagues that run at the same time on this machine."""
    trials: int | None = field(default=None, metadata={"low": 1, "high": 100_000})
    """Points of the grid's ranges to try; needed where there is a range."""
    objective: Objective = "vs_initial"
    """The value that a search makes large, of the newest rated snapshot of each player but exploiters: its score
    against its initial opponents (in an arena of one team its success), or its Elo on the league's own ladder."""

    def __post_init__(self) -> None:
        """Raise ValueError if there is no seed, or one twice."""
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise ValueError("seeds: must be at least one, each once")


@dataclass(frozen=True)
class SweepRun:
    """One run of a sweep: a league, what its cell sets, and its seed."""

    cell: Mapping[str, Any]  # dotted key -> value
    seed: int
    config: Config

    @property
    def name(self) -> str:
        """The name of the league."""
        return self.config.league


@dataclass(frozen=True)
class Sweep:
    """A sweep as its file describes it."""

    settings: SweepSettings
    base: Mapping[str, Any]  # tables that all runs share
    grid: Mapping[str, Sequence[Any]]  # dotted key -> values
    ranges: Mapping[str, Range]  # dotted key -> range
    text: str
    source: str

    @property
    def name(self) -> str:
        """The sweep's name."""
        return self.settings.name

    def cells(self) -> Iterator[dict[str, Any]]:
        """Yield every combination of the grid's values."""
        for values in itertools.product(*self.grid.values()):
            yield dict(zip(self.grid, values, strict=True))

    def runs(self) -> list[SweepRun]:
        """Return the runs of the whole grid, cell by cell. Raises ConfigError, with the place in the file."""
        found = [run for cell in self.cells() for run in self.of_cell(cell)]
        names = [run.name for run in found]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise ConfigError((TABLE, "grid"), f"two cells of the grid are the same run, {twice}", f"{self.source}: ")
        return found

    def of_cell(self, cell: Mapping[str, Any]) -> list[SweepRun]:
        """Return the runs of a cell, one for each seed. Raises ConfigError, with the place in the file."""
        return [SweepRun(dict(cell), seed, self._config(cell, seed)) for seed in self.settings.seeds]

    def _config(self, cell: Mapping[str, Any], seed: int) -> Config:
        over: dict[str, Any] = {"league": run_name(self.name, cell, seed), "seed": seed}
        for key, value in cell.items():
            over = flags.merged(over, _nested(key.split("."), value))
        try:
            config = experiment.loads("", self.source, over=flags.merged(self.base, over))
            if not config.budget.ends and not config.stages:
                raise ConfigError(("budget",), "nothing ends the runs: give budget.steps, or another rule of [budget]")
            return config
        except ConfigError as error:
            inside = dotted(error.key) in cell
            at = (TABLE, "grid", *error.key) if inside else error.key
            raise ConfigError(error.key, error.message, f"{toml.place(at, self.text, self.source)}: ") from None


def read(path: Path) -> Sweep:
    """Read a sweep's file. Raises ConfigError, one line with the file and the line."""
    text, source = experiment.read(path), str(path)
    table = toml.parse(text, source)
    own = table.pop(TABLE, None)
    if not isinstance(own, Mapping):
        raise ConfigError((TABLE,), f"{source} has no table [sweep]: `league run` runs a single league")
    try:
        return _sweep(table, dict(own), text, source, path.stem)
    except ConfigError as error:
        if str(error) != error.message:  # it has its place already
            raise
        raise ConfigError(error.key, error.message, f"{toml.place(error.key, text, source)}: ") from None


def _sweep(table: dict[str, Any], own: dict[str, Any], text: str, source: str, stem: str) -> Sweep:
    grid, ranges = _axes(own.pop("grid", {}))
    seeds = own.get("seeds")
    if type(seeds) is int and 1 <= seeds <= 1000:
        own["seeds"] = [*range(1, seeds + 1)]
    elif seeds is not None and not isinstance(seeds, list):
        given = json.dumps(seeds, default=str)
        raise ConfigError((TABLE, "seeds"), f"sweep.seeds = {given}: expected their number, 1 to 1000, or a list")
    elif seeds is None and type(table.get("seed")) is int:
        own["seeds"] = [table["seed"]]
    own.setdefault("name", table.pop("league", "") or re.sub(r"[^\w.+-]", "-", stem))
    try:
        settings = build(SweepSettings, own)
    except ConfigError as error:
        message = error.message if error.message.startswith("unknown key") else f"sweep.{error.message}"
        raise ConfigError((TABLE, *error.key), message if error.key else error.message) from None
    if ranges and settings.trials is None:
        raise ConfigError(
            (TABLE, "grid", *next(iter(ranges)).split(".")),
            f"{next(iter(ranges))} is a range, which is searched: give sweep.trials, or a list of values",
        )
    if settings.trials is not None and not ranges:
        raise ConfigError(
            (TABLE, "trials"), "sweep.trials: nothing is searched; give a range in sweep.grid, or no trials"
        )
    return Sweep(settings, {k: v for k, v in table.items() if k not in ("league", "seed")}, grid, ranges, text, source)


def _axes(table: Any, prefix: Key = ()) -> tuple[dict[str, Sequence[Any]], dict[str, Range]]:
    """Return the lists and the ranges of a grid, by dotted key. Raises ConfigError for anything else."""
    if not isinstance(table, Mapping):
        raise ConfigError((TABLE, "grid"), "sweep.grid: expected a table of lists, as in learner.lr = [1e-4, 1e-3]")
    grid: dict[str, Sequence[Any]] = {}
    ranges: dict[str, Range] = {}
    for name, value in table.items():
        key = (*prefix, name)
        if dotted(key) in ("seed", "league"):
            raise ConfigError((TABLE, "grid", *key), f"sweep.grid.{dotted(key)}: give sweep.seeds, or sweep.name")
        if isinstance(value, list):
            if not value:
                raise ConfigError((TABLE, "grid", *key), f"sweep.grid.{dotted(key)}: needs at least one value")
            grid[dotted(key)] = value
        elif isinstance(value, Mapping) and "low" in value and "high" in value:
            ranges[dotted(key)] = _range(key, value)
        elif isinstance(value, Mapping):
            inner, searched = _axes(value, key)
            grid, ranges = grid | inner, ranges | searched
        else:
            text = f"sweep.grid.{dotted(key)} = {value!r}: expected a list of values, or {{ low = ..., high = ... }}"
            raise ConfigError((TABLE, "grid", *key), text)
    return grid, ranges


def _range(key: Key, table: Mapping[str, Any]) -> Range:
    at = (TABLE, "grid", *key)
    ends = [table["low"], table["high"]]
    if set(table) - {"low", "high", "log"} or any(type(end) not in (int, float) for end in ends):
        raise ConfigError(at, f"sweep.grid.{dotted(key)}: a range is {{ low = 1e-5, high = 1e-2, log = true }}")
    if not ends[0] < ends[1] or (table.get("log") and ends[0] <= 0):
        raise ConfigError(at, f"sweep.grid.{dotted(key)}: low must be below high, and above 0 where log = true")
    return Range(*ends, log=bool(table.get("log", False)))


def run_name(sweep: str, cell: Mapping[str, Any], seed: int) -> str:
    """Return the name of a run's league, the same whenever the sweep is read."""
    last = [key.rpartition(".")[2] for key in cell]
    short = [name if last.count(name) == 1 else key.replace(".", "-") for key, name in zip(cell, last, strict=True)]
    parts = [f"{name}-{_slug(value)}" for name, value in zip(short, cell.values(), strict=True)]
    name = ".".join([sweep, *parts, f"s{seed}"])
    if len(name) <= LONGEST:
        return name
    digest = hashlib.sha256(repr(sorted(cell.items())).encode()).hexdigest()[:DIGITS]
    return f"{sweep}.{digest}.s{seed}"


def _slug(value: Any) -> str:
    text = f"{value:g}" if type(value) is float else str(value).lower() if type(value) is bool else str(value)
    return re.sub(r"[^\w.+-]+", "-", text).strip("-.") or "none"


def cell_text(cell: Mapping[str, Any]) -> str:
    """Return what a cell sets, as text: `learner.lr = 0.0003`."""
    return ", ".join(f"{key} = {value}" for key, value in cell.items()) or "as in the file"


def _nested(key: Sequence[str], value: Any) -> dict[str, Any]:
    for name in reversed(key):
        value = {name: value}
    return value
