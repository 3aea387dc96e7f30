"""The verbs about leagues themselves: their settings, who leads them, their runs and their processes."""

from collections.abc import Mapping
from typing import Any

import sqlalchemy as sa

from storage import rows
from storage import tables as t
from storage.errors import UnknownName
from storage.records import League, Run, Worker
from storage.verbs import Verbs

# Asked for several times a second, and so built once.
_REVISION = sa.select(t.leagues.c.revision).where(t.leagues.c.name == sa.bindparam("name"))
_STOP = sa.select(t.leagues.c.name).where(
    t.leagues.c.name == sa.bindparam("name"), t.leagues.c.stop_asked >= sa.bindparam("since")
)


class Leading(Verbs):
    """A part of `storage.store.Store`."""

    def create_league(self, league: League) -> League:
        """The league of that name, made if it is new; an existing one keeps its configuration."""
        row = {"name": league.name, "config": league.config}
        with self._db.writing() as db:
            db.execute(rows.insert_or(db, t.leagues).values(row).on_conflict_do_nothing(index_elements=["name"]))
        return self.league(league.name)

    def league(self, name: str) -> League:
        """One league; raises UnknownName."""
        leagues = {league.name: league for league in self.leagues()}
        if name not in leagues:
            raise UnknownName("league", name, leagues)
        return leagues[name]

    def leagues(self) -> list[League]:
        """Every league, oldest first."""
        return self._db.records(League, t.leagues, order=(t.leagues.c.created, t.leagues.c.name))

    def set_config(self, name: str, config: str) -> None:
        """Keep the configuration a league is now run with; raises UnknownName."""
        self._set_league(name, config=config)

    def revision(self, league: str) -> int:
        """A number that is raised by whatever changes what there is to plan; raises UnknownName.

        That is: players, snapshots, checkpoints, phases, matches, jobs and the wish to stop. Beats, claims and renewals
        leave it as it is: a job that is worked on is planned with as one that waits.
        """
        if found := self._db.rows(_REVISION, name=league):
            return found[0][0]
        raise UnknownName("league", league, (known.name for known in self.leagues()))

    def lead(self, league: str, holder: str, seconds: float) -> bool:
        """Manage the league for `seconds` from now, or go on doing so; False while another does. Raises UnknownName."""
        c = t.leagues.c
        free = sa.or_(c.leader.is_(None), c.leader == holder, c.lead_until < t.now())
        return self._set_league(league, free, leader=holder, lead_until=t.now() + seconds)

    def unlead(self, league: str, holder: str) -> bool:
        """Manage the league no longer; False when it was another, or nobody, who did. Raises UnknownName."""
        return self._set_league(league, t.leagues.c.leader == holder, leader=None, lead_until=None)

    def leader(self, league: str) -> tuple[str, float] | None:
        """Who manages the league now, and until when if it does not renew; None when nobody does."""
        c = t.leagues.c
        found = self._db.rows(sa.select(c.leader, c.lead_until).where(c.name == league, c.lead_until >= t.now()))
        return (found[0][0], found[0][1]) if found else None

    def ask_stop(self, league: str) -> None:
        """Ask every worker of the league that has started by now to stop; raises UnknownName."""
        self._set_league(league, stop_asked=t.now(), revision=t.leagues.c.revision + 1)

    def stop_asked(self, league: str, since: float) -> bool:
        """Whether a stop was asked for at or after `since` (the database's clock)."""
        return bool(self._db.rows(_STOP, name=league, since=since))

    def start_run(self, league: str, config: str, host: str, versions: Mapping[str, str]) -> Run:
        """Record one `league run`; raises UnknownName."""
        self.league(league)
        row = {"league": league, "config": config, "host": host, "versions": dict(versions)}
        with self._db.writing() as db:
            return Run(*db.execute(sa.insert(t.runs).values(row).returning(*rows.columns(Run, t.runs))).one())

    def runs(self, league: str) -> list[Run]:
        """The league's runs, oldest first."""
        return self._db.records(Run, t.runs, t.runs.c.league == league, order=[t.runs.c.id])

    # Workers

    def beat(self, id: str, league: str, kinds: str, pid: int, host: str, status: Mapping[str, Any]) -> None:
        """Say that a worker is alive and what it is doing; the first beat is when it started.

        Raises StorageError when the status is not JSON, which has no NaN.
        """
        row = {"id": id, "league": league, "kinds": kinds, "pid": pid, "host": host, "status": dict(status)}
        with self._db.writing(lasting=False) as db:
            again = {"league": league, "kinds": kinds, "status": dict(status), "seen": t.now()}
            beat = rows.insert_or(db, t.workers).values(row)
            db.execute(beat.on_conflict_do_update(index_elements=["id"], set_=again))

    def workers(self, league: str, within_seconds: float) -> list[Worker]:
        """The league's workers whose last beat is at most that old, by id."""
        c = t.workers.c
        lately = (c.league == league, c.seen >= t.now() - within_seconds)
        return self._db.records(Worker, t.workers, *lately, order=[c.id])

    def leave(self, worker: str) -> None:
        """Forget a worker that ends in good order."""
        with self._db.writing() as db:
            db.execute(sa.delete(t.workers).where(t.workers.c.id == worker))

    def trim_workers(self, league: str, older_than_seconds: float) -> int:
        """Forget the league's workers whose last beat is older than that; how many those were."""
        c = t.workers.c
        silent = (c.league == league, c.seen < t.now() - older_than_seconds)
        with self._db.writing() as db:
            return db.execute(sa.delete(t.workers).where(*silent)).rowcount

    def _set_league(self, name: str, *where: Any, **values: Any) -> bool:
        """Change the league's own row where it fulfils the conditions; whether it did. Raises UnknownName."""
        c = t.leagues.c
        with self._db.writing() as db:
            if db.execute(sa.update(t.leagues).where(c.name == name, *where).values(values)).rowcount == 1:
                return True
        self.league(name)
        return False
