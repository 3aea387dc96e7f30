"""Operations on jobs: the queue, leases, and the results written at the end of a job."""

from collections.abc import Mapping, Sequence
from contextlib import suppress

import sqlalchemy as sa

from storage.database import rows
from storage.database import schema as t
from storage.errors import LeaseLost, StorageError
from storage.operations import batch_end, leases
from storage.operations.base import StoreBase
from storage.records import Checkpoint, CurvePoint, Job, JobState, Lease, Match, Meeting, Phase, RankedMatch, Snapshot


class JobQueue(StoreBase):
    """The part of `storage.store.Store` that concerns jobs."""

    def queue(self, jobs: Sequence[Job], phases: Sequence[Phase] = ()) -> int:
        """Queue the jobs whose key the league does not have yet, in any state; return how many were new.

        A job that names a thinned snapshot is left out: its planner has not seen the thinning yet and will plan again.

        Phases whose number their group does not have yet are added in the same transaction. Raises UnknownName.
        """
        with self._db.changing(row.league for row in (*jobs, *phases)) as db:
            begun, new = rows.add_phases(db, phases), rows.add_jobs(db, rows.without_thinned(db, jobs))
            if not (begun or new):
                db.rollback()
            return new

    def file(self, done: Job, matches: Sequence[Match | RankedMatch]) -> bool:
        """Add matches that were played without a lease, together with their job in the state done; both, or nothing.

        Return False where the league has that job's key already: another process has filed, or is to play, the same
        games. Raises UnknownName, and StorageError where a row is of another league or names a missing blob or
        snapshot.
        """
        self._require_blobs(match.recording for match in matches if match.recording is not None)
        if strange := next((match.league for match in matches if match.league != done.league), None):
            raise StorageError(f"Job {done.key} of league {done.league!r} has a result for league {strange!r}.")
        with self._db.writing() as db:
            last = rows.reserve_match_ids(db, done.league, len(matches))
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
        """Return the league's jobs, or those in some states or of one kind, oldest first."""
        c = t.jobs.c
        states = (state,) if isinstance(state, str) else state
        chosen = [] if states is None else [c.state.in_(states)]
        chosen += [] if kind is None else [c.kind == kind]
        return self._db.records(Job, t.jobs, c.league == league, *chosen, order=[c.id])

    def job_counts(self, league: str) -> dict[JobState, int]:
        """Return how many jobs the league has in each state; states without jobs are left out."""
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
        prefer: str | None = None,
    ) -> tuple[Lease, Job] | None:
        """Lease the job of highest priority, oldest first, for `seconds`; None when there is nothing to do now.

        A job that failed is passed over until its `not_before`. A job whose lease has expired can be claimed again.
        After `max_attempts` such expiries it becomes failed instead. Of equal priority the job with the key `prefer`
        goes before all others that are queued; one whose lease has expired still goes by its age.
        """
        if not (asked := tuple(kinds)):
            return None
        with self._db.reading() as db:  # cheaper than claiming, and on SQLite it blocks no writer
            some, hopeless = leases.find_work(db, league, asked, max_attempts)
            if some and not hopeless and self._db.is_server:
                return leases.claim(db, league, asked, holder, seconds, max_attempts, prefer)
        if hopeless:
            with self._db.changing([league]) as db:
                leases.fail_expired(db, league, asked, max_attempts)
        if not some:
            return None
        with self._db.writing(durable=False) as db:
            return leases.claim(db, league, asked, holder, seconds, max_attempts, prefer)

    def renew(self, lease: Lease, seconds: float) -> bool:
        """Extend the lease to `seconds` from now; False when the lease was lost."""
        with self._db.writing(durable=False) as db:
            return leases.renew(db, lease, seconds)

    def finish(
        self,
        lease: Lease,
        *,
        bases: Mapping[str, str] | None = None,
        checkpoints: Sequence[Checkpoint] = (),
        snapshots: Sequence[Snapshot] = (),
        matches: Sequence[Match | RankedMatch] = (),
        curves: Sequence[CurvePoint] = (),
        meetings: Sequence[Meeting] = (),
        jobs: Sequence[Job] = (),
        keep: int = 0,
    ) -> None:
        """Mark the job done, and add its results and the jobs that follow from it: everything, or nothing.

        `bases` maps each player to the checkpoint from which its results continue (digest, "" for none). Players that
        get a checkpoint have no setbacks any more. With `keep` > 0 only their newest `keep` checkpoints stay. An
        expired lease may still finish as long as no other worker has claimed the job.

        Raises LeaseLost when the lease was lost, Superseded when a player's newest checkpoint is not its base, and
        StorageError when a row is of another league or names a missing blob, player or snapshot.
        """
        self._require_blobs(row.digest for row in (*checkpoints, *snapshots))
        self._require_blobs(match.recording for match in matches if match.recording is not None)
        of_players = bases or checkpoints or snapshots or curves or meetings or jobs
        if not of_players and self._db.is_server and self._finish_batch(lease, matches):
            return
        with self._db.writing() as db:
            league = leases.end_lease(db, lease, state="done", error=None)
            for row in (*checkpoints, *snapshots, *matches, *curves, *meetings, *jobs):
                if row.league != league:
                    raise StorageError(f"Job {lease.job} of league {league!r} has a result for league {row.league!r}.")
            # The league's row is locked last: all its other changes wait until this transaction has ended, which is
            # many round trips later. What is written before is of these players alone, whose rows are locked.
            rows.lock_players(db, league, {*(bases or {}), *(each.player for each in checkpoints)})
            leases.require_newest(db, league, bases or {})
            rows.add_snapshots(db, snapshots)
            rows.add_checkpoints(db, league, checkpoints, keep)
            rows.add_curves(db, curves)
            last = rows.reserve_match_ids(db, league, len(matches))
            rows.add_matches(db, matches, last)
            rows.add_meetings(db, meetings)
            rows.add_jobs(db, rows.without_thinned(db, jobs))

    def _finish_batch(self, lease: Lease, matches: Sequence[Match | RankedMatch]) -> bool:
        """Finish a job without results of players by one statement; False, and nothing is done, where that is refused.

        Jobs of a league end one after another. In a transaction of several statements each would keep the others
        waiting until its process has read an answer: for long, where processes by far outnumber the cores.
        """
        with self._db.writing_alone() as db:
            try:
                played = rows.match_rows(db, matches)
            except StorageError:
                return False
            return batch_end.finish(db, lease, {match.league for match in matches}, played)

    def fail(self, lease: Lease, error: str, tries: int = 3, wait: float = 5.0) -> bool:
        """Record why a job failed; False when the lease was lost.

        The job is queued again, not to be claimed before `wait` seconds have passed (doubled after each failure up to
        number `tries`). At failure number `tries` it is set aside as failed, unless it has failed on a single worker
        while other workers are alive; these try it first.
        """
        with suppress(LeaseLost), self._db.writing() as db:
            leases.fail(db, lease, error, tries, wait)
            return True
        return False

    def record_setback(self, lease: Lease, player: str, reason: str, limit: int = 1) -> bool:
        """End a job (done, the reason kept) in which a player's learning diverged; False when the lease was lost.

        With more than `limit` setbacks in a row since it was last resumed the player is paused for that reason. Raises
        UnknownName.
        """
        with suppress(LeaseLost), self._db.writing() as db:
            leases.record_setback(db, lease, player, reason, limit)
            return True
        return False

    def release(self, lease: Lease) -> bool:
        """Return the job to the queue at once, without counting a failure; False when the lease was lost."""
        with suppress(LeaseLost), self._db.writing() as db:
            leases.release(db, lease)
            return True
        return False

    def requeue(self, job: int) -> bool:
        """Queue a failed job again with its counters reset; False when no job of that id has failed."""
        c = t.jobs.c
        failed = (c.id == job, c.state == "failed")
        clean = {"state": "queued", "error": None, "expiries": 0, "failures": 0, "not_before": 0.0}
        with self._db.writing() as db:
            league = db.scalar(sa.update(t.jobs).where(*failed).values(clean).returning(c.league))
            if league is None:
                return False
            rows.bump_revisions(db, [league])
            return True
