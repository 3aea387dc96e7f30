"""Operations on leagues themselves: their settings, leader, runs and processes."""

from collections.abc import Mapping
from typing import Any

import sqlalchemy as sa

from storage.database import rows
from storage.database import schema as t
from storage.errors import UnknownName
from storage.operations.base import StoreBase
from storage.records import TIMELINE, League, Run, Worker

# Queried several times a second, so built once.
_REVISION = sa.select(t.leagues.c.revision + t.timeline() * TIMELINE).where(t.leagues.c.name == sa.bindparam("name"))
_STOP = sa.select(t.leagues.c.name).where(
    t.leagues.c.name == sa.bindparam("name"), t.leagues.c.stop_asked >= sa.bindparam("since")
)


class Leadership(StoreBase):
    """The part of `storage.store.Store` that concerns leagues, their leader and their processes."""

    def create_league(self, league: League) -> League:
        """Return the league of that name, created if it is new; an existing league keeps its configuration."""
        row = {"name": league.name, "config": league.config}
        with self._db.writing() as db:
            db.execute(rows.insert_statement(db, t.leagues).values(row).on_conflict_do_nothing(index_elements=["name"]))
        return self.league(league.name)

    def league(self, name: str) -> League:
        """Return one league. Raises UnknownName."""
        leagues = {league.name: league for league in self.leagues()}
        if name not in leagues:
            raise UnknownName("league", name, leagues)
        return leagues[name]

    def leagues(self) -> list[League]:
        """Return every league, oldest first."""
        return self._db.records(League, t.leagues, order=(t.leagues.c.created, t.leagues.c.name))

    def set_config(self, name: str, config: str) -> None:
        """Store the configuration with which a league is now run. Raises UnknownName."""
        self._set_league(name, config=config)

    def revision(self, league: str) -> int:
        """Return a number that grows with every change that planning depends on. Raises UnknownName.

        The promotion of a standby is one, by TIMELINE: it may have lost commits, and repeat their numbers with other
        changes. Others concern players, snapshots, checkpoints, phases, matches, jobs and stop requests. Heartbeats,
        claims and renewals leave it as it is: planning treats a leased job like a queued one.
        """
        if found := self._db.rows(_REVISION, name=league):
            return found[0][0]
        raise UnknownName("league", league, (known.name for known in self.leagues()))

    def acquire_leadership(self, league: str, holder: str, seconds: float) -> bool:
        """Lead the league for `seconds` from now, or renew the leadership; False while another leads. Raises
        UnknownName.
        """
        c = t.leagues.c
        free = sa.or_(c.leader.is_(None), c.leader == holder, c.lead_until < t.now())
        return self._set_league(league, free, leader=holder, lead_until=t.now() + seconds)

    def release_leadership(self, league: str, holder: str) -> bool:
        """Give up leading the league; False when another process, or none, led it. Raises UnknownName."""
        return self._set_league(league, t.leagues.c.leader == holder, leader=None, lead_until=None)

    def leader(self, league: str) -> tuple[str, float] | None:
        """Return the league's current leader and when its leadership ends unless renewed; None without a leader."""
        c = t.leagues.c
        found = self._db.rows(sa.select(c.leader, c.lead_until).where(c.name == league, c.lead_until >= t.now()))
        return (found[0][0], found[0][1]) if found else None

    def last_leader(self, league: str) -> tuple[str, bool] | None:
        """Return the process that has led the league last, and whether it still leads; None if it has given up."""
        c = t.leagues.c
        query = sa.select(c.leader, c.lead_until >= t.now()).where(c.name == league, c.leader.is_not(None))
        return (found[0][0], bool(found[0][1])) if (found := self._db.rows(query)) else None

    def ask_stop(self, league: str) -> None:
        """Ask every worker of the league that has started by now to stop. Raises UnknownName."""
        self._set_league(league, stop_asked=t.now(), revision=t.leagues.c.revision + 1)

    def stop_asked(self, league: str, since: float) -> bool:
        """Return whether a stop was requested at or after `since` (the database's clock)."""
        return bool(self._db.rows(_STOP, name=league, since=since))

    def start_run(self, league: str, config: str, host: str, versions: Mapping[str, str]) -> Run:
        """Record one `league run`. Raises UnknownName."""
        self.league(league)
        row = {"league": league, "config": config, "host": host, "versions": dict(versions)}
        with self._db.writing() as db:
            return Run(*db.execute(sa.insert(t.runs).values(row).returning(*rows.columns(Run, t.runs))).one())

    def runs(self, league: str) -> list[Run]:
        """Return the league's runs, oldest first."""
        return self._db.records(Run, t.runs, t.runs.c.league == league, order=[t.runs.c.id])

    # Workers

    def heartbeat(self, id: str, league: str, kinds: str, pid: int, host: str, status: Mapping[str, Any]) -> None:
        """Record that a worker is alive and what it is doing; the first heartbeat also records its start.

        Raises StorageError when the status is not JSON, which has no NaN.
        """
        row = {"id": id, "league": league, "kinds": kinds, "pid": pid, "host": host, "status": dict(status)}
        with self._db.writing(durable=False) as db:
            again = {"league": league, "kinds": kinds, "status": dict(status), "seen": t.now()}
            insert = rows.insert_statement(db, t.workers).values(row)
            db.execute(insert.on_conflict_do_update(index_elements=["id"], set_=again))

    def workers(self, league: str, within_seconds: float) -> list[Worker]:
        """Return the league's workers whose last heartbeat is at most that old, by id."""
        c = t.workers.c
        lately = (c.league == league, c.seen >= t.now() - within_seconds)
        return self._db.records(Worker, t.workers, *lately, order=[c.id])

    def remove_worker(self, worker: str) -> None:
        """Remove the row of a worker that ends regularly."""
        with self._db.writing() as db:
            db.execute(sa.delete(t.workers).where(t.workers.c.id == worker))

    def remove_silent_workers(self, league: str, older_than_seconds: float) -> int:
        """Remove the league's workers whose last heartbeat is older than that; return how many."""
        c = t.workers.c
        silent = (c.league == league, c.seen < t.now() - older_than_seconds)
        with self._db.writing() as db:
            return db.execute(sa.delete(t.workers).where(*silent)).rowcount

    def _set_league(self, name: str, *where: Any, **values: Any) -> bool:
        """Update the league's row where it fulfils the conditions; return whether it did. Raises UnknownName."""
        c = t.leagues.c
        with self._db.writing() as db:
            if db.execute(sa.update(t.leagues).where(c.name == name, *where).values(values)).rowcount == 1:
                return True
        self.league(name)
        return False
