"""The tables of a store, their migrations and the database's clock.

The same definitions serve SQLite (one host, a file) and PostgreSQL (many hosts, a server).
"""

from collections.abc import Callable
from typing import Any

import sqlalchemy as sa
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.functions import FunctionElement

from storage.records import ArenaKey, PairCounts


class now(FunctionElement[float]):  # noqa: N801  (reads as SQL)
    """Seconds since the epoch on the database's clock, the only clock that all workers share."""

    type = sa.Double()
    inherit_cache = True


@compiles(now, "sqlite")
def _now_sqlite(*_: Any, **__: Any) -> str:
    return "((julianday('now') - 2440587.5) * 86400.0)"


@compiles(now, "postgresql")
def _now_postgresql(*_: Any, **__: Any) -> str:
    return "CAST(extract(epoch from clock_timestamp()) AS double precision)"


class timeline(FunctionElement[int]):  # noqa: N801
    """Number of the server's history, which grows whenever a standby is promoted; 0 on a standby and on SQLite."""

    type = sa.BigInteger()
    inherit_cache = True


@compiles(timeline, "sqlite")
def _timeline_sqlite(*_: Any, **__: Any) -> str:
    return "0"


@compiles(timeline, "postgresql")
def _timeline_postgresql(*_: Any, **__: Any) -> str:
    # The first eight hexadecimal digits of the name of a file of its log.
    digits = "left(pg_walfile_name(pg_current_wal_insert_lsn()), 8)"
    return f"(CASE WHEN pg_is_in_recovery() THEN 0 ELSE CAST(CAST('x' || {digits} AS bit(32)) AS bigint) END)"


class relaxed_durability(FunctionElement[Any]):  # noqa: N801
    """Expression for a statement's RETURNING that makes the commit not wait for the server's disk."""

    type = sa.String()
    inherit_cache = True


@compiles(relaxed_durability, "sqlite")
def _relaxed_durability_sqlite(*_: Any, **__: Any) -> str:
    return "NULL"  # SQLite sets durability at the start of a transaction, see `Database.writing`


@compiles(relaxed_durability, "postgresql")
def _relaxed_durability_postgresql(*_: Any, **__: Any) -> str:
    return "set_config('synchronous_commit', 'off', true)"


metadata = sa.MetaData()


def _league(**options: Any) -> sa.Column[str]:
    return sa.Column("league", sa.ForeignKey("leagues.name"), nullable=False, **options)


def _count(name: str, **options: Any) -> sa.Column[int]:
    return sa.Column(name, sa.BigInteger, nullable=False, **options)


def _real(name: str, **options: Any) -> sa.Column[float]:
    return sa.Column(name, sa.Double, nullable=False, **options)


def _time(name: str) -> sa.Column[float]:
    return _real(name, default=now())


def _text(name: str, **options: Any) -> sa.Column[str]:
    return sa.Column(name, sa.String, nullable=options.pop("nullable", False), **options)


def _json(name: str, **options: Any) -> sa.Column[Any]:
    return sa.Column(name, sa.JSON, nullable=False, **options)


def _arena(nullable: bool) -> list[sa.Column[str]]:
    return [_text(name, nullable=nullable) for name in ArenaKey._fields]


def _of_player() -> sa.ForeignKeyConstraint:
    return sa.ForeignKeyConstraint(["league", "player"], ["players.league", "players.name"])


# One row per schema change of this database. The table's name also identifies a store.
changes = sa.Table(
    "robot_league", metadata, sa.Column("schema", sa.Integer, primary_key=True), _text("change"), _time("made")
)

IDENTITY = 0
"""Schema number of the row whose `change` is the store's identity, see `storage.blobs.identity`."""

leagues = sa.Table(
    "leagues",
    metadata,
    _text("name", primary_key=True),
    _text("config"),
    _time("created"),
    sa.Column("stop_asked", sa.Double),
    _count("revision", default=0),  # increased first in every transaction that changes what planning reads
    _count("matches", default=0),  # the number of the last match
    _text("leader", nullable=True),  # the manager that leads the league, until lead_until unless renewed
    sa.Column("lead_until", sa.Double),
)
runs = sa.Table(
    "runs",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    _league(),
    *map(_text, ("config", "host")),
    _json("versions"),
    _time("started"),
)
players = sa.Table(
    "players",
    metadata,
    _league(primary_key=True),
    _text("name", primary_key=True),
    sa.Column("team", sa.Integer, nullable=False),
    *map(_text, ("role", "roster", "group")),
    sa.Column("setbacks", sa.Integer, nullable=False),
    _text("paused", nullable=True),
)
checkpoints = sa.Table(
    "checkpoints",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    *map(_text, ("league", "player", "digest")),
    *map(_count, ("step", "iteration")),
    _real("seconds"),
    *_arena(nullable=True),
    _time("created"),
    _of_player(),
    sa.Index("checkpoints_of_player", "league", "player", "iteration"),
)
snapshots = sa.Table(
    "snapshots",
    metadata,
    _league(primary_key=True),
    _text("name", primary_key=True),
    *map(_text, ("digest", "roster", "origin", "settings")),
    *(_text(name, nullable=True) for name in ("player", "script", "parent")),
    sa.Column("initial", sa.Boolean, nullable=False),
    *_arena(nullable=True),
    *map(_count, ("step", "iteration")),
    _real("seconds"),
    _time("created"),
    sa.Column("thinned", sa.Double),
    _of_player(),
)
matches = sa.Table(
    "matches",
    metadata,
    _league(primary_key=True),
    sa.Column("id", sa.BigInteger, primary_key=True, autoincrement=False),  # counted by leagues.matches
    *_arena(nullable=False),
    _text("a"),
    _text("b", nullable=True),
    *map(_count, ("wins", "draws", "losses", "voids", "side_wins", "side_draws", "side_losses")),
    *map(_count, (*PairCounts._fields, "seed", "steps", "voids_a", "voids_b")),
    _text("purpose"),
    _text("recording", nullable=True),
    _real("seconds", default=0.0),
    sa.Column("due", sa.Double),
    _count("causes", default=0),
    _time("created"),
    sa.ForeignKeyConstraint(["league", "a"], ["snapshots.league", "snapshots.name"]),
    sa.ForeignKeyConstraint(["league", "b"], ["snapshots.league", "snapshots.name"]),
)
ranked_matches = sa.Table(
    "ranked_matches",
    metadata,
    _league(primary_key=True),
    sa.Column("id", sa.BigInteger, primary_key=True, autoincrement=False),  # counted by leagues.matches
    *_arena(nullable=False),
    *map(_json, ("snapshots", "rankings", "voids_by_team")),
    *map(_count, ("episodes", "voids", "seed", "steps")),  # episodes: the sum of rankings
    _text("purpose"),
    _text("recording", nullable=True),
    _real("seconds"),
    sa.Column("due", sa.Double),
    _count("causes"),
    _json("seed_clusters", default=dict),
    _time("created"),
)
curves = sa.Table(
    "curves",
    metadata,
    _text("league", primary_key=True),
    _text("player", primary_key=True),
    sa.Column("iteration", sa.BigInteger, primary_key=True, autoincrement=False),
    _count("step"),
    _real("seconds"),
    _json("values"),
    _of_player(),
)
meetings = sa.Table(
    "meetings",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    *map(_text, ("league", "player", "opponent")),
    *map(_count, ("iteration", "wins", "draws", "losses", "voids", "pool")),
    _real("chance"),
    _of_player(),
    sa.Index("meetings_of_league", "league", "id"),
)
phases = sa.Table(
    "phases",
    metadata,
    _league(primary_key=True),
    _text("group", primary_key=True),
    sa.Column("number", sa.BigInteger, primary_key=True, autoincrement=False),
    *map(_json, ("learners", "since", "until")),
    _time("created"),
)
jobs = sa.Table(
    "jobs",
    metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    _league(),
    *map(_text, ("kind", "key")),
    _json("payload"),
    sa.Column("priority", sa.Integer, nullable=False),
    _text("state", default="queued"),
    sa.Column("attempt", sa.Integer, nullable=False, default=0),  # never decreases, so no two leases are equal
    sa.Column("failures", sa.Integer, nullable=False, default=0),  # attempts that reported an error
    sa.Column("expiries", sa.Integer, nullable=False, default=0),  # attempts whose lease was not renewed
    _real("not_before", default=0.0),
    _text("holder", nullable=True),
    sa.Column("lease_until", sa.Double),
    _text("error", nullable=True),
    _time("created"),
    sa.UniqueConstraint("league", "key"),
    sa.Index("jobs_to_claim", "league", "state", "kind", sa.desc("priority"), "id"),  # the first entry is the next job
)
# Blobs that a row named and names no more, e.g. those of old checkpoints: until their removal, this table shows that
# they were not lost. A blob that a row names is needed even if it is listed here.
dropped = sa.Table("dropped", metadata, _text("digest", primary_key=True), _time("made"))
workers = sa.Table(
    "workers",
    metadata,
    _text("id", primary_key=True),
    _league(),
    _text("kinds"),
    sa.Column("pid", sa.Integer, nullable=False),
    _text("host"),
    _json("status"),
    _time("started"),
    _time("seen"),
)


def add_seconds_of_matches(db: sa.Connection) -> None:
    """Migrate from schema 2 to 3: device time of matches. It is unknown for earlier matches."""
    db.execute(sa.text("ALTER TABLE matches ADD COLUMN seconds DOUBLE PRECISION NOT NULL DEFAULT 0"))
    db.execute(sa.text("ALTER TABLE matches ADD COLUMN due DOUBLE PRECISION"))


def add_meetings(db: sa.Connection) -> None:
    """Migrate from schema 3 to 4: outcomes of training games by opponent. They are unknown for earlier turns."""
    meetings.create(db)


def add_thinned_snapshots(db: sa.Connection) -> None:
    """Migrate from schema 4 to 5: which snapshots have no bytes any more, and which blobs may go. None so far."""
    db.execute(sa.text("ALTER TABLE snapshots ADD COLUMN thinned DOUBLE PRECISION"))
    dropped.create(db)


def sort_jobs_to_claim(db: sa.Connection) -> None:
    """Migrate from schema 5 to 6: an index that finds the next job of a kind without reading all queued jobs."""
    db.execute(sa.text("DROP INDEX jobs_to_claim"))
    db.execute(sa.text("CREATE INDEX jobs_to_claim ON jobs (league, state, kind, priority DESC, id)"))


def add_causes_of_voids(db: sa.Connection) -> None:
    """Migrate from schema 6 to 7: causes of void episodes. They are unknown for earlier matches."""
    db.execute(sa.text("ALTER TABLE matches ADD COLUMN causes BIGINT NOT NULL DEFAULT 0"))


def add_ranked_matches(db: sa.Connection) -> None:
    """Migrate from schema 7 to 8: matches of three and more teams. There are none so far."""
    ranked_matches.create(db)


def add_seed_clusters(db: sa.Connection) -> None:
    """Migrate from schema 8 to 9: episodes of rankings that share a seed. Those of earlier matches are unknown."""
    if not any(c["name"] == "seed_clusters" for c in sa.inspect(db).get_columns("ranked_matches")):  # see above
        db.execute(sa.text("ALTER TABLE ranked_matches ADD COLUMN seed_clusters JSON NOT NULL DEFAULT '{}'"))


# The oldest schema that can be migrated. Schema 1 keyed snapshots by their bytes and leagues by their arena.
FIRST_SCHEMA = 2

# MIGRATIONS[i] takes a database from schema FIRST_SCHEMA + i to the next. A new store is made from the tables above, so
# a new migration requires a matching change of the tables.
MIGRATIONS: list[Callable[[sa.Connection], None]] = [
    add_seconds_of_matches, add_meetings, add_thinned_snapshots, sort_jobs_to_claim,
    add_causes_of_voids, add_ranked_matches, add_seed_clusters,
]  # fmt: skip


def newest_schema() -> int:
    """Return the number of the schema that the tables above describe."""
    return FIRST_SCHEMA + len(MIGRATIONS)
