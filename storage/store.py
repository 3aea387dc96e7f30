"""The store: what a league knows, and the only channel between its processes.

Every verb is one transaction that takes and returns values of `storage.records`; none hands out a connection or leaves
a transaction open. Blobs are put first and rows written last, so a crash leaves at most a blob that nobody names.

A unit of work is a leased row. Ownership is settled by one conditional write on (job, holder, attempt) and liveness by
the database's clock, so a worker that was killed, cut off or merely slow can never write a result twice.
"""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self, TypeVar

import sqlalchemy as sa
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError

from storage import tables as t
from storage.blobs import Blobs, open_blobs
from storage.errors import LeaseLost, NotAStore, StorageError, UnknownName
from storage.records import (
    ArenaKey,
    Checkpoint,
    Job,
    JobState,
    League,
    Lease,
    Match,
    Player,
    Run,
    Snapshot,
    Worker,
)

R = TypeVar("R")


class Store:
    """Leagues with their players, policies, matches and jobs. Threads may share one; each process opens its own."""

    def __init__(self, engine: sa.Engine, blobs: Blobs, where: str):
        self.blobs = blobs
        self.where = where
        self._engine = engine

    @classmethod
    def open(cls, where: str | os.PathLike[str], create: bool = False, blobs: str | None = None) -> Self:
        """Open the store in a folder, or at `sqlite:///path/to/league.db`, or at a `postgresql://` URL with `blobs`.

        A folder holds `league.db` and `blobs/`; a SQLite URL has its blobs beside the file. With `create`, a store is
        made where nothing is. Opening a store of today's schema writes nothing.

        Raises NotAStore, NewerStore, or StorageError (no permission, no server, no place for blobs).
        """
        url = _database_url(os.fspath(where))
        if blobs is None:
            if url.get_backend_name() != "sqlite":
                raise StorageError(f"{t.place(url)}: say where its blobs are kept, a folder that every host sees.")
            blobs = str(Path(t.place(url)).parent / "blobs")
        opened = open_blobs(blobs)
        return cls(t.open_database(url, create), opened, t.place(url))

    def close(self) -> None:
        """Close the connections; the store can still be used and then opens new ones."""
        self._engine.dispose()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def now(self) -> float:
        """Seconds since the epoch on the database's clock."""
        with self._reading() as db:
            return db.execute(sa.select(t.now())).scalar_one()

    # Leagues, runs, players

    def create_league(self, league: League) -> League:
        """The league of that name, made if it is new; an existing one keeps its configuration.

        Raises StorageError when it exists with another arena, configuration hash or engine.
        """
        row = {"name": league.name, "config": league.config, **league.arena._asdict()}
        with self._writing() as db:
            db.execute(t.insert_or(db, t.leagues).values(row).on_conflict_do_nothing(index_elements=["name"]))
        kept = self.league(league.name)
        if kept.arena != league.arena:
            is_now, asked = "/".join(kept.arena), "/".join(league.arena)
            raise StorageError(f"League {league.name!r} is played in {is_now}, not in {asked}: choose another name.")
        return kept

    def league(self, name: str) -> League:
        """One league; raises UnknownName."""
        leagues = {league.name: league for league in self.leagues()}
        if name not in leagues:
            raise UnknownName("league", name, leagues)
        return leagues[name]

    def leagues(self) -> list[League]:
        """Every league, oldest first."""
        c = t.leagues.c
        query = sa.select(c.name, c.arena, c.config_hash, c.engine, c.config, c.created).order_by(c.created, c.name)
        return [League(row[0], ArenaKey(*row[1:4]), *row[4:]) for row in self._rows(query)]

    def set_config(self, name: str, config: str) -> None:
        """Keep the configuration a league is now run with; raises UnknownName."""
        self._set_league(name, config=config)

    def start_run(self, league: str, config: str, host: str, versions: Mapping[str, str]) -> Run:
        """Record one `league run`; raises UnknownName."""
        self.league(league)
        row = {"league": league, "config": config, "host": host, "versions": dict(versions)}
        with self._writing() as db:
            return Run(*db.execute(sa.insert(t.runs).values(row).returning(*t.columns(Run, t.runs))).one())

    def runs(self, league: str) -> list[Run]:
        """The league's runs, oldest first."""
        return self._records(Run, t.runs, t.runs.c.league == league, order=[t.runs.c.id])

    def add_players(self, players: Sequence[Player]) -> None:
        """Add those that are new; raises StorageError when one exists with another team, role or roster."""
        kept = {(p.league, p.name): p for league in {p.league for p in players} for p in self.players(league)}
        for player in players:
            if (known := kept.get((player.league, player.name), player)) != player:
                is_now, asked = (f"{p.role} of team {p.team} ({p.roster})" for p in (known, player))
                raise StorageError(f"Player {player.name!r} is {is_now}, not {asked}: choose another name.")
        with self._writing() as db:
            t.add(db, t.players, map(vars, players), unique=["league", "name"])

    def players(self, league: str) -> list[Player]:
        """The league's players by team, then name."""
        c = t.players.c
        return self._records(Player, t.players, c.league == league, order=(c.team, c.name))

    # Policies and results

    def add_snapshots(self, snapshots: Sequence[Snapshot]) -> None:
        """Add those whose bytes the league does not have yet; raises StorageError when a blob is not there."""
        self._require_blobs(s.digest for s in snapshots)
        with self._writing() as db:
            _add_snapshots(db, snapshots)

    def snapshots(self, league: str, player: str | None = None) -> list[Snapshot]:
        """The league's snapshots, or one player's, oldest first."""
        c = t.snapshots.c
        mine = [c.player == player] if player is not None else []
        return self._records(Snapshot, t.snapshots, c.league == league, *mine, order=(c.created, c.iteration, c.name))

    def checkpoint(self, league: str, player: str) -> Checkpoint | None:
        """Where a player goes on: its newest checkpoint, None before the first."""
        c = t.checkpoints.c
        mine = (c.league == league, c.player == player)
        newest = self._records(Checkpoint, t.checkpoints, *mine, order=[c.id.desc()], limit=1)
        return newest[0] if newest else None

    def checkpoints(self, league: str) -> list[Checkpoint]:
        """All checkpoints of all players, oldest first."""
        c = t.checkpoints.c
        return self._records(Checkpoint, t.checkpoints, c.league == league, order=[c.id])

    def matches(self, league: str, purpose: str | None = None, after: int = 0) -> list[Match]:
        """The league's match log in the order it was written, or the part played for one purpose or after a match."""
        return list(map(t.match_from, self._match_rows(t.MATCH_COLUMNS, league, purpose, after)))

    # Jobs and leases

    def queue(self, jobs: Sequence[Job]) -> int:
        """Queue those whose key the league does not have yet, in any state; how many were new."""
        with self._writing() as db:
            return _queue(db, jobs)

    def jobs(self, league: str, state: JobState | None = None, kind: str | None = None) -> list[Job]:
        """The league's jobs, or those in one state or of one kind, oldest first."""
        c = t.jobs.c
        chosen = [column == value for column, value in ((c.state, state), (c.kind, kind)) if value is not None]
        return self._records(Job, t.jobs, c.league == league, *chosen, order=[c.id])

    def count_jobs(self, league: str, kind: str) -> int:
        """How many jobs of a kind were ever queued."""
        c = t.jobs.c
        return self._rows(sa.select(sa.func.count()).where(c.league == league, c.kind == kind))[0][0]

    def claim(
        self,
        league: str,
        kinds: Sequence[str],
        holder: str,
        seconds: float,
        prefer: Sequence[str] = (),
        max_attempts: int = 10,
    ) -> tuple[Lease, Job] | None:
        """Take the job of highest priority, oldest first, for `seconds`; None when there is nothing to do.

        Among equal priorities, jobs whose key starts with one of `prefer` come first (their kernels are compiled). A
        job whose lease has expired can be claimed again; after `max_attempts` such expiries it becomes failed instead.
        """
        c = t.jobs.c
        mine = sa.and_(c.league == league, c.kind.in_(kinds))
        expired = sa.and_(c.state == "leased", c.lease_until < t.now())
        last = c.expiries + 1 >= max_attempts
        liked = sa.or_(sa.false(), *(sa.func.substr(c.key, 1, len(start)) == start for start in prefer))
        order = (c.priority.desc(), sa.case((liked, 0), else_=1), c.id)
        claimable = sa.or_(c.state == "queued", expired & ~last)
        hopeless = sa.select(c.id).where(mine, expired, last)
        first = sa.select(c.id).where(mine, claimable).order_by(*order).limit(1)
        give_up = {
            "state": "failed",
            "error": f"Its lease expired {max_attempts} times: every worker that took it died or hung.",
            "expiries": c.expiries + 1,
            "holder": None,
            "lease_until": None,
        }
        take = {
            "state": "leased",
            "holder": holder,
            "attempt": c.attempt + 1,
            "expiries": c.expiries + sa.case((c.state == "leased", 1), else_=0),
            "lease_until": t.now() + seconds,
        }
        with self._writing() as db:
            db.execute(sa.update(t.jobs).where(c.id.in_(_free(hopeless))).values(give_up))
            # `=` and not IN: PostgreSQL may run an IN (... LIMIT 1) more than once, and then takes several jobs.
            taken = sa.update(t.jobs).where(c.id == _free(first).scalar_subquery()).values(take)
            row = db.execute(taken.returning(*t.columns(Job, t.jobs))).one_or_none()
        if row is None:
            return None
        job = Job(*row)
        return Lease(job.id, holder, job.attempt), job

    def renew(self, lease: Lease, seconds: float) -> bool:
        """Hold the job for `seconds` from now; False when it is no longer ours."""
        with self._writing() as db:
            return _with_lease(db, lease, lease_until=t.now() + seconds)

    def finish(
        self,
        lease: Lease,
        *,
        checkpoints: Sequence[Checkpoint] = (),
        snapshots: Sequence[Snapshot] = (),
        matches: Sequence[Match] = (),
        jobs: Sequence[Job] = (),
    ) -> None:
        """Mark the job done, and add its results and the jobs that follow from it: everything, or nothing.

        A lease that has expired may still finish as long as nobody else has claimed the job. Raises LeaseLost when it
        is no longer ours, StorageError when a row names a blob, player or snapshot that is not there.
        """
        self._require_blobs(row.digest for row in (*checkpoints, *snapshots))
        self._require_blobs(match.recording for match in matches if match.recording is not None)
        with self._writing() as db:
            if not _with_lease(db, lease, state="done", lease_until=None):
                holder = f"{lease.holder} (attempt {lease.attempt})"
                raise LeaseLost(f"Job {lease.job} is no longer held by {holder}; its results were not written.")
            _add_snapshots(db, snapshots)
            if checkpoints:
                db.execute(sa.insert(t.checkpoints), [t.without(c, "created") for c in checkpoints])
            if matches:
                db.execute(sa.insert(t.matches), list(map(t.match_row, matches)))
            _queue(db, jobs)

    def fail(self, lease: Lease, error: str) -> bool:
        """Mark the job failed, to be looked at and requeued by a person; False when it is no longer ours."""
        with self._writing() as db:
            return _with_lease(db, lease, state="failed", error=error, holder=None, lease_until=None)

    def release(self, lease: Lease) -> bool:
        """Give the job back at once, with nothing held against it; False when it is no longer ours."""
        with self._writing() as db:
            return _with_lease(db, lease, state="queued", holder=None, lease_until=None)

    def requeue(self, job: int) -> bool:
        """Queue a failed job again with a clean slate; False when no job of that id has failed."""
        c = t.jobs.c
        again = sa.update(t.jobs).where(c.id == job, c.state == "failed").values(state="queued", error=None, expiries=0)
        with self._writing() as db:
            return db.execute(again).rowcount == 1

    # Workers

    def beat(self, id: str, league: str, kinds: str, pid: int, host: str, status: Mapping[str, Any]) -> None:
        """Say that a worker is alive and what it is doing; the first beat is when it started."""
        row = {"id": id, "league": league, "kinds": kinds, "pid": pid, "host": host, "status": dict(status)}
        with self._writing() as db:
            again = {"league": league, "kinds": kinds, "status": dict(status), "seen": t.now()}
            beat = t.insert_or(db, t.workers).values(row)
            db.execute(beat.on_conflict_do_update(index_elements=["id"], set_=again))

    def workers(self, league: str, within_seconds: float) -> list[Worker]:
        """The league's workers whose last beat is at most that old, by id."""
        c = t.workers.c
        return self._records(Worker, t.workers, c.league == league, c.seen >= t.now() - within_seconds, order=[c.id])

    def leave(self, worker: str) -> None:
        """Forget a worker that ends in good order."""
        with self._writing() as db:
            db.execute(sa.delete(t.workers).where(t.workers.c.id == worker))

    def ask_stop(self, league: str) -> None:
        """Ask every worker of the league that has started by now to stop; raises UnknownName."""
        self._set_league(league, stop_asked=t.now())

    def stop_asked(self, league: str, since: float) -> bool:
        """Whether a stop was asked for at or after `since` (the database's clock)."""
        c = t.leagues.c
        return bool(self._rows(sa.select(c.name).where(c.name == league, c.stop_asked >= since)))

    # The few ways to the database

    @contextmanager
    def _reading(self) -> Iterator[sa.Connection]:
        with t.plain_errors(self.where), self._engine.connect() as db:
            yield db

    @contextmanager
    def _writing(self) -> Iterator[sa.Connection]:
        with t.plain_errors(self.where), self._engine.execution_options(writes=True).begin() as db:
            yield db

    def _rows(self, query: Any) -> Sequence[Any]:
        with self._reading() as db:
            return db.execute(query).all()

    def _records(
        self, record: type[R], table: sa.Table, *where: Any, order: Sequence[Any], limit: int | None = None
    ) -> list[R]:
        """The rows of a table as records that have its columns' names."""
        query = sa.select(*t.columns(record, table)).where(*where).order_by(*order).limit(limit)
        return [record(*row) for row in self._rows(query)]

    def _match_rows(
        self, columns: list[sa.Column[Any]], league: str, purpose: str | None, after: int = 0
    ) -> Sequence[Any]:
        c = t.matches.c
        chosen = [c.id > after] + ([c.purpose == purpose] if purpose is not None else [])
        return self._rows(sa.select(*columns).where(c.league == league, *chosen).order_by(c.id))

    def _set_league(self, name: str, **values: Any) -> None:
        with self._writing() as db:
            if db.execute(sa.update(t.leagues).where(t.leagues.c.name == name).values(values)).rowcount == 1:
                return
        self.league(name)

    def _require_blobs(self, digests: Iterable[str]) -> None:
        for digest in digests:
            if not self.blobs.has(digest):
                raise StorageError(f"Blob {digest} is not in {self.where}: put it before the row that names it.")


def _database_url(where: str) -> sa.URL:
    if "://" in where:
        try:
            return make_url(where)
        except ArgumentError:
            raise StorageError(f"{where!r} is no database URL; one looks like sqlite:///runs/league.db.") from None
    folder = Path(where).absolute()
    if os.path.isfile(folder):
        raise NotAStore(f"{where} is a file: give the folder of a store, or the database file as sqlite:///{where}.")
    return sa.URL.create("sqlite", database=str(folder / "league.db"))


def _add_snapshots(db: sa.Connection, snapshots: Sequence[Snapshot]) -> None:
    t.add(db, t.snapshots, (t.without(s, "created") for s in snapshots), unique=["league", "digest"])


def _queue(db: sa.Connection, jobs: Sequence[Job]) -> int:
    rows = [
        {"league": j.league, "kind": j.kind, "key": j.key, "payload": dict(j.payload), "priority": j.priority}
        for j in jobs
    ]
    return t.add(db, t.jobs, rows, unique=["league", "key"])


def _free(query: sa.Select[Any]) -> sa.Select[Any]:
    """Pass over the rows that another claim is just taking, and keep the rest for us (SQLite has one writer anyway)."""
    return query.with_for_update(skip_locked=True).correlate(None)


def _with_lease(db: sa.Connection, lease: Lease, **values: Any) -> bool:
    """The conditional write that every holder's verb is: it changes the job only if the lease is the current one."""
    c = t.jobs.c
    ours = (c.id == lease.job, c.holder == lease.holder, c.attempt == lease.attempt, c.state == "leased")
    return db.execute(sa.update(t.jobs).where(*ours).values(values)).rowcount == 1
