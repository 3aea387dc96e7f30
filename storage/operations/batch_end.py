"""The end of a batch of matches on a server by one statement, which locks the league only while the server works."""

import json
from collections.abc import Collection, Mapping, Sequence
from functools import cache
from typing import Any

import sqlalchemy as sa

from storage.database import schema as t
from storage.errors import StorageError
from storage.operations.leases import HELD, lease_parameters
from storage.records import Lease

TABLES = (t.matches, t.ranked_matches)


def finish(
    db: sa.Connection, lease: Lease, leagues: Collection[str], played: Mapping[sa.Table, Sequence[dict[str, Any]]]
) -> bool:
    """End a lease and append rows of matches, as `rows.match_rows` returns them, to the league's log.

    False, and nothing is done, where the lease was lost or the job is of another league than the matches.
    """
    if len(leagues) > 1:
        return False
    given = {f"rows_of_{table.name}": _json(played[table]) for table in TABLES}
    asked = {"more": sum(map(len, played.values())), "of_league": next(iter(leagues), None)}
    return db.execute(_statement(), lease_parameters(lease) | given | asked).one_or_none() is not None


def _json(rows: Sequence[dict[str, Any]]) -> str:
    try:
        return json.dumps(rows, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise StorageError(f"A value of a row is no JSON: {error}.") from error


@cache
def _statement() -> Any:
    """Return the statement. Its parts run in the order in which they read of each other: job, league, matches."""
    jobs, leagues = t.jobs.c, t.leagues.c
    its_own = jobs.league == sa.func.coalesce(sa.bindparam("of_league", type_=sa.String), jobs.league)
    ended = (
        sa.update(t.jobs).where(HELD, its_own).values(state="done", error=None, lease_until=None)
        .returning(jobs.league).cte("ended")
    )  # fmt: skip
    more = sa.bindparam("more", type_=sa.BigInteger)
    bumped = (
        sa.update(t.leagues).where(leagues.name == ended.c.league)
        .values(revision=leagues.revision + 1, matches=leagues.matches + more)
        .returning(leagues.matches, t.now().label("at")).cte("bumped")
    )  # fmt: skip
    added = [_inserted(table, bumped) for table in TABLES]
    return sa.select(ended.c.league).select_from(ended.join(bumped, sa.true())).add_cte(*added)


def _inserted(table: sa.Table, bumped: sa.CTE) -> sa.CTE:
    """Return the part that inserts the rows of one table, given as JSON."""
    from sqlalchemy.dialects.postgresql import JSON

    rows = sa.cast(sa.bindparam(f"rows_of_{table.name}", type_=sa.String), JSON)
    found = sa.func.json_populate_recordset(sa.text(f"NULL::{table.name}"), rows)
    given = found.table_valued(*(sa.column(c.name, c.type) for c in table.c), name=f"given_{table.name}")
    own = {"id": bumped.c.matches + given.c.id, "created": bumped.c.at}
    values = [own.get(c.name, given.c[c.name]) for c in table.c]
    query = sa.select(*values).select_from(bumped.join(given, sa.true()))
    return (
        sa.insert(table)
        .from_select([c.name for c in table.c], query, include_defaults=False)
        .cte(f"added_{table.name}")
    )
