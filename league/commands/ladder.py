"""A ladder as tables for people, with what its figures mean."""

from collections.abc import Sequence
from itertools import combinations, product

from dashboards.tables import Column, render
from dashboards.terminal import spark, styles
from league.query import Shown, score_text
from league.rated import VOID_LIMIT, Row, rating_rows, side_score, side_text, unlike_sides
from league.words import clock, wrapped
from matchmaking.ladder import ANCHOR_ELO, UNKNOWN, Ladder
from matchmaking.payoff import quantile
from matchmaking.ticker import K
from storage.records import ArenaKey, Player, Snapshot

TICKING = (
    f"The ticker is a sequential Elo (K = {K:g} a game) over the log: it depends on the order of the games and has no"
    " interval. elo ± is the rating, a fit of all games at once."
)
RISING = "course: the ratings of a player's snapshots, from its first to this one, on one scale for all players."

COURSE = Column("course", whole=True)
ABOUT = (
    Column("trained", whole=True), Column("role", whole=True), Column("player", whole=True),
    Column("last", "last played", whole=True),
)  # fmt: skip
LADDER = (
    Column("rank", "", 0), Column("name", "snapshot", whole=True), Column("elo", decimals=0), Column("error", "±", 0),
    "games", Column("win_rate", "win rate", 3), Column("vs_initial", "vs initial", 3),
    Column("void", "void %", whole=True), Column("result", "w-d-l", whole=True), *ABOUT,
)  # fmt: skip
TRIED = (
    Column("rank", "", 0), Column("name", "snapshot", whole=True), Column("success", decimals=3),
    Column("success_low", "from", 3), Column("success_high", "to", 3), "games", Column("void", "void %", whole=True),
    *ABOUT,
)  # fmt: skip
TICKED = (
    Column("rank", "", 0), Column("name", "snapshot", whole=True), Column("ticker", decimals=0),
    Column("elo", decimals=0), Column("error", "±", 0), "games", Column("role", whole=True),
    Column("player", whole=True),
)  # fmt: skip


def ratings_table(
    ladder: Ladder, frozen: Sequence[Snapshot], players: Sequence[Player], void_limit: float = VOID_LIMIT
) -> str:
    """A ladder as a table with what its figures mean, best first; where teams are unlike, a table for each side."""
    rows = rating_rows(ladder, frozen, players, void_limit)
    return rated_table(ladder, rows, Shown(ladder.arena, [ladder], [], list(frozen), list(players), void_limit))


def rated_table(ladder: Ladder, rows: list[Row], shown: Shown, ticking: bool = False, lit: bool = False) -> str:
    """The same of some of a ladder's rows, which get columns for people; or its ticker. Where `lit`, for a terminal."""
    rows = for_people(rows)
    columns, sides = TRIED if ladder.one_team else LADDER, unlike_sides(shown.players)
    title = f"Online Elo ticker in {called(ladder.arena)}" if ticking and ladder.arena else title_of(ladder)
    columns = TICKED if ticking else columns
    if lit:
        rows, at = _lit(rows, "success" if ladder.one_team else "elo"), columns.index("games")
        columns = (*columns[:at], COURSE, *columns[at:])
    parts = [render(rows, columns, title=title, lit=lit)]
    if sides:
        of = {roster: [row for row in rows if row["roster"] == roster] for roster in sides}
        parts = [title, *(render(of[r], columns, title=f"{side_text(r)}:", lit=lit) for r in sides if of[r])]
    notes = notes_on(ladder, rows, shown)
    notes = [*([TICKING] if ticking else []), *notes, *([RISING] if lit else [])]
    return "\n\n".join([*parts, *(["\n".join(map(wrapped, notes))] if notes else [])])


def for_people(rows: Sequence[Row]) -> list[Row]:
    """A ladder's rows with the columns that tables for people have beside those for programs."""
    return [
        {
            **row,
            "error": (row["high"] - row["low"]) / 2 if row["known"] else None,
            "elo": row["elo"] if row["known"] else None,
            "trained": None if row["seconds"] is None else clock(row["seconds"]),
            "void": _void(row),
            "result": f"{row['wins']}-{row['draws']}-{row['losses']}" if row["games"] else None,
            "last": row["last_played"] and row["last_played"][:16].replace("T", " "),
        }
        for row in rows
    ]


def _lit(rows: Sequence[Row], merit: str) -> list[Row]:
    """Rows in the colours of their players, the newest of each with the course of its player's ratings."""
    courses: dict[str, list[Row]] = {}
    for row in sorted((r for r in rows if r["player"] and r[merit] is not None), key=lambda r: r["iteration"]):
        courses.setdefault(row["player"], []).append(row)
    values = [row[merit] for own in courses.values() for row in own]
    lines = {own[-1]["name"]: spark([row[merit] for row in own], min(values), max(values)) for own in courses.values()}
    colours = styles(row["player"] for row in rows if row["player"])
    return [{**row, COURSE.key: lines.get(row["name"], ""), "style": colours.get(row["player"])} for row in rows]


def notes_on(ladder: Ladder, rows: Sequence[Row], shown: Shown) -> list[str]:
    """What figures of a ladder mean, and how unlike sides fared; a line each."""
    sides = unlike_sides(shown.players)
    return [*_notes(ladder, rows, shown.void_limit, bool(sides)), *_between(ladder, shown.snapshots, sides)]


def title_of(ladder: Ladder) -> str:
    """What a ladder's table is called."""
    if ladder.arena is None:
        return "No rating match has been played yet."
    what = "Success" if ladder.one_team else "Elo"
    return f"{what} with 95 % intervals in {called(ladder.arena)}"


def called(key: ArenaKey) -> str:
    """A ladder's arena, engine and rules in a few words."""
    return f"{key.arena} under {key.engine} (rules {key.config_hash[:8]})"


def _notes(ladder: Ladder, rows: Sequence[Row], void_limit: float, by_side: bool) -> list[str]:
    """What the table's figures mean, one sentence or two for each that stands in it."""
    notes = []
    if ladder.arena is not None and not ladder.one_team:
        of = "each side's" if by_side else "the"
        notes.append(f"The mean of {of} initial snapshots is {ANCHOR_ELO:.0f} Elo.")
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
        if not {one, other} <= set(ladder.ratings.populations):
            continue
        tilt, error = ladder.ratings.tilt(one, other)
        notes.append(
            f"Between what stands at {ANCHOR_ELO:.0f} on either side the arena leans to"
            f" {side_text(one if tilt >= 0 else other)} by {abs(tilt):.0f} Elo (± {quantile(0.95) * error:.0f})."
        )
    if notes:
        notes.append("Elo tells skill within a side; between sides the tilt comes on top, role and skill in one.")
    return notes


def _void(row: Row) -> str | None:
    own, unclear = 100 * row["voids_own"], 100 * row["voids_unclear"]
    if not row["games"] and not own + unclear:
        return None
    return (f"{own:.1f}" + (f" + {unclear:.1f}" if unclear else "") if own or unclear else "0") + row["flagged"]
