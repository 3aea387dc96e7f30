"""`league ratings`, `league matches`, `league snapshots`: the store's tables, for people and for programs."""

from collections.abc import Callable, Sequence

from dashboards.tables import Column, Format, render
from league.options import Listing, parse
from league.query import Open, match_rows, rated, rating_rows, snapshot_rows
from storage.records import Match, Snapshot

RATING_COLUMNS = (
    Column("name", whole=True), Column("elo", decimals=0), Column("error", "±", 0), Column("episodes"),
    Column("score", decimals=3), Column("vs_initial", "vs initial", 3),
    Column("seconds", "trained s", 0),
)  # fmt: skip
MATCH_COLUMNS = (
    "match",
    Column("a", whole=True),
    Column("b", whole=True),
    "wins",
    "draws",
    "losses",
    "voids",
    Column("score", decimals=3),
    "recorded",
)
SNAPSHOT_COLUMNS = (
    Column("name", whole=True),
    "iteration",
    "steps",
    Column("seconds", "trained s", 1),
    Column("digest", "digest"),
)


def ratings(args: list[str]) -> int:
    """Print the ratings table."""
    return _print(args, "ratings", "Who is better, and how sure that is.", lambda o, f: ratings_table(*_log(o), f))


def matches(args: list[str]) -> int:
    """Print the match log."""

    def text(opened: Open, format: Format) -> str:
        rows = match_rows(opened.store.snapshots(opened.league), opened.store.matches(opened.league))
        return render(rows, MATCH_COLUMNS if format == "table" else (), format)

    return _print(args, "matches", "Every batch of episodes, counted for a.", text)


def snapshots(args: list[str]) -> int:
    """Print the frozen policies."""

    def text(opened: Open, format: Format) -> str:
        rows = snapshot_rows(opened.store.snapshots(opened.league))
        if format == "table":
            rows = [{**row, "digest": row["digest"][:12]} for row in rows]
        return render(rows, SNAPSHOT_COLUMNS if format == "table" else (), format)

    return _print(args, "snapshots", "The frozen policies and scripted opponents.", text)


def ratings_table(frozen: Sequence[Snapshot], log: Sequence[Match], format: Format = "table") -> str:
    """The ratings of snapshots from rating matches, as text."""
    rows = rating_rows(frozen, log)
    if format != "table":
        return render(rows, (), format)
    for row in rows:
        row["error"] = None if row["elo"] is None else (row["high"] - row["low"]) / 2
    title = "Elo ± 95 %; initial snapshots: 1000"
    if log:
        title += f"; the first side is worth {rated(frozen, log).side_advantage:+.0f}"
    return render(rows, RATING_COLUMNS, format, title)


def _log(opened: Open) -> tuple[list[Snapshot], list[Match]]:
    return opened.store.snapshots(opened.league), opened.store.matches(opened.league, "rating")


def _print(args: list[str], command: str, what: str, text: Callable[[Open, Format], str]) -> int:
    options = parse(Listing, args, command, what)
    with options.open() as opened:
        print(text(opened, options.format))
    return 0
