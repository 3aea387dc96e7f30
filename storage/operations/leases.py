"""The statements that lease jobs; each is a step of the caller's transaction.

A claim and all operations of a holder are conditional writes on (job, holder, attempt), and the database's clock
decides whether a holder is alive. Of two workers that both believe to hold a job, at most one is right, and the other
writes nothing.
"""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, TypeVar

import sqlalchemy as sa

from storage.database import schema as t
from storage.database.rows import NEWEST_CHECKPOINT, bump_revisions, columns, record_from
from storage.errors import LeaseLost, Superseded, UnknownName
from storage.records import Job, Lease

Select = TypeVar("Select", bound=sa.Select)

_FAILED_ON = "failed on: "
"""Start of the last line of a job's error, which lists the workers on which it has failed."""
ALIVE_SECONDS = 30.0  # a worker whose last heartbeat is younger may be expected to take a job
MAX_RETRY_FACTOR = (
    5  # a job may fail this many times `tries` on one worker before it is set aside, even with other workers
)


def find_work(db: sa.Connection, league: str, kinds: tuple[str, ...], max_attempts: int) -> tuple[bool, bool]:
    """Return whether there is a job to claim now, and whether there is a job to give up."""
    some, hopeless = tuple(db.execute(_work_query(league, kinds, max_attempts)).one())
    return some, hopeless


def fail_expired(db: sa.Connection, league: str, kinds: tuple[str, ...], max_attempts: int) -> None:
    """Set aside the jobs whose lease has expired `max_attempts` times. The caller has bumped the league's revision."""
    c = t.jobs.c
    hopeless = sa.or_(*(_claim_conditions(league, kind, max_attempts)[1] for kind in kinds))
    error = f"Its lease expired {max_attempts} times: every worker that took it died or hung."
    ended = {"state": "failed", "error": error, "expiries": c.expiries + 1, "holder": None, "lease_until": None}
    db.execute(sa.update(t.jobs).where(c.id.in_(_skip_locked(sa.select(c.id).where(hopeless)))).values(ended))


def claim(
    db: sa.Connection,
    league: str,
    kinds: tuple[str, ...],
    holder: str,
    seconds: float,
    max_attempts: int,
    prefer: str | None,
) -> tuple[Lease, Job] | None:
    """Claim a job, see Store.claim. One statement, which on a server is also `relaxed_durability`."""
    statement = _claim_statement(league, kinds, max_attempts, preferring=prefer is not None)
    preferred = {} if prefer is None else {"preferred": prefer}
    row = db.execute(statement, {"who": holder, "for_seconds": seconds, **preferred}).one_or_none()
    if row is None:
        return None
    job = record_from(Job, row[:-1])
    return Lease(job.id, holder, job.attempt), job


# Every worker sends these statements often. They are built once: building takes longer than the database's answer.


@lru_cache
def _work_query(league: str, kinds: tuple[str, ...], max_attempts: int) -> Any:
    """Return the query of `find_work`. It asks for the first job and not for any: to find any, PostgreSQL may walk
    through the whole table, past all jobs that are done.
    """
    c = t.jobs.c
    due, given_up = zip(*(_claim_conditions(league, kind, max_attempts) for kind in kinds), strict=True)
    first = [
        sa.select(c.id).where(each).order_by(c.priority.desc(), c.id).limit(1) for states in due for each in states
    ]
    some = [each.scalar_subquery().is_not(None) for each in first]
    return sa.select(sa.or_(*some), sa.or_(*(sa.exists(sa.select(c.id).where(each)) for each in given_up)))


@lru_cache
def _claim_statement(league: str, kinds: tuple[str, ...], max_attempts: int, preferring: bool) -> Any:
    """Return the statement that claims the next job.

    For each kind, the first queued job and the first job with an expired lease are looked up. An index holds each of
    these in queue order, but not all of them in one order. With `preferring` the job with that key is looked up as
    well, and goes before the queued ones. Jobs with an expired lease do not wait for it unless they are younger: else
    they could wait for ever.
    """
    c = t.jobs.c
    queued, expired = zip(*(_claim_conditions(league, kind, max_attempts)[0] for kind in kinds), strict=True)
    found = [(each, preferring) for each in queued] + [(each, False) for each in expired]  # and whether it goes later
    if preferring:
        found += [(each & (c.key == sa.bindparam("preferred")), False) for each in queued]
    firsts = [
        _skip_locked(
            sa.select(c.id, c.priority, sa.literal_column(str(int(later))).label("later"))
            .where(each)
            .order_by(c.priority.desc(), c.id)
            .limit(1)
        ).subquery()
        for each, later in found
    ]
    ahead = sa.union_all(*(sa.select(first) for first in firsts)).subquery()
    first = sa.select(ahead.c.id).order_by(ahead.c.priority.desc(), ahead.c.later, ahead.c.id).limit(1)
    take = {
        "state": "leased",
        "holder": sa.bindparam("who"),
        "attempt": c.attempt + 1,
        "expiries": c.expiries + sa.case((c.state == "leased", 1), else_=0),
        "lease_until": t.now() + sa.bindparam("for_seconds", type_=sa.Double),
    }
    # `=` and not IN: PostgreSQL may run an IN (... LIMIT 1) more than once, and then takes several jobs.
    return (
        sa.update(t.jobs)
        .where(c.id == first.scalar_subquery())
        .values(take)
        .returning(*columns(Job, t.jobs), t.relaxed_durability())
    )


def renew(db: sa.Connection, lease: Lease, seconds: float) -> bool:
    """Extend the lease to `seconds` from now; False when the lease was lost. Nothing that planning reads changes."""
    again = sa.update(t.jobs).where(HELD).values(lease_until=t.now() + seconds)
    return db.execute(again, lease_parameters(lease)).rowcount == 1


def end_lease(db: sa.Connection, lease: Lease, **values: Any) -> str:
    """End a lease and set these values of the job; return its league, whose revision the caller bumps afterwards.

    Everywhere rows are locked in the order job, players, league: nobody waits in a circle, and two jobs of one league
    that end at the same time block each other as briefly as possible. Raises LeaseLost.
    """
    ended = sa.update(t.jobs).where(HELD).values({"lease_until": None, **values}).returning(t.jobs.c.league)
    if (league := db.scalar(ended, lease_parameters(lease))) is None:
        holder = f"{lease.holder} (attempt {lease.attempt})"
        raise LeaseLost(f"Job {lease.job} is no longer held by {holder}; its results were not written.")
    return league


def release(db: sa.Connection, lease: Lease) -> None:
    """Release a job, see Store.release. Raises LeaseLost."""
    bump_revisions(db, [end_lease(db, lease, state="queued", holder=None)])


def fail(db: sa.Connection, lease: Lease, error: str, tries: int, wait: float) -> None:
    """Record a failure, see Store.fail. Raises LeaseLost."""
    c = t.jobs.c
    before, kind = db.execute(sa.select(c.error, c.kind).where(c.id == lease.job)).one_or_none() or (None, "")
    failed = _failed_on(before) | ({mine} if (mine := worker_of(lease.holder)) else set())
    text = f"{_storable(error)}\n{_FAILED_ON}{', '.join(sorted(failed))}" if failed else _storable(error)
    league = end_lease(db, lease, state="failed", error=text, holder=None, failures=c.failures + 1)
    bump_revisions(db, [league])
    failures = db.execute(sa.select(c.failures).where(c.id == lease.job)).scalar_one()
    retry_elsewhere = (
        len(failed) == 1 and failures < MAX_RETRY_FACTOR * tries and _has_other_workers(db, league, kind, failed)
    )
    if failures < tries or retry_elsewhere:
        again = {"state": "queued", "not_before": t.now() + wait * 2.0 ** (min(failures, tries) - 1)}
        db.execute(sa.update(t.jobs).where(c.id == lease.job).values(again))


def worker_of(holder: str) -> str | None:
    """Return the worker behind a holder `host:pid:kinds0`, as `host:kinds0`: a replacement process has the same name.

    None if the text is not a worker's name.
    """
    host, *rest = holder.rsplit(":", 2)
    return f"{host}:{rest[1]}" if len(rest) == 2 and rest[0].isdecimal() else None


def _failed_on(error: str | None) -> set[str]:
    """Return the workers on which a job has failed so far, from the last line of its error."""
    last = (error or "").rpartition("\n")[2]
    return set(last.removeprefix(_FAILED_ON).split(", ")) if last.startswith(_FAILED_ON) else set()


def _has_other_workers(db: sa.Connection, league: str, kind: str, failed: set[str]) -> bool:
    """Return whether workers other than these take jobs of that kind now."""
    c = t.workers.c
    alive = db.execute(sa.select(c.id, c.kinds).where(c.league == league, c.seen >= t.now() - ALIVE_SECONDS))
    return any(kind in kinds.split("+") and worker_of(worker) not in {None, *failed} for worker, kinds in alive)


def record_setback(db: sa.Connection, lease: Lease, player: str, reason: str, limit: int) -> None:
    """Record a setback, see Store.record_setback. Raises LeaseLost, UnknownName."""
    reason = _storable(reason)
    league = end_lease(db, lease, state="done", error=reason)
    c = t.players.c
    # A player that was resumed keeps its count, and has `limit` setbacks again before the next pause.
    pauses = sa.or_(c.paused.is_not(None), (c.setbacks + 1) % (limit + 1) == 0)
    counted = {"setbacks": c.setbacks + 1, "paused": sa.case((pauses, reason), else_=c.paused)}
    if db.execute(sa.update(t.players).where(c.league == league, c.name == player).values(counted)).rowcount == 0:
        raise UnknownName("player", player, db.scalars(sa.select(c.name).where(c.league == league)))
    bump_revisions(db, [league])


def require_newest(db: sa.Connection, league: str, bases: Mapping[str, str]) -> None:
    """Raise Superseded unless each player's newest checkpoint is its base ("": none). The players' rows are locked."""
    if not bases:
        return
    c = t.checkpoints.c
    place = sa.func.row_number().over(partition_by=c.player, order_by=NEWEST_CHECKPOINT).label("place")
    ranked = sa.select(c.player, c.digest, place).where(c.league == league, c.player.in_(bases)).subquery()
    rows = db.execute(sa.select(ranked.c.player, ranked.c.digest).where(ranked.c.place == 1))
    newest = {player: digest for player, digest in rows}
    for player, base in sorted(bases.items()):
        if (found := newest.get(player, "")) != base:
            now, then = (digest[:12] or "none" for digest in (found, base))
            raise Superseded(
                f"Player {player!r} goes on from checkpoint {now} now; results from {then} were not written."
            )


def _storable(text: str) -> str:
    """Return the error as text that every database accepts: errors may quote undecodable file names or bytes."""
    return text.encode(errors="replace").decode().replace("\0", "?")


def _claim_conditions(league: str, kind: str, max_attempts: int) -> tuple[tuple[Any, Any], Any]:
    """Return conditions for jobs of a kind: those to claim, (queued, expired), and those to give up."""
    c = t.jobs.c
    mine = sa.and_(c.league == league, c.kind == kind)
    queued = sa.and_(mine, c.state == "queued", c.not_before <= t.now())
    expired = sa.and_(mine, c.state == "leased", c.lease_until < t.now())
    last = c.expiries + 1 >= max_attempts
    return (queued, expired & ~last), expired & last


def _skip_locked(query: Select) -> Select:
    """Skip the rows that a holder is just renewing, and lock the rest (SQLite has a single writer anyway)."""
    return query.with_for_update(skip_locked=True).correlate(None)


# The condition that a lease holds its job; `lease_parameters` gives the three values.
HELD = sa.and_(
    t.jobs.c.id == sa.bindparam("its_id"),
    t.jobs.c.holder == sa.bindparam("its_holder"),
    t.jobs.c.attempt == sa.bindparam("its_attempt"),
    t.jobs.c.state == "leased",
)


def lease_parameters(lease: Lease) -> dict[str, Any]:
    """Return the parameters of `HELD`."""
    return {"its_id": lease.job, "its_holder": lease.holder, "its_attempt": lease.attempt}
