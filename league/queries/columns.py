"""Columns of the tables of matches, snapshots, learning curves, players and workers, for commands and the page."""

from collections.abc import Mapping, Sequence
from typing import Any

from dashboards.tables import Column

NEWEST = 30
"""Default number of rows printed of a long table."""
RECORDED = Column("recorded", "rec.")
MATCHES = (
    "match", Column("a", no_wrap=True), Column("b", no_wrap=True), Column("result", "w-d-l", no_wrap=True), "voids",
    Column("score", decimals=3), RECORDED,
)  # fmt: skip
LINEUPS = (
    "match", Column("lineup"), Column("mean_ranks", "mean ranks"), "voids", RECORDED,
)  # fmt: skip
PURPOSE = Column("purpose", "for", no_wrap=True)  # shown if not all matches are the league's own rating matches
SNAPSHOTS = (
    Column("name", no_wrap=True), "iteration", "steps", Column("seconds", "trained s", 1), "origin",
    Column("digest", "digest"),
)  # fmt: skip
CURVES = (
    Column("player", no_wrap=True), Column("iteration", "it."), "steps", Column("score", decimals=2),
    Column("reward", decimals=4), Column("length", decimals=0), Column("entropy", decimals=2),
    Column("explained_variance", "expl.", 2), Column("void", "void %", 1), Column("steps_per_second", "steps/s", 0),
    Column("seconds", "trained s", 0),
)  # fmt: skip
"""The most important recorded metrics of learning; JSON and CSV have all."""
PLAYERS = (
    Column("player", no_wrap=True), "team", "role", "iteration", "steps", Column("now", no_wrap=True),
    Column("trained", no_wrap=True), "group",
)  # fmt: skip
WORKERS = (
    "worker", "doing", "learners", Column("iteration", "it."), Column("steps/s", decimals=0),
    Column("job", no_wrap=True), Column("lease s", decimals=0), Column("seen s ago", decimals=1),
)  # fmt: skip


def match_columns(rows: Sequence[Mapping[str, Any]]) -> list[Column | str]:
    """Return the columns of a table of matches: those of lineups, of pairs, or both, as they occur."""
    lineups = [row for row in rows if row.get("lineup")]
    if not lineups:
        return list(MATCHES)
    return list(LINEUPS) if len(lineups) == len(rows) else [*MATCHES[:-1], *LINEUPS[1:3], RECORDED]


def result_text(row: Mapping[str, Any]) -> str | None:
    """Return wins, draws and losses of A in a row of a match; None for a match of more than two teams."""
    return None if row.get("lineup") else f"{row['wins']}-{row['draws']}-{row['losses']}"
