"""The statements by which jobs are leased: each a step of a transaction of its caller's.

A claim and all that a holder may do are conditional writes on (job, holder, attempt); liveness is judged by the
database's clock. So of two that believe they hold a job, at most one is right, and the other writes nothing.
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import sqlalchemy as sa

from storage import tables as t
from storage.database import Database
from storage.errors import LeaseLost, Superseded, UnknownName
from storage.records import Job, Lease
from storage.rows import NEWEST_CHECKPOINT, columns, record_from, touch


def look(db: Database, league: str, kinds: tuple[str, ...], max_attempts: int) -> tuple[bool, bool]:
    """Whether there is a job to take now, and one to give up: cheaper to ask, and it keeps nobody from writing."""
    some, hopeless = db.rows(_looking(league, kinds, max_attempts))[0]
    return some, hopeless


def give_up(db: sa.Connection, league: str, kinds: tuple[str, ...], max_attempts: int) -> None:
    """Set aside what has expired so often; the league has been touched."""
    c = t.jobs.c
    hopeless = _claimable(league, kinds, max_attempts)[1]
    error = f"Its lease expired {max_attempts} times: every worker that took it died or hung."
    ended = {"state": "failed", "error": error, "expiries": c.expiries + 1, "holder": None, "lease_until": None}
    db.execute(sa.update(t.jobs).where(c.id.in_(_free(sa.select(c.id).where(hopeless)))).values(ended))


def claim(
    db: sa.Connection, league: str, kinds: tuple[str, ...], holder: str, seconds: float, prefer: tuple[str, ...],
    max_attempts: int,
) -> tuple[Lease, Job] | None:  # fmt: skip
    """See Store.claim."""
    told = {"who": holder, "for_seconds": seconds}
    row = db.execute(_taking(league, kinds, prefer, max_attempts), told).one_or_none()
    if row is None:
        return None
    job = record_from(Job, row)
    return Lease(job.id, holder, job.attempt), job


# Statements that every worker sends again and again are built once: that takes longer than a database to answer them.


@lru_cache
def _looking(league: str, kinds: tuple[str, ...], max_attempts: int) -> Any:
    claimable, hopeless = _claimable(league, kinds, max_attempts)
    return sa.select(*(sa.exists(sa.select(t.jobs.c.id).where(each)) for each in (claimable, hopeless)))


@lru_cache
def _taking(league: str, kinds: tuple[str, ...], prefer: tuple[str, ...], max_attempts: int) -> Any:
    c = t.jobs.c
    liked = sa.or_(sa.false(), *(sa.func.substr(c.key, 1, len(start)) == start for start in prefer))
    order = (c.priority.desc(), sa.case((liked, 0), else_=1), c.id)
    first = sa.select(c.id).where(_claimable(league, kinds, max_attempts)[0]).order_by(*order).limit(1)
    take = {
        "state": "leased",
        "holder": sa.bindparam("who"),
        "attempt": c.attempt + 1,
        "expiries": c.expiries + sa.case((c.state == "leased", 1), else_=0),
        "lease_until": t.now() + sa.bindparam("for_seconds", type_=sa.Double),
    }
    # `=` and not IN: PostgreSQL may run an IN (... LIMIT 1) more than once, and then takes several jobs.
    taken = sa.update(t.jobs).where(c.id == _free(first).scalar_subquery()).values(take)
    return taken.returning(*columns(Job, t.jobs))


def renew(db: sa.Connection, lease: Lease, seconds: float) -> bool:
    """Hold the job for `seconds` from now; False when it is no longer the lease's. Changes nothing that is planned."""
    return db.execute(sa.update(t.jobs).where(*_held(lease)).values(lease_until=t.now() + seconds)).rowcount == 1


def end(db: sa.Connection, lease: Lease, **values: Any) -> str:
    """End a lease, leaving the job with these values; touches its league and returns it. Raises LeaseLost."""
    league = db.scalar(sa.select(t.jobs.c.league).where(t.jobs.c.id == lease.job))
    if league is not None:
        touch(db, [league])
        values = {"lease_until": None, **values}
        if db.execute(sa.update(t.jobs).where(*_held(lease)).values(values)).rowcount == 1:
            return league
    holder = f"{lease.holder} (attempt {lease.attempt})"
    raise LeaseLost(f"Job {lease.job} is no longer held by {holder}; its results were not written.")


def fail(db: sa.Connection, lease: Lease, error: str, tries: int, wait: float) -> None:
    """See Store.fail. Raises LeaseLost."""
    c = t.jobs.c
    end(db, lease, state="failed", error=_storable(error), holder=None, failures=c.failures + 1)
    failures = db.execute(sa.select(c.failures).where(c.id == lease.job)).scalar_one()
    if failures < tries:
        again = {"state": "queued", "not_before": t.now() + wait * 2.0 ** (failures - 1)}
        db.execute(sa.update(t.jobs).where(c.id == lease.job).values(again))


def setback(db: sa.Connection, lease: Lease, player: str, reason: str, limit: int) -> None:
    """See Store.setback. Raises LeaseLost, UnknownName."""
    reason = _storable(reason)
    league = end(db, lease, state="done", error=reason)
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


def _claimable(league: str, kinds: Sequence[str], max_attempts: int) -> tuple[Any, Any]:
    """Which jobs can be taken now, and which have to be given up."""
    c = t.jobs.c
    mine = sa.and_(c.league == league, c.kind.in_(kinds))
    queued = sa.and_(mine, c.state == "queued", c.not_before <= t.now())
    expired = sa.and_(mine, c.state == "leased", c.lease_until < t.now())
    last = c.expiries + 1 >= max_attempts
    return sa.or_(queued, expired & ~last), expired & last


def _held(lease: Lease) -> tuple[Any, ...]:
    c = t.jobs.c
    return c.id == lease.job, c.holder == lease.holder, c.attempt == lease.attempt, c.state == "leased"


def _free(query: sa.Select[Any]) -> sa.Select[Any]:
    """Pass over the rows that a holder is just renewing, and keep the rest for us (SQLite has one writer anyway)."""
    return query.with_for_update(skip_locked=True).correlate(None)
