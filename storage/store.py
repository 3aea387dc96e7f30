"""The store: what a league knows, and the only channel between its processes.

Every verb is one transaction that takes and returns values of `storage.records`; none hands out a connection or leaves
a transaction open. Blobs are put first and rows written last, so a crash leaves at most a blob that nobody names.

A unit of work is a leased row. Ownership is settled by one conditional write on (job, holder, attempt) and liveness by
the database's clock, so a worker that was killed, cut off or merely slow can never write a result twice.

Every verb raises Away when the database or its disk cannot serve now; it may then be called again as it was.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, Self

import sqlalchemy as sa

from storage import jobs as leases
from storage import moving, rows, thinning
from storage import tables as t
from storage.blobs import Blobs, open_blobs
from storage.database import Database
from storage.errors import LeaseLost, StorageError, UnknownName
from storage.opening import open_database
from storage.places import blobs_place, database_url, shown
from storage.records import (
    COUNTS,
    ArenaKey,
    Checkpoint,
    CurvePoint,
    Job,
    JobState,
    League,
    Lease,
    Match,
    Meeting,
    Phase,
    Player,
    Run,
    Snapshot,
    Totals,
    Worker,
)


class Store:
    """Leagues with their players, policies, matches and jobs. Threads may share one; each process opens its own."""

    def __init__(self, database: Database, blobs: Blobs):
        self.blobs = blobs
        self.where = database.where  # for messages: no password is in it
        self._db = database

    @classmethod
    def open(
        cls, where: str | os.PathLike[str], create: bool = False, blobs: str | os.PathLike[str] | None = None
    ) -> Self:
        """Open the store in a folder, or at `sqlite:///path/to/league.db`, or at a `postgresql://` URL.

        A folder holds `league.db` and `blobs/`. Blobs are kept at `blobs`, else where ROBOT_LEAGUE_BLOBS says, else
        beside a SQLite file. With `create`, a store is made where nothing is. Opening a store of today's schema writes
        nothing.

        Raises NotAStore, OldStore, NewerStore, Away (no server now) or StorageError (no permission, no place for
        blobs, no such kind of URL).
        """
        url = database_url(where)
        kept = open_blobs(blobs_place(blobs, url))
        return cls(Database(open_database(url, create), shown(url)), kept)

    def close(self) -> None:
        """Close the connections; the store can still be used and then opens new ones."""
        self._db.engine.dispose()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def now(self) -> float:
        """Seconds since the epoch on the database's clock."""
        return self._db.rows(sa.select(t.now()))[0][0]

    # Leagues, their manager, runs

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

        That is: players, snapshots, checkpoints, phases, matches and jobs. Beats and renewals leave it as it is.
        """
        if found := self._db.rows(sa.select(t.leagues.c.revision).where(t.leagues.c.name == league)):
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
        self._set_league(league, stop_asked=t.now())

    def stop_asked(self, league: str, since: float) -> bool:
        """Whether a stop was asked for at or after `since` (the database's clock)."""
        c = t.leagues.c
        return bool(self._db.rows(sa.select(c.name).where(c.name == league, c.stop_asked >= since)))

    def start_run(self, league: str, config: str, host: str, versions: Mapping[str, str]) -> Run:
        """Record one `league run`; raises UnknownName."""
        self.league(league)
        row = {"league": league, "config": config, "host": host, "versions": dict(versions)}
        with self._db.writing() as db:
            return Run(*db.execute(sa.insert(t.runs).values(row).returning(*rows.columns(Run, t.runs))).one())

    def runs(self, league: str) -> list[Run]:
        """The league's runs, oldest first."""
        return self._db.records(Run, t.runs, t.runs.c.league == league, order=[t.runs.c.id])

    # Players, their policies and phases

    def add_players(self, players: Sequence[Player]) -> None:
        """Add those that are new; raises StorageError when one exists with another team, role, roster or group."""
        with self._db.changing(p.league for p in players) as db:
            if not rows.add_players(db, players):
                db.rollback()

    def players(self, league: str) -> list[Player]:
        """The league's players by team, then name."""
        c = t.players.c
        return self._db.records(Player, t.players, c.league == league, order=(c.team, c.name))

    def set_paused(self, league: str, player: str, reason: str | None) -> None:
        """Let a player learn no more, for a reason; None: let it go on, with no setbacks. Raises UnknownName."""
        c = t.players.c
        values: dict[str, Any] = {"paused": reason} if reason is not None else {"paused": None, "setbacks": 0}
        with self._db.changing([league]) as db:
            if (
                db.execute(sa.update(t.players).where(c.league == league, c.name == player).values(values)).rowcount
                == 0
            ):
                raise UnknownName("player", player, db.scalars(sa.select(c.name).where(c.league == league)))

    def add_snapshots(self, snapshots: Sequence[Snapshot]) -> None:
        """Add those that are new; one whose name is there with the same bytes stays as it is.

        Raises StorageError, adding none, when a name is there with other bytes or a blob is not there.
        """
        self._require_blobs(s.digest for s in snapshots)
        with self._db.changing(s.league for s in snapshots) as db:
            if not rows.add_snapshots(db, snapshots):
                db.rollback()

    def snapshots(self, league: str, player: str | None = None) -> list[Snapshot]:
        """The league's snapshots, or one player's, by (iteration, name); those that belong to no player come first."""
        c = t.snapshots.c
        mine = [c.player == player] if player is not None else []
        order = (sa.case((c.player.is_(None), 0), else_=1), c.iteration, c.name)
        return self._db.records(Snapshot, t.snapshots, c.league == league, *mine, order=order)

    def checkpoint(self, league: str, player: str) -> Checkpoint | None:
        """Where a player goes on: its newest checkpoint by iteration, None before the first."""
        c = t.checkpoints.c
        mine = (c.league == league, c.player == player)
        newest = self._db.records(Checkpoint, t.checkpoints, *mine, order=rows.NEWEST_CHECKPOINT, limit=1)
        return newest[0] if newest else None

    def newest_checkpoints(self, league: str) -> dict[str, Checkpoint]:
        """Where each player of the league goes on, by its name; those without a checkpoint are left out."""
        c = t.checkpoints.c
        order = rows.NEWEST_CHECKPOINT
        newest = self._db.newest(Checkpoint, t.checkpoints, c.league == league, of_each=c.player, order=order)
        return {checkpoint.player: checkpoint for checkpoint in newest}

    def checkpoints(self, league: str) -> list[Checkpoint]:
        """All checkpoints kept of all players, oldest first."""
        c = t.checkpoints.c
        return self._db.records(Checkpoint, t.checkpoints, c.league == league, order=[c.id])

    def phases(self, league: str) -> dict[str, Phase]:
        """The newest phase of each group, by the group's name."""
        c = t.phases.c
        newest = self._db.newest(Phase, t.phases, c.league == league, of_each=c.group, order=[c.number.desc()])
        return {phase.group: phase for phase in newest}

    # Results

    def matches(self, league: str, purpose: str | Sequence[str] | None = None, after: int = 0) -> list[Match]:
        """The league's match log in the order of commits, or the part played for some purposes or after a match.

        Who has read up to a match and reads on after its id misses nothing: a later commit has a larger id.
        """
        c = t.matches.c
        wanted = (purpose,) if isinstance(purpose, str) else purpose
        chosen = [c.purpose.in_(wanted)] if wanted is not None else []
        return self._db.records(Match, t.matches, c.league == league, c.id > after, *chosen, order=[c.id])

    def totals(self, league: str, purpose: str | Sequence[str], until: float | None = None) -> dict[ArenaKey, Totals]:
        """The match log played for some purpose, summed under each ArenaKey, that of the newest match first.

        `until`: only matches that were written up to then, in seconds since the epoch on the database's clock.
        """
        c = t.matches.c
        wanted = (purpose,) if isinstance(purpose, str) else purpose
        chosen = [c.league == league, c.purpose.in_(wanted), *([c.created <= until] if until is not None else [])]
        groups = (*(c[name] for name in ArenaKey._fields), c.a, c.b)
        sums = [sa.cast(sa.func.sum(c[name]), sa.BigInteger) for name in COUNTS]  # PostgreSQL sums to decimals
        newest = (sa.func.max(c.created), sa.func.max(c.id))
        found: dict[ArenaKey, list[Any]] = {}
        for row in self._db.rows(sa.select(*groups, *sums, *newest).where(*chosen).group_by(*groups)):
            found.setdefault(ArenaKey(*row[:3]), []).append(row)
        read = [
            Totals(key, [r[3] for r in log], [r[4] for r in log], [r[5:-2] for r in log], [r[-2] for r in log],
                   max(r[-1] for r in log))
            for key, log in found.items()
        ]  # fmt: skip
        return {each.arena: each for each in sorted(read, key=lambda each: -each.newest)}

    def booked(self, league: str) -> tuple[float, float]:
        """Device seconds of the matches that were queued while players learnt, and their first `due`; zeros without."""
        c = t.matches.c
        query = sa.select(sa.func.sum(c.seconds), sa.func.min(c.due)).where(c.league == league, c.due.is_not(None))
        seconds, first = self._db.rows(query)[0]
        return seconds or 0.0, first or 0.0

    def curves(self, league: str, player: str | None = None, after: int = 0) -> list[CurvePoint]:
        """What learning was like after an iteration, for all players or one, by (player, iteration)."""
        c = t.curves.c
        chosen = [c.league == league, c.iteration > after, *([c.player == player] if player is not None else [])]
        return self._db.records(CurvePoint, t.curves, *chosen, order=(c.player, c.iteration))

    def meetings(self, league: str, after: int = 0) -> list[Meeting]:
        """What came of training games, or the part that was written after a row, in the order of commits."""
        c = t.meetings.c
        return self._db.records(Meeting, t.meetings, c.league == league, c.id > after, order=[c.id])

    # Jobs and leases

    def queue(self, jobs: Sequence[Job], phases: Sequence[Phase] = ()) -> int:
        """Queue those whose key the league does not have yet, in any state; how many were new.

        Phases whose number their group does not have yet are added in the same transaction. Raises UnknownName.
        """
        with self._db.changing(row.league for row in (*jobs, *phases)) as db:
            begun, new = rows.add_phases(db, phases), rows.add_jobs(db, jobs)
            if not (begun or new):
                db.rollback()
            return new

    def file(self, done: Job, matches: Sequence[Match]) -> bool:
        """Add matches that were played without a lease, and the job that they are, as done; both, or nothing.

        False where the league has that job's key already: somebody else has filed, or is to play, the same games.
        Raises UnknownName, StorageError where a row is of another league or names a blob or snapshot that is not there.
        """
        self._require_blobs(match.recording for match in matches if match.recording is not None)
        if strange := next((match.league for match in matches if match.league != done.league), None):
            raise StorageError(f"Job {done.key} of league {done.league!r} has a result for league {strange!r}.")
        with self._db.changing([done.league]) as db:
            if not rows.add_jobs(db, [done]):
                db.rollback()
                return False
            mine = (t.jobs.c.league == done.league, t.jobs.c.key == done.key)
            db.execute(sa.update(t.jobs).where(*mine).values(state="done"))
            rows.add_matches(db, done.league, matches)
            return True

    def jobs(self, league: str, state: JobState | None = None, kind: str | None = None) -> list[Job]:
        """The league's jobs, or those in one state or of one kind, oldest first."""
        c = t.jobs.c
        chosen = [column == value for column, value in ((c.state, state), (c.kind, kind)) if value is not None]
        return self._db.records(Job, t.jobs, c.league == league, *chosen, order=[c.id])

    def claim(
        self,
        league: str,
        kinds: Sequence[str],
        holder: str,
        seconds: float,
        prefer: Sequence[str] = (),
        max_attempts: int = 10,
    ) -> tuple[Lease, Job] | None:
        """Take the job of highest priority, oldest first, for `seconds`; None when there is nothing to do now.

        Among equal priorities, jobs whose key starts with one of `prefer` come first (their kernels are compiled). A
        job that failed is passed over until its `not_before`. A job whose lease has expired can be claimed again; after
        `max_attempts` such expiries it becomes failed instead.
        """
        if not self._db.rows(leases.waiting(league, kinds, max_attempts)):
            return None
        with self._db.changing([league]) as db:
            return leases.claim(db, league, kinds, holder, seconds, prefer, max_attempts)

    def renew(self, lease: Lease, seconds: float) -> bool:
        """Hold the job for `seconds` from now; False when it is no longer ours."""
        with self._db.writing() as db:
            return leases.renew(db, lease, seconds)

    def finish(
        self,
        lease: Lease,
        *,
        bases: Mapping[str, str] | None = None,
        checkpoints: Sequence[Checkpoint] = (),
        snapshots: Sequence[Snapshot] = (),
        matches: Sequence[Match] = (),
        curves: Sequence[CurvePoint] = (),
        meetings: Sequence[Meeting] = (),
        jobs: Sequence[Job] = (),
        keep: int = 0,
    ) -> None:
        """Mark the job done, and add its results and the jobs that follow from it: everything, or nothing.

        `bases` says from which checkpoint (digest, "" for none) each player's results go on. Players that get a
        checkpoint have no setbacks any more, and with `keep` > 0 only their newest so many checkpoints stay. A lease
        that has expired may still finish as long as nobody else has claimed the job.

        Raises LeaseLost when it is no longer ours, Superseded when a player's newest checkpoint is not its base,
        StorageError when a row is of another league or names a blob, player or snapshot that is not there.
        """
        self._require_blobs(row.digest for row in (*checkpoints, *snapshots))
        self._require_blobs(match.recording for match in matches if match.recording is not None)
        with self._db.writing() as db:
            league = leases.end(db, lease, state="done", error=None)
            for row in (*checkpoints, *snapshots, *matches, *curves, *meetings, *jobs):
                if row.league != league:
                    raise StorageError(f"Job {lease.job} of league {league!r} has a result for league {row.league!r}.")
            leases.require_newest(db, league, bases or {})
            rows.add_snapshots(db, snapshots)
            rows.add_checkpoints(db, league, checkpoints, keep)
            rows.add_matches(db, league, matches)
            rows.add_curves(db, curves)
            rows.add_meetings(db, meetings)
            rows.add_jobs(db, jobs)

    def fail(self, lease: Lease, error: str, tries: int = 3, wait: float = 5.0) -> bool:
        """Say why a job failed; False when it is no longer ours.

        It is queued again, not to be taken before `wait` seconds have passed (twice as many after each failure); at
        failure number `tries` it is set aside as failed.
        """
        with suppress(LeaseLost), self._db.writing() as db:
            leases.fail(db, lease, error, tries, wait)
            return True
        return False

    def setback(self, lease: Lease, player: str, reason: str, limit: int = 1) -> bool:
        """End a job (done, the reason kept) in which a player's learning diverged; False when it is no longer ours.

        With more than `limit` setbacks in a row the player is paused for that reason. Raises UnknownName.
        """
        with suppress(LeaseLost), self._db.writing() as db:
            leases.setback(db, lease, player, reason, limit)
            return True
        return False

    def release(self, lease: Lease) -> bool:
        """Give the job back at once, with nothing held against it; False when it is no longer ours."""
        with suppress(LeaseLost), self._db.writing() as db:
            leases.end(db, lease, state="queued", holder=None)
            return True
        return False

    def requeue(self, job: int) -> bool:
        """Queue a failed job again with a clean slate; False when no job of that id has failed."""
        c = t.jobs.c
        failed = (c.id == job, c.state == "failed")
        clean = {"state": "queued", "error": None, "expiries": 0, "failures": 0, "not_before": 0.0}
        with self._db.writing() as db:
            if (league := db.scalar(sa.select(c.league).where(*failed))) is None:
                return False
            rows.touch(db, [league])
            return db.execute(sa.update(t.jobs).where(*failed).values(clean)).rowcount == 1

    # Workers

    def beat(self, id: str, league: str, kinds: str, pid: int, host: str, status: Mapping[str, Any]) -> None:
        """Say that a worker is alive and what it is doing; the first beat is when it started.

        Raises StorageError when the status is not JSON, which has no NaN.
        """
        row = {"id": id, "league": league, "kinds": kinds, "pid": pid, "host": host, "status": dict(status)}
        with self._db.writing() as db:
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

    # Moving

    def dump(
        self,
        leagues: Sequence[str],
        take: Callable[[str, Iterator[dict[str, Any]]], None],
        newest: bool = False,
        recordings: bool = True,
    ) -> None:
        """Hand the rows of leagues, as they travel, to `take`, table after table, as they all are at one moment.

        `newest`: of the checkpoints only those that players go on from; without `recordings` no match names one.
        """
        with self._db.unchanging() as db:
            for name, table in moving.TABLES.items():
                take(name, self._db.sound(moving.dumped(db, table, leagues, newest, recordings), name))

    def restore(self, tables: Iterable[tuple[str, Iterable[Mapping[str, Any]]]]) -> None:
        """Add rows that `dump` gave, whose blobs are there: all of them, or none.

        Raises StorageError when a league of that name is there already.
        """
        with self._db.writing() as db:
            for name, rows_of_it in tables:
                moving.load(db, moving.TABLES[name], rows_of_it)

    # Thinning

    def waste(self, policy: thinning.Policy) -> thinning.Waste:
        """What can go by that policy; changes nothing. Raises StorageError where rows are damaged."""
        return thinning.find(self._db, self.blobs, policy)

    def thin(self, waste: thinning.Waste, tell: thinning.Tell = lambda *_: None) -> thinning.Done:
        """Remove what was found, less what has been put or named since; how much that was. Rows go before blobs."""
        return thinning.remove(self._db, self.blobs, waste, tell)

    def _set_league(self, name: str, *where: Any, **values: Any) -> bool:
        """Change the league's own row where it fulfils the conditions; whether it did. Raises UnknownName."""
        c = t.leagues.c
        with self._db.writing() as db:
            if db.execute(sa.update(t.leagues).where(c.name == name, *where).values(values)).rowcount == 1:
                return True
        self.league(name)
        return False

    def _require_blobs(self, digests: Iterable[str]) -> None:
        for digest in digests:
            if not self.blobs.has(digest):
                raise StorageError(f"Blob {digest} is not in {self.where}: put it before the row that names it.")
