"""The statements by which jobs are leased: each a step of a transaction of its caller's.

A claim and all that a holder may do are conditional writes on (job, holder, attempt); liveness is judged by the
database's clock. So of two that believe they hold a job, at most one is right, and the other writes nothing.
"""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, TypeVar

import sqlalchemy as sa

from storage import tables as t
from storage.errors import LeaseLost, Superseded, UnknownName
from storage.records import Job, Lease
from storage.rows import NEWEST_CHECKPOINT, columns, record_from, touch

Select = TypeVar("Select", bound=sa.Select)


def look(db: sa.Connection, league: str, kinds: tuple[str, ...], max_attempts: int) -> tuple[bool, bool]:
    """Whether there is a job to take now, and one to give up."""
    some, hopeless = tuple(db.execute(_looking(league, kinds, max_attempts)).one())
    return some, hopeless


def give_up(db: sa.Connection, league: str, kinds: tuple[str, ...], max_attempts: int) -> None:
    """Set aside what has expired so often; the league has been touched."""
    c = t.jobs.c
    hopeless = sa.or_(*(_claimable(league, kind, max_attempts)[1] for kind in kinds))
    error = f"Its lease expired {max_attempts} times: every worker that took it died or hung."
    ended = {"state": "failed", "error": error, "expiries": c.expiries + 1, "holder": None, "lease_until": None}
    db.execute(sa.update(t.jobs).where(c.id.in_(_free(sa.select(c.id).where(hopeless)))).values(ended))


def claim(
    db: sa.Connection, league: str, kinds: tuple[str, ...], holder: str, seconds: float, max_attempts: int
) -> tuple[Lease, Job] | None:
    """See Store.claim. One statement, by which a server is also told not to wait for its disk: `tables.unhurried`."""
    row = db.execute(_taking(league, kinds, max_attempts), {"who": holder, "for_seconds": seconds}).one_or_none()
    if row is None:
        return None
    job = record_from(Job, row[:-1])
    return Lease(job.id, holder, job.attempt), job


# Statements that every worker sends again and again are built once: that takes longer than a database to answer them.


@lru_cache
def _looking(league: str, kinds: tuple[str, ...], max_attempts: int) -> Any:
    c = t.jobs.c
    due, given_up = zip(*(_claimable(league, kind, max_attempts) for kind in kinds), strict=True)
    some = [sa.exists(sa.select(c.id).where(each)) for states in due for each in states]
    return sa.select(sa.or_(*some), sa.or_(*(sa.exists(sa.select(c.id).where(each)) for each in given_up)))


@lru_cache
def _taking(league: str, kinds: tuple[str, ...], max_attempts: int) -> Any:
    """Take the next job: of those of each kind that wait, and of those whose lease has expired, the first is looked up.

    An index holds each of these in the order of the queue, but not all of them in one.
    """
    c = t.jobs.c
    firsts = [
        _free(sa.select(c.id, c.priority).where(each).order_by(c.priority.desc(), c.id).limit(1)).subquery()
        for kind in kinds
        for each in _claimable(league, kind, max_attempts)[0]
    ]
    ahead = sa.union_all(*(sa.select(first) for first in firsts)).subquery()
    first = sa.select(ahead.c.id).order_by(ahead.c.priority.desc(), ahead.c.id).limit(1)
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
        .returning(*columns(Job, t.jobs), t.unhurried())
    )


def renew(db: sa.Connection, lease: Lease, seconds: float) -> bool:
    """Hold the job for `seconds` from now; False when it is no longer the lease's. Changes nothing that is planned."""
    again = sa.update(t.jobs).where(_HELD).values(lease_until=t.now() + seconds)
    return db.execute(again, _proof(lease)).rowcount == 1


def end(db: sa.Connection, lease: Lease, **values: Any) -> str:
    """End a lease, leaving the job with these values; gives the league, which is to be touched next. Raises LeaseLost.

    In this order, so that of two that end jobs of a league one keeps the other waiting for as short as can be.
    """
    ended = sa.update(t.jobs).where(_HELD).values({"lease_until": None, **values}).returning(t.jobs.c.league)
    if (league := db.scalar(ended, _proof(lease))) is None:
        holder = f"{lease.holder} (attempt {lease.attempt})"
        raise LeaseLost(f"Job {lease.job} is no longer held by {holder}; its results were not written.")
    return league


def release(db: sa.Connection, lease: Lease) -> None:
    """See Store.release. Raises LeaseLost."""
    touch(db, [end(db, lease, state="queued", holder=None)])


def fail(db: sa.Connection, lease: Lease, error: str, tries: int, wait: float) -> None:
    """See Store.fail. Raises LeaseLost."""
    c = t.jobs.c
    touch(db, [end(db, lease, state="failed", error=_storable(error), holder=None, failures=c.failures + 1)])
    failures = db.execute(sa.select(c.failures).where(c.id == lease.job)).scalar_one()
    if failures < tries:
        again = {"state": "queued", "not_before": t.now() + wait * 2.0 ** (failures - 1)}
        db.execute(sa.update(t.jobs).where(c.id == lease.job).values(again))


def setback(db: sa.Connection, lease: Lease, player: str, reason: str, limit: int) -> None:
    """See Store.setback. Raises LeaseLost, UnknownName."""
    reason = _storable(reason)
    league = end(db, lease, state="done", error=reason)
    touch(db, [league])
    c = t.players.c
    counted = {
        "setbacks": c.setbacks + 1,
        "paused": sa.case((c.setbacks + 1 > limit, reason), else_=c.paused),
    }
    if db.execute(sa.update(t.players).where(c.league == league, c.name == player).values(counted)).rowcount == 0:
        raise UnknownName("player", player, db.scalars(sa.select(c.name).where(c.league == league)))


def require_newest(db: sa.Connection, league: str, bases: Mapping[str, str]) -> None:
    """Raise Superseded unless each player's newest checkpoint is the one given ("": none); the league is touched."""
    c = t.checkpoints.c
    for player, base in sorted(bases.items()):
        newest = sa.select(c.digest).where(c.league == league, c.player == player).order_by(*NEWEST_CHECKPOINT)
        if (found := db.scalar(newest.limit(1)) or "") != base:
            now, then = (digest[:12] or "none" for digest in (found, base))
            raise Superseded(
                f"Player {player!r} goes on from checkpoint {now} now; results from {then} were not written."
            )


def _storable(text: str) -> str:
    """What any database takes as text: an error may quote a file's name or bytes that are none, and must be kept."""
    return text.encode(errors="replace").decode().replace("\0", "?")


def _claimable(league: str, kind: str, max_attempts: int) -> tuple[tuple[Any, Any], Any]:
    """Which jobs of a kind can be taken now, those that wait and those that have expired, and which to give up."""
    c = t.jobs.c
    mine = sa.and_(c.league == league, c.kind == kind)
    queued = sa.and_(mine, c.state == "queued", c.not_before <= t.now())
    expired = sa.and_(mine, c.state == "leased", c.lease_until < t.now())
    last = c.expiries + 1 >= max_attempts
    return (queued, expired & ~last), expired & last


def _free(query: Select) -> Select:
    """Pass over the rows that a holder is just renewing, and keep the rest for us (SQLite has one writer anyway)."""
    return query.with_for_update(skip_locked=True).correlate(None)


# A job under its lease, whose three values the statement is given beside: see `_proof`.
_HELD = sa.and_(
    t.jobs.c.id == sa.bindparam("its_id"),
    t.jobs.c.holder == sa.bindparam("its_holder"),
    t.jobs.c.attempt == sa.bindparam("its_attempt"),
    t.jobs.c.state == "leased",
)


def _proof(lease: Lease) -> dict[str, Any]:
    return {"its_id": lease.job, "its_holder": lease.holder, "its_attempt": lease.attempt}
