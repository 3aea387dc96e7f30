"""Conversion of records to rows and back, and the insertion of rows: existing rows stay, or all rows are refused.

The functions that take a connection are steps of the caller's transaction.
"""

import functools
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from typing import Any, TypeVar

import sqlalchemy as sa

from storage.database import schema as t
from storage.database.rankings import FROM_COLUMNS, TO_COLUMN, check_clusters, check_rankings
from storage.errors import StorageError, UnknownName
from storage.records import (
    ArenaKey,
    Checkpoint,
    CurvePoint,
    Job,
    Match,
    Meeting,
    PairCounts,
    Phase,
    Player,
    RankedMatch,
    Snapshot,
)

R = TypeVar("R")


def columns(record: type, table: sa.Table) -> list[sa.Column[Any]]:
    """Return the columns that a record is made of, in the order of its fields."""
    return [table.c[name] for f in fields(record) for name in _SPREAD.get(f.name, (f.name,))]


def record_from(record: type[R], row: Sequence[Any]) -> R:
    """Return the record in a row of its `columns`. Raises TypeError or ValueError for a damaged row."""
    values = list(row)
    for at, name, types in _unconverted(record):  # SQLite stores any type in any column
        if not isinstance(values[at], types):
            raise TypeError(f"{name} is {str(values[at])[:40]!r}")
    for at, width, convert in _conversions(record):
        values[at : at + width] = [convert(values[at : at + width])]
    return record(*values)


def row_of(record: Any, *without: str) -> dict[str, Any]:
    """Return a record as the row to insert, except for the fields `without`, which the database sets."""
    row: dict[str, Any] = {}
    for f in fields(record):
        value = getattr(record, f.name)
        if f.name in without:
            continue
        if f.name in _SPREAD:
            row.update(zip(_SPREAD[f.name], value or [None] * len(_SPREAD[f.name]), strict=True))
        elif f.name in TO_COLUMN:
            row[f.name] = TO_COLUMN[f.name](value)
        elif isinstance(value, Mapping):
            row[f.name] = dict(value)
        else:
            row[f.name] = list(value) if isinstance(value, tuple) else value
    return row


def insert_statement(db: sa.Connection, table: sa.Table) -> Any:
    """Return an INSERT with `on_conflict_do_nothing` and `on_conflict_do_update`, in the connection's dialect."""
    if db.dialect.name == "postgresql":
        from sqlalchemy.dialects.postgresql import insert as dialect_insert
    else:
        from sqlalchemy.dialects.sqlite import insert as dialect_insert
    return dialect_insert(table)


def bump_revisions(db: sa.Connection, leagues: Iterable[str]) -> None:
    """Increase the leagues' revisions at the start of a change that planning reads, and lock their rows until the
    commit.

    Changes of one league are thereby serial on every database, and numbered rows (matches) become visible in the order
    of their numbers. Raises UnknownName.
    """
    for league in sorted(set(leagues)):
        reserve_match_ids(db, league, 0)


def reserve_match_ids(db: sa.Connection, league: str, matches: int) -> int:
    """Bump a league's revision and reserve ids for `matches` rows; return the last id. Raises UnknownName."""
    last = db.scalar(_RESERVE_MATCH_IDS, {"touched": league, "more": matches})
    if last is None:
        raise UnknownName("league", league, db.scalars(sa.select(t.leagues.c.name)))
    return last


_RESERVE_MATCH_IDS = (
    sa.update(t.leagues)
    .where(t.leagues.c.name == sa.bindparam("touched"))
    .values(revision=t.leagues.c.revision + 1, matches=t.leagues.c.matches + sa.bindparam("more", type_=sa.BigInteger))
    .returning(t.leagues.c.matches)
)


def add_players(db: sa.Connection, players: Sequence[Player]) -> int:
    """Add the new players; return how many. Raises StorageError when a player exists with other attributes."""
    new = _add(db, t.players, map(row_of, players), unique=["league", "name"])
    kept = _existing(db, t.players, players, "team", "role", "roster", "group")
    for player in players:
        asked = (player.team, player.role, player.roster, player.group)
        if (known := kept[player.league, player.name]) != asked:
            described = ("{1} of team {0} in group {3} ({2})".format(*values) for values in (known, asked))
            raise StorageError("Player {!r} is {}, not {}: choose another name.".format(player.name, *described))
    return new


def lock_players(db: sa.Connection, league: str, players: Collection[str]) -> None:
    """Lock the rows of players until the commit, so that nobody else adds or removes their checkpoints."""
    if players and db.dialect.name == "postgresql":  # a writer of SQLite has the whole file for itself
        c = t.players.c
        mine = sa.select(c.name).where(c.league == league, c.name.in_(players)).order_by(c.name)
        db.execute(mine.with_for_update(key_share=True)).all()


def add_snapshots(db: sa.Connection, snapshots: Sequence[Snapshot]) -> int:
    """Add the new snapshots; return how many. Raises StorageError when a name exists with other bytes."""
    new = _add(db, t.snapshots, (row_of(s, "created") for s in snapshots), unique=["league", "name"])
    kept = _existing(db, t.snapshots, snapshots, "digest")
    for snapshot in snapshots:
        (known,) = kept[snapshot.league, snapshot.name]
        if known != snapshot.digest:
            raise StorageError(
                f"Snapshot {snapshot.name!r} of league {snapshot.league!r} holds other bytes ({known[:12]}, not "
                f"{snapshot.digest[:12]}) and never changes: choose another name."
            )
    return new


def add_checkpoints(db: sa.Connection, league: str, checkpoints: Sequence[Checkpoint], keep: int) -> None:
    """Add checkpoints and reset their players' setbacks; with `keep` > 0 each player keeps only its newest `keep`.

    The players' rows are locked.
    """
    if not checkpoints:
        return
    db.execute(sa.insert(t.checkpoints), [row_of(c, "created") for c in checkpoints])
    players = {c.player for c in checkpoints}
    c = t.players.c
    db.execute(sa.update(t.players).where(c.league == league, c.name.in_(players)).values(setbacks=0))
    for player in players if keep > 0 else ():
        c = t.checkpoints.c
        mine = (c.league == league, c.player == player)
        newest = sa.select(c.id).where(*mine).order_by(*NEWEST_CHECKPOINT).limit(keep)
        gone = sa.delete(t.checkpoints).where(*mine, c.id.not_in(newest))
        note_dropped(db, db.scalars(gone.returning(c.digest)).all())


def note_dropped(db: sa.Connection, digests: Iterable[str]) -> None:
    """Note blobs that a row names no more: unless another row names them, they may be removed, and are not lost."""
    if found := [{"digest": digest} for digest in dict.fromkeys(digests)]:
        db.execute(insert_statement(db, t.dropped).on_conflict_do_nothing(), found)


def add_matches(db: sa.Connection, matches: Sequence[Match | RankedMatch], last: int) -> None:
    """Append to a league's log; `last` is the id of the last match: see `reserve_match_ids`.

    Raises StorageError as `match_rows` does.
    """
    for table, found in match_rows(db, matches).items():
        if found:
            db.execute(sa.insert(table), [row | {"id": last + row["id"]} for row in found])


def match_rows(db: sa.Connection, matches: Sequence[Match | RankedMatch]) -> dict[sa.Table, list[dict[str, Any]]]:
    """Return the rows of matches by table; the id of the last match is 0, and those before have -1, -2, ...

    Raises StorageError for a ranked match that contradicts itself or names a snapshot that its league does not have.
    """
    found: dict[sa.Table, list[dict[str, Any]]] = {t.matches: [], t.ranked_matches: []}
    for id, match in enumerate(matches, start=1 - len(matches)):
        row = row_of(match, "id", "created") | {"id": id}
        if isinstance(match, Match):
            found[t.matches].append(row)
            continue
        try:
            check_rankings(match.snapshots, match.rankings, match.voids, match.voids_by_team)
            check_clusters(match.rankings, match.seed_clusters)
        except ValueError as error:
            raise StorageError(f"A match of {', '.join(match.snapshots)} contradicts itself: {error}.") from None
        found[t.ranked_matches].append(row | {"episodes": match.episodes})
    _require_snapshots(db, [match for match in matches if isinstance(match, RankedMatch)])
    return found


def _require_snapshots(db: sa.Connection, matches: Sequence[RankedMatch]) -> None:
    """Raise StorageError if a match names a snapshot that its league does not have: JSON has no foreign keys."""
    c = t.snapshots.c
    for league in {match.league for match in matches}:
        named = {name for match in matches if match.league == league for name in match.snapshots}
        there = set(db.scalars(sa.select(c.name).where(c.league == league, c.name.in_(named))))
        if missing := named - there:
            raise StorageError(f"A match names snapshot {min(missing)!r}, which league {league!r} does not have.")


def add_curves(db: sa.Connection, points: Sequence[CurvePoint]) -> None:
    """Add the points, each replacing its player's point at that iteration. Raises StorageError for a NaN."""
    rows = []
    for point in points:
        values = {name: float(value) for name, value in point.values.items()}
        for name, value in values.items():
            if not math.isfinite(value):
                what = f"{name} of {point.player} at iteration {point.iteration} is {value}"
                raise StorageError(f"{what}: only finite numbers are stored in curves.")
        rows.append(row_of(point) | {"values": values})
    if rows:
        put = insert_statement(db, t.curves)
        again = {name: put.excluded[name] for name in ("step", "seconds", "values")}
        db.execute(put.on_conflict_do_update(index_elements=["league", "player", "iteration"], set_=again), rows)


def add_meetings(db: sa.Connection, meetings: Sequence[Meeting]) -> None:
    """Append outcomes of training games. Their league's row is locked, so they are numbered in commit order."""
    if meetings:
        db.execute(sa.insert(t.meetings), [row_of(meeting, "id") for meeting in meetings])


def add_phases(db: sa.Connection, phases: Sequence[Phase]) -> int:
    """Add the phases whose number their group does not have yet; return how many."""
    return _add(db, t.phases, (row_of(p, "created") for p in phases), unique=["league", "group", "number"])


def without_thinned(db: sa.Connection, jobs: Sequence[Job]) -> list[Job]:
    """Return the jobs that name no thinned snapshot: their planner did not know of the thinning, and will plan again.

    Thinning spares every snapshot that a queued job names. Both lock the league's row first, so no job waits in vain.
    """
    named = {id(job): {text for text in strings_in(job.payload) if _can_be_name(text)} for job in jobs}
    c, kept = t.snapshots.c, list(jobs)
    for league in {job.league for job in jobs}:
        every = sorted(set().union(*(named[id(job)] for job in jobs if job.league == league)))
        gone: set[str] = set()
        for at in range(0, len(every), 500):
            some = (c.league == league, c.name.in_(every[at : at + 500]), c.thinned.is_not(None))
            gone.update(db.scalars(sa.select(c.name).where(*some)))
        kept = [job for job in kept if job.league != league or gone.isdisjoint(named[id(job)])]
    return kept


def _can_be_name(text: str) -> bool:
    """Return whether every database accepts the text in a query: a payload may hold any text, a name may not."""
    return "\0" not in text and text.encode(errors="ignore").decode() == text


def strings_in(value: object) -> Iterator[str]:
    """Yield all strings in a JSON value, keys included."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        yield from value
        for each in value.values():
            yield from strings_in(each)
    elif isinstance(value, list | tuple):
        for each in value:
            yield from strings_in(each)


def add_jobs(db: sa.Connection, jobs: Sequence[Job]) -> int:
    """Add the jobs whose key their league does not have yet, in any state; return how many."""
    rows = [
        {"league": j.league, "kind": j.kind, "key": j.key, "payload": dict(j.payload), "priority": j.priority}
        for j in jobs
    ]
    return _add(db, t.jobs, rows, unique=["league", "key"])


NEWEST_CHECKPOINT = (t.checkpoints.c.iteration.desc(), t.checkpoints.c.id.desc())
NEWEST_PHASE = (t.phases.c.number.desc(),)


def _add(db: sa.Connection, table: sa.Table, rows: Iterable[Mapping[str, Any]], unique: list[str]) -> int:
    if not (given := [dict(row) for row in rows]):
        return 0
    statement = insert_statement(db, table).on_conflict_do_nothing(index_elements=unique)
    return len(db.execute(statement.returning(table.c.league), given).all())


def _existing(db: sa.Connection, table: sa.Table, given: Iterable[Any], *names: str) -> dict[tuple[str, str], tuple]:
    """Return the table's rows with the names of these records: (league, name) -> the values of the columns `names`."""
    by_league: dict[str, set[str]] = {}
    for record in given:
        by_league.setdefault(record.league, set()).add(record.name)
    kept: dict[tuple[str, str], tuple] = {}
    for league, asked in by_league.items():
        mine = (table.c.league == league, table.c.name.in_(asked))
        query = sa.select(table.c.name, *(table.c[name] for name in names)).where(*mine)
        kept |= {(league, row[0]): tuple(row[1:]) for row in db.execute(query)}
    return kept


# Fields that take several columns, and the functions that make a field from its columns.
_SPREAD: dict[str, tuple[str, ...]] = {"arena": ArenaKey._fields, "pairs": PairCounts._fields}


def _mapping(values: Sequence[Any]) -> Mapping[str, Any]:
    (value,) = values
    if not isinstance(value, dict):
        raise TypeError(f"{value!r} is no JSON object")
    return value


_FROM: dict[str, Callable[[list[Any]], Any]] = {
    "arena": lambda values: None if values[0] is None else ArenaKey._make(values),
    "pairs": PairCounts._make,
    "learners": lambda values: tuple(values[0]),
    "initial": lambda values: bool(values[0]),
    **FROM_COLUMNS,
    **dict.fromkeys(("payload", "values", "since", "until", "status", "versions"), _mapping),
}


_TYPES: dict[Any, tuple[type, ...]] = {str: (str,), int: (int,), float: (float, int), Mapping[str, Any]: (dict,)}
_TYPES |= {kind | None: (*types, type(None)) for kind, types in _TYPES.items()}


@functools.cache
def _unconverted(record: type) -> list[tuple[int, str, tuple[type, ...]]]:
    """Return (index, name, types) of the columns stored unconverted."""
    found, at = [], 0
    for f in fields(record):
        if f.type in _TYPES:
            found.append((at, f.name, _TYPES[f.type]))
        at += len(_SPREAD.get(f.name, (f.name,)))
    return found


@functools.cache
def _conversions(record: type) -> list[tuple[int, int, Callable[[list[Any]], Any]]]:
    """Return (index, width, function) of the fields made from columns; the last first, so that earlier indices stay
    valid.
    """
    found, at = [], 0
    for f in fields(record):
        width = len(_SPREAD.get(f.name, (f.name,)))
        if f.name in _FROM:
            found.append((at, width, _FROM[f.name]))
        at += width
    return found[::-1]
