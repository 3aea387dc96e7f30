"""`league ratings`, `matches`, `snapshots`, `curves`: the store's tables, for people and for programs."""

import shlex
import shutil
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations, product

from dashboards.tables import Column, Format, render
from league.commands.options import Listing, parse
from league.query import (
    VOID_LIMIT,
    Row,
    choose,
    curve_rows,
    match_rows,
    rating_rows,
    score_text,
    side_score,
    side_text,
    snapshot_rows,
    unlike_sides,
)
from matchmaking.ladder import ANCHOR_ELO, UNKNOWN, Ladder
from storage.records import ArenaKey, Player, Snapshot

NEWEST = 30
"""Rows of a long table that are printed unless more are asked for."""

RATED = (
    Column("name", whole=True), Column("elo", decimals=0), Column("error", "±", 0), "episodes",
    Column("score", decimals=3), Column("vs_initial", "vs initial", 3), Column("trained", whole=True),
    Column("void", "void %", whole=True),
)  # fmt: skip
TRIED = (
    Column("name", whole=True), Column("success", decimals=3), Column("success_low", "from", 3),
    Column("success_high", "to", 3), "episodes", Column("trained", whole=True), Column("void", "void %", whole=True),
)  # fmt: skip
MATCHES = (
    "match", Column("a", whole=True), Column("b", whole=True), Column("result", "w-d-l", whole=True), "voids",
    Column("score", decimals=3), Column("recorded", "rec."),
)  # fmt: skip
PURPOSE = Column("purpose", "for", whole=True)  # where there are others than the league's own rating matches
SNAPSHOTS = (
    Column("name", whole=True), "iteration", "steps", Column("seconds", "trained s", 1), "origin",
    Column("digest", "digest"),
)  # fmt: skip
# What a curve's table shows of the figures recorded, the most telling first; json and csv have them all.
CURVES = (
    Column("player", whole=True), Column("iteration", "it."), "steps", Column("score", decimals=2),
    Column("reward", decimals=4), Column("length", decimals=0), Column("entropy", decimals=2),
    Column("explained_variance", "expl.", 2), Column("voids", decimals=0), Column("steps_per_second", "steps/s", 0),
    Column("seconds", "trained s", 0),
)  # fmt: skip


@dataclass(frozen=True)
class RatingOptions(Listing):
    """Which ladder of which league, and how to print it."""

    arena: str | None = None
    """The ladder of this arena (none: that of the newest matches)."""
    engine: str | None = None
    """The ladder under this engine: c, jax or warp (none: that of the newest matches)."""
    all: bool = False
    """Every ladder, one after the other."""


@dataclass(frozen=True)
class LogOptions(Listing):
    """Which league, how much of it, and how to print it."""

    last: int | None = field(default=None, metadata={"low": 1})
    """So many of the newest rows (none: 30 in a table, all of them as json and csv)."""
    all: bool = False
    """Everything, in a table too."""


@dataclass(frozen=True)
class CurveOptions(LogOptions):
    """Whose learning curves, how much of them, and how to print them."""

    player: str | None = None
    """One player's (none: everyone's)."""


def ratings(args: list[str]) -> int:
    """Print the ladders."""
    options = parse(RatingOptions, args, "ratings", "Who is better, and how sure that is.")
    with options.open() as opened:
        store, keys = opened.store, opened.ladders()
        chosen = choose(keys, options.arena, options.engine)
        wanted = [key for key in keys if _fits(key, options)] if options.all else [chosen]
        frozen, players, limit = store.snapshots(opened.league), store.players(opened.league), opened.void_limit()
        found = [opened.ladder(key) for key in wanted or [None]]
    if options.format == "table":
        parts = [ratings_table(ladder, frozen, players, limit) for ladder in found]
        others = [key for key in keys if key not in wanted]
        print("\n\n".join([*parts, *_others(others, chosen)]))
    else:
        rows = [row for ladder in found for row in rating_rows(ladder, frozen, players, limit)]
        print(render(rows, (), options.format))
    return 0


def matches(args: list[str]) -> int:
    """Print the match log."""
    options = parse(LogOptions, args, "matches", "Every batch of episodes, counted for a; the newest at the end.")
    with options.open() as opened:
        rows = match_rows(opened.store.matches(opened.league))
    if options.format == "table":
        rows = [{**row, "result": f"{row['wins']}-{row['draws']}-{row['losses']}"} for row in rows]
    unlike = [key for key in ("arena", "engine") if len({row[key] for row in rows}) > 1]
    shown = list(MATCHES) if all(row["purpose"] == "rating" for row in rows) else [MATCHES[0], PURPOSE, *MATCHES[1:]]
    print(_newest(rows, [*shown, *(Column(key, whole=True) for key in unlike)], options, args, "matches"))
    return 0


def snapshots(args: list[str]) -> int:
    """Print the frozen policies."""
    options = parse(Listing, args, "snapshots", "The frozen policies and scripted opponents.")
    with options.open() as opened:
        rows = snapshot_rows(opened.store.snapshots(opened.league))
    if options.format == "table":
        rows = [{**row, "digest": row["digest"][:12]} for row in rows]
    print(render(rows, SNAPSHOTS if options.format == "table" else (), options.format))
    return 0


def curves(args: list[str]) -> int:
    """Print learning curves."""
    options = parse(CurveOptions, args, "curves", "What learning was like, iteration by iteration.")
    with options.open() as opened:
        points = opened.points(options.player)
    rows = curve_rows(sorted(points, key=lambda p: (p.iteration, p.player)))  # of several players the newest of each
    known = {key for row in rows for key in row}
    print(_newest(rows, [c for c in CURVES if (c if isinstance(c, str) else c.key) in known], options, args, "curves"))
    return 0


def ratings_table(
    ladder: Ladder, frozen: Sequence[Snapshot], players: Sequence[Player], void_limit: float = VOID_LIMIT
) -> str:
    """A ladder as a table with what its figures mean, best first; where teams are unlike, a table for each side."""
    rows = rating_rows(ladder, frozen, players, void_limit)
    for row in rows:
        row["error"] = (row["high"] - row["low"]) / 2 if row["known"] else None
        row["elo"] = row["elo"] if row["known"] else None
        row["trained"] = None if row["seconds"] is None else clock(row["seconds"])
        row["void"] = _void(row)
    columns, sides = TRIED if ladder.one_team else RATED, unlike_sides(players)
    parts = [render(rows, columns, title=_title(ladder))]
    if sides:
        of = {roster: [row for row in rows if row["roster"] == roster] for roster in sides}
        parts = [_title(ladder), *(render(of[roster], columns, title=f"{side_text(roster)}:") for roster in sides)]
    notes = [*_notes(ladder, rows, void_limit), *_between(ladder, frozen, sides)]
    return "\n\n".join([*parts, *(["\n".join(map(_wrapped, notes))] if notes else [])])


def clock(seconds: float) -> str:
    """A time as h:mm:ss, or m:ss below an hour."""
    hours, rest = divmod(int(seconds), 3600)
    minutes, rest = divmod(rest, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _title(ladder: Ladder) -> str:
    if ladder.arena is None:
        return "No rating match has been played yet."
    what = "Success" if ladder.one_team else "Elo"
    return f"{what} with 95 % intervals in {_told(ladder.arena)}"


def _told(key: ArenaKey) -> str:
    return f"{key.arena} under {key.engine} (rules {key.config_hash[:8]})"


def _notes(ladder: Ladder, rows: Sequence[Row], void_limit: float) -> list[str]:
    """What the table's figures mean, one sentence or two for each that stands in it."""
    notes = []
    if ladder.arena is not None and not ladder.one_team:
        notes.append(f"The mean of the initial snapshots is {ANCHOR_ELO:.0f} Elo.")
        if not all(row["known"] for row in rows):
            notes[0] += f" –: not yet known (an interval wider than {UNKNOWN:.0f} Elo, or no game)."
        if abs(side := ladder.ratings.side_advantage) >= 0.5:
            notes.append(
                f"Playing the first side is worth {side:+.0f} Elo: against an equal it scores"
                f" {100 * ladder.ratings.first_side():.1f} %, not 50."
            )
    if any(row["voids_own"] or row["voids_unclear"] for row in rows):
        text = "void %: episodes that unstable physics stopped, by the snapshot's own robots + of unclear cause."
        if any(row["flagged"] for row in rows):
            text += f" !: above {100 * void_limit:g} % by its own robots; ?: above it if the unclear ones are its own."
        notes.append(text)
    return notes


def _between(ladder: Ladder, frozen: Sequence[Snapshot], sides: Sequence[str]) -> list[str]:
    """How unlike sides fared against each other: all of them, and the newest of each."""
    notes = []
    for one, other in combinations(sides, 2):
        score = side_score(ladder, frozen, one, other)
        if not score.games:
            continue
        text = f"{side_text(one)} against {side_text(other)}: {score_text(score)} in all."
        known = sorted((s for s in frozen if s.player and ladder.known(s.name)), key=lambda s: s.iteration)
        newest = [[s.name for s in known if s.roster == roster][-1:] for roster in (one, other)]
        for a, b in product(*newest):
            text += f" By these ratings {a} scores {100 * ladder.ratings.expected(a, b):.1f} % against {b}."
        notes.append(text)
    if notes:
        notes.append("Elo tells skill within a side; between sides it tells role and skill in one.")
    return notes


def _void(row: Row) -> str | None:
    own, unclear = 100 * row["voids_own"], 100 * row["voids_unclear"]
    if not row["episodes"] and not own + unclear:
        return None
    return (f"{own:.1f}" + (f" + {unclear:.1f}" if unclear else "") if own or unclear else "0") + row["flagged"]


def _fits(key: ArenaKey, options: RatingOptions) -> bool:
    return options.arena in (None, key.arena) and options.engine in (None, key.engine)


def _others(keys: Sequence[ArenaKey], shown: ArenaKey | None) -> list[str]:
    """Which other ladders there are, and how to see them."""
    if not keys or shown is None:
        return []
    lines = [f"  {_told(key)}: {_reached_by(key, shown)}" for key in keys]
    return ["\n".join(["Other ladders, not to be compared with this one (--all shows every one):", *lines])]


def _reached_by(key: ArenaKey, shown: ArenaKey) -> str:
    flags = [("--arena", key.arena)] if key.arena != shown.arena else []
    flags += [("--engine", key.engine)] if key.engine != shown.engine else []
    return f"league ratings {shlex.join(x for flag in flags for x in flag)}" if flags else "older rules, --all"


def _newest(
    rows: list[Row], columns: Sequence[Column | str], options: LogOptions, args: Sequence[str], command: str
) -> str:
    """The newest rows as text, and in a table how to see the others."""
    format: Format = options.format
    last = options.last if options.last is not None else NEWEST if format == "table" else len(rows)
    shown = rows if options.all else rows[max(0, len(rows) - last) :]
    text = render(shown, columns if format == "table" else (), format)
    if format != "table" or len(shown) == len(rows):
        return text
    more = f"league {command} {shlex.join([*_without(args, '--last'), '--last', str(4 * last)])}"
    return f"{text}\n\n" + _wrapped(
        f"The newest {len(shown):,} of {len(rows):,}; `{more}` shows more, --all everything."
    )


def _without(args: Sequence[str], flag: str) -> list[str]:
    """The arguments less a flag and its value."""
    kept = list(args)
    for i, arg in enumerate(args):
        if arg == flag:
            return kept[:i] + kept[i + 2 :]
        if arg.startswith(f"{flag}="):
            return kept[:i] + kept[i + 1 :]
    return kept


def _wrapped(text: str) -> str:
    return textwrap.fill(text, shutil.get_terminal_size().columns)
