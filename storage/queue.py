"""The verbs about jobs: the queue, leases, and what a job's end writes with it."""

from collections.abc import Mapping, Sequence
from contextlib import suppress

import sqlalchemy as sa

from storage import jobs as leases
from storage import rows
from storage import tables as t
from storage.errors import LeaseLost, StorageError
from storage.records import Checkpoint, CurvePoint, Job, JobState, Lease, Match, Meeting, Phase, Snapshot
from storage.verbs import Verbs


class Queue(Verbs):
    """A part of `storage.store.Store`."""

    def queue(self, jobs: Sequence[Job], phases: Sequence[Phase] = ()) -> int:
        """Queue those whose key the league does not have yet, in any state; how many were new.

        One that names a thinned snapshot is left out: whoever planned it has not seen that yet, and plans anew.

        Phases whose number their group does not have yet are added in the same transaction. Raises UnknownName.
        """
        with self._db.changing(row.league for row in (*jobs, *phases)) as db:
            begun, new = rows.add_phases(db, phases), rows.add_jobs(db, rows.without_thinned(db, jobs))
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
        with self._db.writing() as db:
            last = rows.lengthen(db, done.league, len(matches))
            if not rows.add_jobs(db, [done]):
                db.rollback()
                return False
            mine = (t.jobs.c.league == done.league, t.jobs.c.key == done.key)
            db.execute(sa.update(t.jobs).where(*mine).values(state="done"))
            rows.add_matches(db, matches, last)
            return True

    def jobs(
        self, league: str, state: JobState | Sequence[JobState] | None = None, kind: str | None = None
    ) -> list[Job]:
        """The league's jobs, or those in some states or of one kind, oldest first."""
        c = t.jobs.c
        states = (state,) if isinstance(state, str) else state
        chosen = [] if states is None else [c.state.in_(states)]
        chosen += [] if kind is None else [c.kind == kind]
        return self._db.records(Job, t.jobs, c.league == league, *chosen, order=[c.id])

    def job_counts(self, league: str) -> dict[JobState, int]:
        """How many jobs the league has in each state, of those states that any is in."""
        c = t.jobs.c
        query = sa.select(c.state, sa.func.count()).where(c.league == league).group_by(c.state)
        return {state: number for state, number in self._db.rows(query)}

    def claim(
        self,
        league: str,
        kinds: Sequence[str],
        holder: str,
        seconds: float,
        max_attempts: int = 10,
    ) -> tuple[Lease, Job] | None:
        """Take the job of highest priority, oldest first, for `seconds`; None when there is nothing to do now.

        A job that failed is passed over until its `not_before`. A job whose lease has expired can be claimed again;
        after `max_attempts` such expiries it becomes failed instead.
        """
        if not (asked := tuple(kinds)):
            return None
        with self._db.reading() as db:  # cheaper than to take, and on SQLite it keeps nobody from writing
            some, hopeless = leases.look(db, league, asked, max_attempts)
            if some and not hopeless and self._db.is_server:
                return leases.claim(db, league, asked, holder, seconds, max_attempts)
        if hopeless:
            with self._db.changing([league]) as db:
                leases.give_up(db, league, asked, max_attempts)
        if not some:
            return None
        with self._db.writing(lasting=False) as db:
            return leases.claim(db, league, asked, holder, seconds, max_attempts)

    def renew(self, lease: Lease, seconds: float) -> bool:
        """Hold the job for `seconds` from now; False when it is no longer ours."""
        with self._db.writing(lasting=False) as db:
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
            last = rows.lengthen(db, league, len(matches))
            leases.require_newest(db, league, bases or {})
            rows.add_snapshots(db, snapshots)
            rows.add_checkpoints(db, league, checkpoints, keep)
            rows.add_matches(db, matches, last)
            rows.add_curves(db, curves)
            rows.add_meetings(db, meetings)
            rows.add_jobs(db, rows.without_thinned(db, jobs))

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
            leases.release(db, lease)
            return True
        return False

    def requeue(self, job: int) -> bool:
        """Queue a failed job again with a clean slate; False when no job of that id has failed."""
        c = t.jobs.c
        failed = (c.id == job, c.state == "failed")
        clean = {"state": "queued", "error": None, "expiries": 0, "failures": 0, "not_before": 0.0}
        with self._db.writing() as db:
            league = db.scalar(sa.update(t.jobs).where(*failed).values(clean).returning(c.league))
            if league is None:
                return False
            rows.touch(db, [league])
            return True
