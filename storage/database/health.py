"""Troubles of a database server that its clients cause: transactions held open, and a clock that is wrong."""

import time

import sqlalchemy as sa

from storage.database import schema as t
from storage.database.connection import Database

OPEN_SECONDS = 300.0  # age from which an open transaction is named
SKEW_SECONDS = 120.0  # difference of two clocks from which it is named

# Transactions of other users are visible to members of pg_read_all_stats only. Those of other databases do no harm.
_OLDEST = sa.text("""
    SELECT pid, application_name, state, EXTRACT(epoch FROM clock_timestamp() - xact_start)
    FROM pg_stat_activity WHERE datname = current_database() AND backend_type = 'client backend'
    UNION ALL
    SELECT NULL, gid, 'prepared', EXTRACT(epoch FROM clock_timestamp() - prepared)
    FROM pg_prepared_xacts WHERE database = current_database()
    ORDER BY 4 DESC NULLS LAST LIMIT 1
""")


def server_troubles(database: Database) -> list[str]:
    """Return one line for the oldest transaction if it is older than OPEN_SECONDS, and one for a clock that differs
    from this process's by more than SKEW_SECONDS; nothing for SQLite.
    """
    if not database.is_server:
        return []
    lines = []
    [(pid, name, state, age)] = database.rows(_OLDEST) or [(None, "", "", None)]
    if age is not None and age > OPEN_SECONDS:
        holder = f"{name or 'a client without a name'}, {state}" + (f", pid {pid}" if pid is not None else "")
        lines.append(
            f"a transaction is open since {age / 60:.0f} min ({holder}): PostgreSQL keeps every dead row until it ends,"
            " and claims slow down"
        )
    skew = database.rows(sa.select(t.now()))[0][0] - time.time()
    if abs(skew) > SKEW_SECONDS:
        lines.append(
            f"the database's clock is {abs(skew) / 60:.0f} min {'ahead of' if skew > 0 else 'behind'} this machine's:"
            " leases and times of rows follow the database's"
        )
    return lines
