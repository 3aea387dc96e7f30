"""`league payoff`, `meta`, `forgetting`: a league's payoff table, its equilibrium, and what players have forgotten."""

import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from dashboards.tables import GAP, Column, render
from dashboards.text import wrapped
from league.commands.analyse import csv_matrix
from league.commands.options import Listing, Where, parse, positional
from league.config.schema import ConfigError
from league.queries.ratings.metagame import Table, sides_of, table
from league.queries.ratings.metagame import forgetting as kept_and_forgotten
from league.queries.ratings.payoff_csv import lines
from league.queries.ratings.rating_rows import VOID_NOTE, Row
from league.queries.ratings.shown_players import SHOWN, of_table, prominent
from league.scheduling.progress_metrics import meeting_rosters
from matchmaking.metagame.alpharank import ALPHA, POPULATION, Decomposition, Selection, alpharank, decompose
from matchmaking.metagame.mixtures import MixtureInterval, mixture_interval
from matchmaking.metagame.nash import Equilibrium, nash
from matchmaking.ratings.ladder import Ladder
from matchmaking.ratings.payoff import Payoff
from storage.errors import StorageError
from storage.records import Player, Snapshot

MIXED = ("name", "mass", "mean", "low", "high", "unmet")
"""Columns for each strategy of a league: its mass, its mass in drawn tables, and the number of unmet opponents."""
WIDEST = 24  # most rows and columns of a matrix in a terminal
RESAMPLES, EASY, FEWEST = 200, 40, 20
"""Number of tables drawn for intervals; rows above which fewer are drawn; number of tables below which none are."""


@dataclass(frozen=True)
class PayoffOptions(Listing):
    """The league, the part of its payoff table, and the format of the output."""

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
    """The payoffs, the solver, and the format of the output."""

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
    """For a league: only rows whose names match, e.g. blue@* (none: all)."""
    columns: str | None = None
    """For a league: only columns whose names match (none: all)."""
    arena: str | None = None
    """For a league: the ladder of this arena (none: that of the newest matches)."""
    engine: str | None = None
    """For a league: the ladder under this engine (none: that of the newest matches)."""
    resamples: int | None = field(default=None, metadata={"low": 0, "high": 100_000})
    """For a league: number of tables drawn by the games' uncertainty (none: 200, fewer of large tables)."""
    format: Literal["table", "json", "csv"] = "table"
    """table for people, json or csv for programs."""


def payoff(args: list[str]) -> int:
    """Print the payoff table."""
    options = parse(PayoffOptions, args, "payoff", "Scores of the snapshots against each other, a draw counted half.")
    if options.format == "csv":
        return _print_all(options)
    found, ladder, snapshots = _league(options, options.rows, options.columns, options.newest)
    relative = 0.5 if found.square else found.relative().value  # a symmetric game has the same value for both sides
    match options.format:
        case "json":
            print(json.dumps({
                "rows": found.rows, "columns": found.columns, "scores": _plain(found.scores),
                "games": found.games.tolist(), "value": relative, "unknown_pairs": found.unknown,
                "rows_asked": found.asked[0], "columns_asked": found.asked[1],
                **_about(found), "expected": _plain(found.of(found.evidence.expected())),
            }))  # fmt: skip
        case _:
            matrix = _matrix(found, ladder, snapshots)
            print("\n\n".join([*matrix, *_notes(found, None if found.square else relative)]))
    return 0


def meta(args: list[str]) -> int:
    """Print the mass of each strategy, and the value."""
    options = parse(MetaOptions, args, "meta", "Who would be played: the Nash or alpha-rank mixture of a payoff table.")
    _check(options)
    if options.file is None:
        return _of_league(options)
    names, payoffs = csv_matrix.read(options.file)
    notes: list[str] = []
    if np.allclose(payoffs + payoffs.T, (payoffs + payoffs.T)[0, 0]):
        cyclic = decompose(payoffs).cyclic
        notes = [] if math.isnan(cyclic) else [f"Cyclic share {cyclic:.3f}, transitive {1 - cyclic:.3f}."]
    solved = _solved(options, payoffs)
    rows = [{"name": name, "mass": float(p)} for name, p in zip(names, solved.mass, strict=True)]
    if options.format == "json":
        print(json.dumps({"mass": {row["name"]: row["mass"] for row in rows}, "value": solved.value}))
    elif options.format == "csv":
        print(render(rows, (), "csv"))
    else:
        rows = sorted(rows, key=lambda row: -row["mass"])
        columns = (Column("name", no_wrap=True), Column("mass", decimals=4))
        print("\n\n".join([render(rows, columns), _value(options, solved.value), *notes]))
    return 0


def _of_league(options: MetaOptions) -> int:
    """Print the mixture of a league's payoff table, with the uncertainty that its games leave."""
    found, alone = _mixed(options)
    if options.solver == "alpharank" and not found.square:
        raise StorageError(
            "alpha-rank is of one population: these rows and columns are not the same snapshots; use --solver nash."
        )
    solved, count = _solved(options, found.completed), _resamples(options, found)
    bounds = mixture_interval(lambda payoffs: _solved(options, payoffs), found.sample_tables(count)) if count else None
    sample_tables = [each.tolist() for each in bounds[:3]] if bounds else [[None] * len(found.rows)] * 3
    columns = (found.rows, solved.mass.tolist(), *sample_tables, np.isnan(found.scores).sum(1).tolist())
    rows: list[Row] = [dict(zip(MIXED, row, strict=True)) for row in zip(*columns, strict=True)]
    match options.format:
        case "json":
            print(json.dumps({
                **{key: {row["name"]: row[key] for row in rows} for key in MIXED[1:]},
                "value": solved.value, "value_low": bounds.value[0] if bounds else None,
                "value_high": bounds.value[1] if bounds else None, "resamples": count,
                "unknown_pairs": found.unknown, "left_out": alone, **_about(found),
            }))  # fmt: skip
        case "csv":
            print(render(rows, (), "csv"))
        case "table":
            rows = sorted(rows, key=lambda row: -row["mass"])
            columns = [Column("name", no_wrap=True), Column("mass", decimals=4)]
            columns += [Column(key, decimals=4) for key in MIXED[2:5]] if bounds else []
            columns += [Column("unmet", "not met")] if found.unknown else []
            value = _value(options, solved.value, None if found.square else bounds)
            notes = [*_notes(found, None), *_left_out(found), *_alone_left_out(alone)]
            print("\n\n".join([render(rows, columns), value, _drawn(count, found), *notes]))
    return 0


def _resamples(options: MetaOptions, found: Table) -> int:
    """Return the number of tables to draw: as requested, or as can be solved in some seconds."""
    if options.resamples is not None:
        return options.resamples
    most = int(RESAMPLES * min(1.0, (EASY / max(*found.scores.shape)) ** 3))
    return most if most >= FEWEST else 0


def _drawn(count: int, found: Table) -> str:
    if not count:
        text = f"A table of {len(found.rows)} × {len(found.columns)} takes long to solve: --resamples {RESAMPLES} adds"
        return wrapped(f"{text} the intervals that the games leave open.")
    text = f"mean, and low and high for 95 %: of {count} tables that the games leave possible (scores drawn from games"
    return wrapped(f"{text}{', of pairs that have not met from the ratings' if found.unknown else ''}).")


def _value(options: MetaOptions, value: float, bounds: MixtureInterval | None = None) -> str:
    between = f" ({bounds.value[0]:.4g} to {bounds.value[1]:.4g})" if bounds else ""
    return f"Value {round(value, 9) + 0.0:.4g}{between}: what this mixture is worth" + (
        " against the best reply." if options.solver == "nash" else " in a population so mixed."
    )


def forgetting(args: list[str]) -> int:
    """Print players' scores against their own past."""
    options = parse(
        Listing, args, "forgetting", "Each player's newest rated snapshot against its own 3 and 10 back; ! is an alarm."
    )
    with options.open() as opened:
        shown = opened.shown()
        found = kept_and_forgotten(shown.ladders[0], shown.snapshots, shown.players)
    rows = [
        {
            "player": each.player, "snapshot": each.snapshot, "back": each.back, "against": each.older,
            "score": _finite(each.score.score), "low": each.score.low, "high": each.score.high,
            "games": each.score.games, "alarm": "!" if each.forgotten else "",
        }
        for each in found
    ]  # fmt: skip
    if options.format == "table" and not rows:
        print(wrapped(_no_past(shown.players)))
    else:
        print(render(rows, (), options.format))
    return 0


def _no_past(players: Sequence[Player]) -> str:
    """Say why no player's snapshots are compared with each other: because they cannot meet, or not yet."""
    if len({player.team for player in players}) == 1:
        return "The arena has one team, so nobody meets anybody: `league ratings` has the successes."
    meeting = meeting_rosters(players)
    if not any((player.roster, player.roster) in meeting for player in players):
        return (
            "The sides are unlike, so no snapshot meets an older one of its own player: `league payoff` has the scores"
            " of both against the same opponents, `league ratings` their ratings within a side."
        )
    return "No player has more than three rated snapshots that could meet each other."


def _check(options: MetaOptions) -> None:
    """Raise an error for options that would have no effect."""
    if options.solver == "nash":
        for name in ("alpha", "population", "selection"):
            if (value := getattr(options, name)) is not None:
                raise ConfigError((name,), f"--{name} {value} does nothing with --solver nash; use --solver alpharank")
    if options.file is not None:
        for name in ("league", "rows", "columns", "arena", "engine", "resamples"):
            if (value := getattr(options, name)) is not None:
                raise ConfigError(
                    (name,), f"--{name} {value} is about a league's table; leave it or {options.file} out"
                )


def _solved(options: MetaOptions, payoffs: np.ndarray) -> Equilibrium:
    if options.solver == "nash":
        return nash(payoffs)
    return alpharank(payoffs, options.alpha or ALPHA, options.population or POPULATION, options.selection or "local")


def _print_all(options: PayoffOptions) -> int:
    """Print every row and every column as CSV."""
    with options.open() as opened:
        shown = opened.shown(options.arena, options.engine)
    ladder, snapshots, players = shown.ladders[0], shown.snapshots, shown.players
    named = sides_of(ladder, snapshots, players, options.rows, options.columns, options.newest)
    for line in lines(ladder, *named):
        print(line)
    return 0


def _league(
    options: PayoffOptions | MetaOptions, rows: str | None, columns: str | None, newest: bool = False
) -> tuple[Table, Ladder, list[Snapshot]]:
    with options.open() as opened:
        shown = opened.shown(options.arena, options.engine)
    ladder, snapshots = shown.ladders[0], shown.snapshots
    return table(ladder, snapshots, shown.players, rows, columns, newest), ladder, snapshots


def _mixed(options: MetaOptions) -> tuple[Table, list[str]]:
    """Return the table to solve, and the names that it leaves out because they have met one opponent alone.

    An attacker of `league exploit` has won against its victim; what its rating expects against all others is no
    evidence, and would make it the whole mixture. A pattern for rows or columns chooses it all the same.
    """
    with options.open() as opened:
        shown = opened.shown(options.arena, options.engine)
    ladder, snapshots = shown.ladders[0], shown.snapshots
    alone = _alone(ladder.payoff, snapshots) if options.rows is options.columns is None else set()
    kept = [s for s in snapshots if s.name not in alone]
    return table(ladder, kept, shown.players, options.rows, options.columns), sorted(alone)


def _alone(payoff: Payoff, snapshots: Sequence[Snapshot]) -> set[str]:
    """Return the fixed policies that have met one opponent alone, unless their side has played with no other."""
    found = _met_one(payoff) & {s.name for s in snapshots if s.player is None and not s.script}
    others = {s.roster for s in snapshots if s.name not in found and payoff.played[payoff.index(s.name)]}
    return {s.name for s in snapshots if s.name in found and s.roster in others}


def _met_one(payoff: Payoff) -> set[str]:
    """Return the names of those that have met one opponent alone, which has met others."""
    played = (payoff.home + payoff.away).sum(1) > 0
    first, second = payoff.first[played], payoff.second[played]
    met = np.bincount(np.concatenate([first, second]), minlength=len(payoff.names))
    ends = np.concatenate([first[met[second] > 1], second[met[first] > 1]])
    return {payoff.names[i] for i in ends if met[i] == 1}


def _about(found: Table) -> dict[str, Any]:
    """Return facts about a table's pairs beside their scores, for programs."""
    shares = found.shares
    return {
        "pairs": found.pairs, "unconnected_pairs": found.apart, "rings": shares.cycles if shares else None,
        "transitive": _finite(shares.transitive) if shares else None,
        "cyclic": _finite(shares.cyclic) if shares else None,
        "cyclic_by_chance": _finite(shares.chance) if shares else None,
    }  # fmt: skip


def _matrix(found: Table, ladder: Ladder, snapshots: Sequence[Snapshot]) -> list[str]:
    """Return lines with scores in per cent; if the terminal is too narrow, of the foremost snapshots, with a note."""
    down, across = of_table(found, ladder, snapshots, WIDEST)
    met = (found.games > 0).sum(0)
    ranked = [j for j in prominent(found.columns, met, ladder, snapshots) if j in set(across)]
    room = shutil.get_terminal_size().columns - 2 - max(len("score %"), *(len(found.rows[i]) for i in down))
    kept: list[int] = []
    for j in ranked:  # always the first, so that there is a table
        room -= GAP + max(len(found.columns[j]), 3)
        if kept and room < 0:
            break
        kept.append(j)
    across = sorted(kept)
    rows = [
        {
            "score %": found.rows[i],
            **{(other := found.columns[j]): found.cell(found.rows[i], other, found.scores[i, j]) for j in across},
        }
        for i in down
    ]
    columns = [Column("score %", no_wrap=True), *(Column(found.columns[j], decimals=0) for j in across)]
    text = [render(rows, columns)]
    if (len(down), len(across)) != found.asked:
        text.append(wrapped(
            f"{len(down)} × {len(across)} of {found.asked[0]:,} × {found.asked[1]:,} snapshots: {SHOWN}. --format"
            " csv has all; --rows, --columns and --newest choose."
        ))  # fmt: skip
    return text


def _notes(found: Table, relative: float | None) -> list[str]:
    notes = [VOID_NOTE] if found.suspect else []
    if shares := found.shares:
        notes.append(_shares(found, shares))
    if relative is not None:
        notes.append(
            f"Relative population performance {relative:.3f}: the rows' best mixture against the columns' best."
        )
    if found.unknown:
        text = (
            f"{found.unknown:,} of {found.pairs:,} pairs have not met (–): where a number is needed it is the score"
            " that the ratings expect."
        )
        if found.apart:
            text += f" Of {found.apart:,} of them no chain of games connects the two: only the prior compares them."
        notes.append(text)
    return [wrapped(note) for note in notes]


def _left_out(found: Table) -> list[str]:
    """Describe the snapshots in a table that lacks some of those requested."""
    if found.asked == (len(found.rows), len(found.columns)):
        return []
    return [wrapped(
        f"{len(found.rows)} × {len(found.columns)} of {found.asked[0]:,} × {found.asked[1]:,} snapshots: {SHOWN}."
        " --rows and --columns choose others; `league payoff --format csv` has all."
    )]  # fmt: skip


def _alone_left_out(names: Sequence[str]) -> list[str]:
    if not names:
        return []
    return [wrapped(
        f"Left out, because they have met one opponent alone: {', '.join(names)}. --rows '*' takes them in, and `league"
        " run` lets them meet the others."
    )]  # fmt: skip


def _shares(found: Table, shares: Decomposition) -> str:
    """Describe the transitive and cyclic parts of the game, as far as they are known."""
    met = f"{found.pairs - found.unknown:,} pairs that have met"
    if math.isnan(shares.cyclic):
        why = "are all even" if shares.cycles else "close no ring, and ratings explain any scores of such pairs"
        return f"Transitive share –, cyclic –: the {met} {why}."
    cycles = f"{shares.cycles:,} independent rings" if shares.cycles > 1 else "one ring"
    text = (
        f"Transitive share {shares.transitive:.3f}, cyclic {shares.cyclic:.3f}: what ratings explain of the scores, and"
        f" what goes round in circles. The {met} close {cycles}"
    )
    if shares.chance > 0.5 * shares.cyclic >= 0.0005:  # prints as 0.001 or more
        return f"{text}; of the cyclic share about {min(shares.chance, shares.cyclic):.3f} is chance: play more games."
    return f"{text}."


def _plain(scores: np.ndarray) -> list[list[float | None]]:
    return [[_finite(x) for x in row] for row in scores.tolist()]


def _finite(value: float) -> float | None:
    return None if math.isnan(value) else float(value)
