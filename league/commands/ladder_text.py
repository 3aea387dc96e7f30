"""A ladder as text: its table, best first, with notes on the meaning of its figures."""

from collections.abc import Sequence

from dashboards.tables import Column, render
from dashboards.terminal import sparkline, styles
from dashboards.text import wrapped
from league.queries.query import Shown
from league.queries.ratings import unbounded_fits
from league.queries.ratings.ladder_tables import ISLAND, LADDER, TRIED, called, for_people, notes_on, title_of
from league.queries.ratings.rating_rows import VOID_LIMIT, Row, rating_rows, side_text, unlike_sides
from matchmaking.ratings.ladder import Ladder
from matchmaking.ratings.online_elo import K
from storage.records import Player, Snapshot

TICKING = (
    f"The ticker is a sequential Elo (K = {K:g} a game) over the log: it depends on the order of the games and has no"
    " interval. elo ± is the rating, a fit of all games at once."
)
RISING = "course: the ratings of a player's snapshots, from its first to this one, on one scale for all players."

COURSE = Column("course", no_wrap=True)
TICKED = (
    Column("rank", "", 0), Column("name", "snapshot", no_wrap=True), Column("ticker", decimals=0),
    Column("elo", decimals=0), Column("error", "±", 0), "games", Column("role", no_wrap=True),
    Column("player", no_wrap=True),
)  # fmt: skip


def ratings_table(
    ladder: Ladder, frozen: Sequence[Snapshot], players: Sequence[Player], void_limit: float = VOID_LIMIT
) -> str:
    """Return a ladder as a table with notes, best first; if teams are unlike, as a table for each side."""
    rows = rating_rows(ladder, frozen, players, void_limit)
    return rated_table(ladder, rows, Shown(ladder.arena, [ladder], [], list(frozen), list(players), void_limit))


def rated_table(ladder: Ladder, rows: list[Row], shown: Shown, ticking: bool = False, lit: bool = False) -> str:
    """Return the table of some rows of a ladder, with columns for people.

    With `ticking`, return the table of the online Elo ticker. With `lit`, use colours and histories, for a terminal.
    """
    rows = for_people(rows)
    columns, sides = TRIED if ladder.one_team else LADDER, unlike_sides(shown.players)
    title = f"Online Elo ticker in {called(ladder.arena)}" if ticking and ladder.arena else title_of(ladder)
    columns = TICKED if ticking else columns
    if unbounded_fits.several_ranked(rows) and not ticking:
        columns = (columns[0], ISLAND, *columns[1:])
    if lit:
        rows, at = _lit(rows, "success" if ladder.one_team else "elo", shown.names), columns.index("games")
        columns = (*columns[:at], COURSE, *columns[at:])
    parts = [render(rows, columns, title=title, colour=lit)]
    if sides:
        of = {roster: [row for row in rows if row["roster"] == roster] for roster in sides}
        parts = [title, *(render(of[r], columns, title=f"{side_text(r)}:", colour=lit) for r in sides if of[r])]
    notes = notes_on(ladder, rows, shown, ranked=not ticking)
    notes = [*([TICKING] if ticking else []), *notes, *([RISING] if lit else [])]
    return "\n\n".join([*parts, *(["\n".join(map(wrapped, notes))] if notes else [])])


def _lit(rows: Sequence[Row], merit: str, players: Sequence[str]) -> list[Row]:
    """Return rows in the colours of their players; each player's newest row has the history of its ratings."""
    courses: dict[str, list[Row]] = {}
    for row in sorted((r for r in rows if r["player"] and r[merit] is not None), key=lambda r: r["iteration"]):
        courses.setdefault(row["player"], []).append(row)
    values = [row[merit] for own in courses.values() for row in own]
    lines = {
        own[-1]["name"]: sparkline([row[merit] for row in own], min(values), max(values)) for own in courses.values()
    }
    colours = styles((*players, *(row["player"] for row in rows if row["player"])))
    return [{**row, COURSE.key: lines.get(row["name"], ""), "style": colours.get(row["player"])} for row in rows]
