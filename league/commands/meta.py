"""`league payoff`, `meta`, `forgetting`: the payoff table of a league, who would be played in it, what was unlearnt."""

import csv
import json
import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from dashboards.tables import Column, render
from league.commands.options import Listing, Where, parse, positional
from league.config.schema import ConfigError
from league.metagame import Table, table
from league.metagame import forgetting as kept_and_forgotten
from league.query import choose
from matchmaking.equilibrium import Equilibrium, nash
from matchmaking.meta import ALPHA, POPULATION, Selection, alpharank, decompose
from storage.errors import StorageError

WIDEST = 24  # columns of a matrix that a terminal is given


@dataclass(frozen=True)
class PayoffOptions(Listing):
    """Which part of which league's payoff table, and how to print it."""

    rows: str | None = None
    """Only rows whose names match, e.g. blue@* (none: all)."""
    columns: str | None = None
    """Only columns whose names match, e.g. red@* (none: all)."""
    newest: bool = False
    """Only each player's newest snapshot, scripts and imports: cross-play."""
    arena: str | None = None
    """The ladder of this arena (none: that of the newest matches)."""
    engine: str | None = None
    """The ladder under this engine: c, jax or warp (none: that of the newest matches)."""


@dataclass(frozen=True)
class MetaOptions(Where):
    """Which payoffs, how to solve them, and how to print that."""

    file: str | None = positional(None)
    """A payoff matrix in CSV, a header of names and then a row per strategy, the row player's payoff (none: that of the
    league's rating matches)."""
    solver: Literal["nash", "alpharank"] = "nash"
    """The maximum-entropy Nash equilibrium of the zero-sum game, or the mass of alpha-rank."""
    alpha: float | None = field(default=None, metadata={"above": 0.0, "high": 1e308})
    """alpha-rank's selection intensity (none: 100)."""
    population: int | None = field(default=None, metadata={"low": 2, "high": 100_000})
    """alpha-rank's population (none: 50)."""
    selection: Selection | None = None
    """alpha-rank's fitness: of the pair that meets, or the mean over the population (none: local)."""
    rows: str | None = None
    """Of a league: only rows whose names match, e.g. blue@* (none: all)."""
    columns: str | None = None
    """Of a league: only columns whose names match (none: all)."""
    arena: str | None = None
    """Of a league: the ladder of this arena (none: that of the newest matches)."""
    engine: str | None = None
    """Of a league: the ladder under this engine (none: that of the newest matches)."""
    format: Literal["table", "json", "csv"] = "table"
    """table for people, json or csv for programs."""


def payoff(args: list[str]) -> int:
    """Print the payoff table."""
    options = parse(PayoffOptions, args, "payoff", "Scores of the snapshots against each other, a draw counted half.")
    found = _league(options, options.rows, options.columns, options.newest)
    relative = found.relative().value
    match options.format:
        case "json":
            shares = found.shares
            print(json.dumps({
                "rows": found.rows, "columns": found.columns, "scores": _plain(found.scores),
                "games": found.games.tolist(), "value": relative, "unknown_pairs": found.unknown,
                "transitive": _finite(shares.transitive) if shares else None,
                "cyclic": _finite(shares.cyclic) if shares else None,
            }, ensure_ascii=False))  # fmt: skip
        case "csv":
            lines = [
                ("", *found.columns),
                *((name, *_cells(row)) for name, row in zip(found.rows, found.scores, strict=True)),
            ]
            print("\n".join(",".join(line) for line in lines))
        case "table":
            print("\n\n".join([_matrix(found), *_notes(found, relative)]))
    return 0


def meta(args: list[str]) -> int:
    """Print the mass of each strategy, and the value."""
    options = parse(MetaOptions, args, "meta", "Who would be played: the Nash or alpha-rank mixture of a payoff table.")
    _check(options)
    notes: list[str] = []
    if options.file is None:
        found = _league(options, options.rows, options.columns)
        names, payoffs = found.rows, found.filled
        notes = _notes(found, None)
        if options.solver == "alpharank" and not found.square:
            raise StorageError(
                "alpha-rank is of one population: these rows and columns are not the same snapshots; use --solver nash."
            )
    else:
        names, payoffs = read(options.file)
        if np.allclose(payoffs + payoffs.T, (payoffs + payoffs.T)[0, 0]):
            cyclic = decompose(payoffs).cyclic
            notes = [] if math.isnan(cyclic) else [f"Cyclic share {cyclic:.3f}, transitive {1 - cyclic:.3f}."]
    solved = _solved(options, payoffs)
    rows = [{"name": name, "mass": float(p)} for name, p in zip(names, solved.mass, strict=True)]
    if options.format == "json":
        print(
            json.dumps({"mass": {row["name"]: row["mass"] for row in rows}, "value": solved.value}, ensure_ascii=False)
        )
    elif options.format == "csv":
        print(render(rows, (), "csv"))
    else:
        rows = sorted(rows, key=lambda row: -row["mass"])
        value = f"Value {round(solved.value, 9) + 0.0:.4g}: what this mixture is worth" + (
            " against the best reply." if options.solver == "nash" else " in a population so mixed."
        )
        print("\n\n".join([render(rows, (Column("name", whole=True), Column("mass", decimals=4))), value, *notes]))
    return 0


def forgetting(args: list[str]) -> int:
    """Print how players fare against their own past."""
    options = parse(
        Listing, args, "forgetting", "Each player's newest rated snapshot against its own 3 and 10 back; ! is an alarm."
    )
    with options.open() as opened:
        snapshots, players = opened.store.snapshots(opened.league), opened.store.players(opened.league)
        found = kept_and_forgotten(opened.ladder(choose(opened.ladders())), snapshots, players)
    rows = [
        {
            "player": each.player, "snapshot": each.snapshot, "back": each.back, "against": each.older,
            "score": _finite(each.score.score), "low": each.score.low, "high": each.score.high,
            "games": each.score.games, "alarm": "!" if each.forgotten else "",
        }
        for each in found
    ]  # fmt: skip
    if options.format == "table" and not rows:
        print("No player has more than three rated snapshots that could meet each other.")
    else:
        print(render(rows, (), options.format))
    return 0


def read(path: str) -> tuple[tuple[str, ...], np.ndarray]:
    """The names and the payoffs (N, N) in a CSV file; rows may begin with their names, as `league payoff` writes them.

    Raises ConfigError, one line that says where it is wrong.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is not text in UTF-8"
        raise ConfigError(("file",), f"cannot read {path}: {why}") from None
    lines = [(i, [cell.strip() for cell in row]) for i, row in enumerate(csv.reader(text.splitlines()), 1) if any(row)]
    if len(lines) < 2:
        raise ConfigError(("file",), f"{path}: no payoffs; a header row of names, then a row for each of them")
    named = lines[0][1][0] == ""  # then each row begins with its name
    names = tuple(lines[0][1][named:])
    if len(set(names)) < len(names) or "" in names:
        raise ConfigError(("file",), f"{path}:1: each strategy needs a name of its own, not {', '.join(names)}")
    if len(lines) - 1 != len(names):
        raise ConfigError(("file",), f"{path}: {len(names)} names but {len(lines) - 1} rows; one row for each name")
    payoffs = np.zeros((len(names), len(names)))
    for i, (line, cells) in enumerate(lines[1:]):
        if named and cells[0] != names[i]:
            raise ConfigError(("file",), f"{path}:{line}: the row of {names[i]} begins with {cells[0]!r}")
        if len(cells) - named != len(names):
            raise ConfigError(("file",), f"{path}:{line}: {len(cells) - named} payoffs, but {len(names)} names")
        for j, cell in enumerate(cells[named:]):
            payoffs[i, j] = _number(cell, f"{path}:{line}: the payoff of {names[i]} against {names[j]}")
    return names, payoffs


def _number(cell: str, what: str) -> float:
    if not cell:
        raise ConfigError(("file",), f"{what} is missing: the two have not met; give a number")
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or abs(value) > 1e150:
        raise ConfigError(("file",), f"{what} is {cell!r}; it must be a number")
    return value


def _check(options: MetaOptions) -> None:
    """Refuse what would do nothing."""
    if options.solver == "nash":
        for name in ("alpha", "population", "selection"):
            if (value := getattr(options, name)) is not None:
                raise ConfigError((name,), f"--{name} {value} does nothing with --solver nash; use --solver alpharank")
    if options.file is not None:
        for name in ("rows", "columns", "arena", "engine"):
            if (value := getattr(options, name)) is not None:
                raise ConfigError(
                    (name,), f"--{name} {value} is about a league's table; leave it or {options.file} out"
                )


def _solved(options: MetaOptions, payoffs: np.ndarray) -> Equilibrium:
    if options.solver == "nash":
        return nash(payoffs)
    return alpharank(payoffs, options.alpha or ALPHA, options.population or POPULATION, options.selection or "local")


def _league(options: PayoffOptions | MetaOptions, rows: str | None, columns: str | None, newest: bool = False) -> Table:
    with options.open() as opened:
        ladder = opened.ladder(choose(opened.ladders(), options.arena, options.engine))
        snapshots, players = opened.store.snapshots(opened.league), opened.store.players(opened.league)
        return table(ladder, snapshots, players, rows, columns, newest)


def _matrix(found: Table) -> str:
    """The scores in per cent; of many columns the last ones."""
    shown = found.columns[-WIDEST:]
    first = len(found.columns) - len(shown)
    rows = [
        {"score %": name, **{other: _finite(100 * row[first + j]) for j, other in enumerate(shown)}}
        for name, row in zip(found.rows, found.scores, strict=True)
    ]
    return render(rows, [Column("score %", whole=True), *(Column(name, decimals=0) for name in shown)])


def _notes(found: Table, relative: float | None) -> list[str]:
    notes = []
    if (shares := found.shares) and not math.isnan(shares.cyclic):
        notes.append(
            f"Transitive share {shares.transitive:.3f}, cyclic {shares.cyclic:.3f}: what ratings explain of the scores,"
            " and what goes round in circles."
        )
    if relative is not None and not found.square:
        notes.append(
            f"Relative population performance {relative:.3f}: the rows' best mixture against the columns' best."
        )
    if found.unknown:
        notes.append(f"{found.unknown} pairs have not met; where a number is needed they count as one half.")
    return [textwrap.fill(note, 100) for note in notes]


def _plain(scores: np.ndarray) -> list[list[float | None]]:
    return [[_finite(x) for x in row] for row in scores.tolist()]


def _cells(row: Sequence[float]) -> list[str]:
    return ["" if math.isnan(x) else repr(float(x)) for x in row]


def _finite(value: float) -> float | None:
    return None if math.isnan(value) else float(value)
