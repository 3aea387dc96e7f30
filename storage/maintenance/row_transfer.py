"""Transfer of leagues to another store as rows: the rows and columns to transfer, and the checks on arrival.

Process-related data stays behind: workers, the leader, leases (a leased job is queued again), stop requests. Numbers
assigned by a database (of runs, checkpoints, meetings, jobs) are assigned again, in the same order.
"""

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any, get_args

import sqlalchemy as sa

from storage.database import schema as t
from storage.database.rows import NEWEST_CHECKPOINT
from storage.errors import StorageError
from storage.records import Origin

TABLES: Mapping[str, sa.Table] = {
    table.name: table
    for table in (
        t.leagues,
        t.runs,
        t.players,
        t.checkpoints,
        t.snapshots,
        t.matches,
        t.ranked_matches,
        t.curves,
        t.meetings,
        t.phases,
        t.jobs,
    )
}
"""The transferred tables, each after the tables that its rows refer to."""

BATCH = 1000  # rows read or written at once

_LEFT_BEHIND = {
    "leagues": {"stop_asked", "leader", "lead_until"},
    "runs": {"id"},
    "checkpoints": {"id"},
    "meetings": {"id"},
    "jobs": {"id", "holder", "lease_until"},
}
ORDER: Mapping[str, Sequence[sa.Column[Any]]] = {
    "leagues": (t.leagues.c.created, t.leagues.c.name),
    "runs": (t.runs.c.id,),
    "players": (t.players.c.league, t.players.c.name),
    "checkpoints": (t.checkpoints.c.id,),
    "snapshots": (t.snapshots.c.league, t.snapshots.c.iteration, t.snapshots.c.name),
    "matches": (t.matches.c.league, t.matches.c.id),
    "ranked_matches": (t.ranked_matches.c.league, t.ranked_matches.c.id),
    "curves": (t.curves.c.league, t.curves.c.player, t.curves.c.iteration),
    "meetings": (t.meetings.c.id,),
    "phases": (t.phases.c.league, t.phases.c.group, t.phases.c.number),
    "jobs": (t.jobs.c.id,),
}
# The key of each table's rows. A number at a key's end increases among rows with the same values before it.
KEYS: Mapping[str, tuple[str, ...]] = {
    "leagues": ("name",), "players": ("league", "name"), "snapshots": ("league", "name"), "matches": ("league", "id"),
    "ranked_matches": ("league", "id"),
    "curves": ("league", "player", "iteration"), "phases": ("league", "group", "number"), "jobs": ("league", "key"),
}  # fmt: skip
_REFERENCES: Mapping[str, tuple[tuple[str, str], ...]] = {
    "checkpoints": (("player", "players"),), "snapshots": (("player", "players"),),
    "matches": (("a", "snapshots"), ("b", "snapshots")), "ranked_matches": (("snapshots", "snapshots"),),
    "curves": (("player", "players"),), "meetings": (("player", "players"),),
}  # fmt: skip
BLOB_COLUMNS: Mapping[str, str] = {
    "checkpoints": "digest", "snapshots": "digest", "matches": "recording", "ranked_matches": "recording",
}  # fmt: skip
"""Tables whose rows name a blob, and the column with its name."""


OLDEST_PACKED_SCHEMA = 6
"""The oldest schema whose packs can be unpacked: ADDED_COLUMNS has the columns that they lack."""
ADDED_COLUMNS: Mapping[str, frozenset[str]] = {
    "matches": frozenset({"causes"}), "ranked_matches": frozenset({"seed_clusters"}),
}  # fmt: skip
"""Columns that rows of older packs do not have; the table's own default fills them."""
ADDED_TABLES: Mapping[str, int] = {"ranked_matches": 8}
"""Tables that older packs do not have, and the schema that added each."""


def needs_blob(table: str, row: Mapping[str, Any]) -> bool:
    """Return whether a row requires a blob: a match without a recording and a thinned snapshot do not."""
    return table in BLOB_COLUMNS and row.get(BLOB_COLUMNS[table]) is not None and row.get("thinned") is None


_ALLOWED_WORDS: Mapping[tuple[str, str], tuple[str, ...]] = {
    ("snapshots", "origin"): get_args(Origin),
    ("jobs", "state"): ("queued", "done", "failed"),
}
_LISTS = {("phases", "learners"), ("ranked_matches", "snapshots"), ("ranked_matches", "voids_by_team")}
MATCHES = (t.matches, t.ranked_matches)
"""The tables of matches, whose rows one counter numbers."""
_DIGEST = re.compile(r"[0-9a-f]{64}")


def is_digest(text: str) -> bool:
    """Return whether a text can be a blob's name."""
    return _DIGEST.fullmatch(text) is not None


def columns(table: sa.Table) -> list[sa.Column[Any]]:
    """Return the transferred columns."""
    return [c for c in table.columns if c.name not in _LEFT_BEHIND.get(table.name, ())]


def dump_rows(
    db: sa.Connection, table: sa.Table, leagues: Sequence[str], newest: bool, recordings: bool
) -> Iterator[dict[str, Any]]:
    """Yield the transferable rows of a table of those leagues; with `newest` only each player's newest checkpoint."""
    league = table.c.name if table is t.leagues else table.c.league
    query = sa.select(*columns(table)).where(league.in_(leagues)).order_by(*ORDER[table.name])
    if table is t.checkpoints and newest:
        c = table.c
        rank = sa.func.row_number().over(partition_by=(c.league, c.player), order_by=NEWEST_CHECKPOINT)
        ranked = sa.select(c.id, rank.label("rank")).subquery()
        query = query.where(c.id.in_(sa.select(ranked.c.id).where(ranked.c.rank == 1)))
    for row in db.execute(query, execution_options={"yield_per": BATCH}).mappings():
        found = dict(row)
        if table is t.jobs and found["state"] == "leased":
            found["state"] = "queued"
        if table in MATCHES and not recordings:
            found["recording"] = None
        yield found


def load_rows(db: sa.Connection, table: sa.Table, rows: Iterable[Mapping[str, Any]]) -> int:
    """Insert transferred rows; return how many. Raises StorageError for a league that exists already."""
    source, count = iter(rows), 0
    while batch := [dict(row) for row in islice(source, BATCH)]:
        if table is t.leagues:
            there = db.scalars(sa.select(t.leagues.c.name).where(t.leagues.c.name.in_([row["name"] for row in batch])))
            refuse_existing(list(there))
        db.execute(sa.insert(table), batch)
        count += len(batch)
    return count


def refuse_existing(there: Sequence[str], where: str = "the store") -> None:
    """Raise StorageError if leagues with names to be added exist already."""
    if there:
        names = ", ".join(map(repr, sorted(there)))
        raise StorageError(f"There is a league {names} in {where} already: --as gives the new one another name.")


class RowChecker:
    """Checker of rows from elsewhere: can they be rows of a store? Rows come in order, tables in the order of TABLES.

    Every method raises ValueError with the reason.
    """

    def __init__(self, leagues: Iterable[str], blobs: Iterable[str]):
        self.leagues, self.blobs = set(leagues), set(blobs)
        self.named: set[str] = set()  # blobs
        self._seen: dict[str, set[tuple]] = {name: set() for name in TABLES}
        self._last: dict[tuple, int] = {}
        self._matches: dict[str, int] = {}  # league -> id of its last match

    def row(self, name: str, number: int, row: Mapping[str, Any]) -> None:
        """Check the row of that number, counted from 1, of a table."""
        try:
            self.examine(name, row)
        except ValueError as error:
            raise ValueError(f"row {number} of {name}: {error}") from None

    def accept_damaged(self, name: str, row: Mapping[str, Any]) -> None:
        """Let other rows refer to a row that has failed its check, so that one fault is reported once."""
        if name in KEYS and TABLES[name] not in MATCHES:
            self._seen[name].add(tuple(row.get(column) for column in KEYS[name]))
        if name == "leagues":
            counted = row.get("matches")
            self._matches[row.get("name", "")] = counted if isinstance(counted, int) else 2**63

    def has(self, name: str, league: str, key: str) -> bool:
        """Return whether a row of that name has been checked or accepted as damaged, in a table of named rows."""
        return (league, key) in self._seen[name]

    def end(self) -> None:
        """Check what can be checked only after the last row."""
        if missing := self.leagues - {key[0] for key in self._seen["leagues"]}:
            raise ValueError(f"no row tells of league {min(missing)!r}")
        if unnamed := self.blobs - self.named:
            raise ValueError(f"blob {min(unnamed)[:12]} is named by no row")

    def examine(self, name: str, row: Mapping[str, Any]) -> None:
        """Check the next row of a table."""
        table = TABLES[name]
        expected = {c.name for c in columns(table)}
        if odd_ones := (row.keys() ^ expected) - (ADDED_COLUMNS.get(name, frozenset()) - row.keys()):
            odd = sorted(odd_ones)[0]
            raise ValueError(f"{'unknown' if odd in row else 'missing'} column {odd!r}")
        for column in columns(table):
            if column.name not in row:
                continue
            try:
                check_value(column, row[column.name], name)
            except ValueError as error:
                raise ValueError(f"{column.name} {error}") from None
        league = row["name" if table is t.leagues else "league"]
        if league not in self.leagues:
            raise ValueError(f"league {league!r} is not one that the manifest names")
        self._require_unique(name, row)
        for column, target in _REFERENCES.get(name, ()):
            named = row[column] if isinstance(row[column], list) else [row[column]]
            for each in named:
                if each is not None and (league, each) not in self._seen[target]:
                    raise ValueError(f"{column} {str(each)[:64]!r} is none of the {target} of league {league!r}")
        if needs_blob(name, row):
            if (blob := row[BLOB_COLUMNS[name]]) not in self.blobs:
                raise ValueError(f"{BLOB_COLUMNS[name]} {blob[:64]!r} is no blob of the archive")
            self.named.add(blob)
        if table is t.leagues:
            self._matches[league] = row["matches"]
        if table in MATCHES and not 0 < row["id"] <= self._matches.get(league, 0):
            raise ValueError(f"id {row['id']} is none of the {self._matches.get(league, 0)} that its league counts")

    def _require_unique(self, name: str, row: Mapping[str, Any]) -> None:
        """Raise ValueError if two rows have one key."""
        if name not in KEYS:
            return
        key = tuple(row[column] for column in KEYS[name])
        if isinstance(key[-1], int):
            if self._last.get((name, *key[:-1]), -1) >= key[-1]:
                raise ValueError(f"{KEYS[name][-1]} {key[-1]} does not follow the one before it")
            self._last[name, *key[:-1]] = key[-1]
        elif key in self._seen[name]:
            raise ValueError(f"{key[-1]!r} is there twice")
        else:
            self._seen[name].add(key)


def check_value(column: sa.Column[Any], value: Any, table: str) -> None:
    """Raise ValueError unless any database accepts the value in that column."""
    kind = column.type
    if value is None:
        if not column.nullable:
            raise ValueError("has no value")
    elif isinstance(kind, sa.JSON):
        wanted = list if (table, column.name) in _LISTS else dict
        if not isinstance(value, wanted):
            raise ValueError(f"is no JSON {'list' if wanted is list else 'object'}")
    elif isinstance(kind, sa.Boolean):
        if not isinstance(value, bool):
            raise ValueError("is neither true nor false")
    elif isinstance(kind, sa.Integer):
        bits = 63 if isinstance(kind, sa.BigInteger) else 31
        if not isinstance(value, int) or isinstance(value, bool) or not -(2**bits) <= value < 2**bits:
            raise ValueError(f"is no whole number of {bits + 1} bits")
    elif isinstance(kind, sa.Float):
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= 1e300:
            raise ValueError("is no number")
        if not math.isfinite(value):
            raise ValueError("is not finite")
    else:
        if not isinstance(value, str):
            raise ValueError("is no text")
        _require_storable_text(value)
        if (words := _ALLOWED_WORDS.get((table, column.name))) and value not in words:
            raise ValueError(f"{value[:40]!r} is none of {', '.join(words)}")


def _require_storable_text(value: str) -> None:
    """Raise ValueError unless every database can store the text: no null character, no surrogates."""
    if "\0" in value:
        raise ValueError("holds a null character")
    try:
        value.encode()
    except UnicodeEncodeError:
        raise ValueError("is no text in UTF-8") from None
