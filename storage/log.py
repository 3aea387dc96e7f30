"""The verbs that read what came of playing and learning: the log of matches, curves, training games."""

from collections.abc import Sequence
from typing import Any

import sqlalchemy as sa

from storage import tables as t
from storage.records import COUNTS, ArenaKey, CurvePoint, Match, Meeting, Pace, Totals
from storage.verbs import Verbs


class Log(Verbs):
    """A part of `storage.store.Store`."""

    def matches(self, league: str, purpose: str | Sequence[str] | None = None, after: int = 0) -> list[Match]:
        """The league's match log in the order of commits, or the part played for some purposes or after a match.

        Who has read up to a match and reads on after its id misses nothing: a later commit has a larger id.
        """
        c = t.matches.c
        wanted = (purpose,) if isinstance(purpose, str) else purpose
        chosen = [c.purpose.in_(wanted)] if wanted is not None else []
        return self._db.records(Match, t.matches, c.league == league, c.id > after, *chosen, order=[c.id])

    def last_match(self, league: str) -> int:
        """The number of the newest match of the log, and so how many there are; 0 before the first."""
        found = self._db.rows(sa.select(t.leagues.c.matches).where(t.leagues.c.name == league))
        return found[0][0] if found else 0

    def totals(self, league: str, purpose: str | Sequence[str], until: float | None = None) -> dict[ArenaKey, Totals]:
        """The match log played for some purpose, summed under each ArenaKey, that of the newest match first.

        `until`: only matches that were written up to then, in seconds since the epoch on the database's clock.
        """
        c = t.matches.c
        wanted = (purpose,) if isinstance(purpose, str) else purpose
        chosen = [c.league == league, c.purpose.in_(wanted), *([c.created <= until] if until is not None else [])]
        sums = [sa.cast(sa.func.sum(c[name]), sa.BigInteger) for name in COUNTS]  # PostgreSQL sums to decimals
        key = [c[name] for name in ArenaKey._fields]
        found: dict[ArenaKey, tuple[list[Any], ...]] = {}  # columns
        with self._db.unchanging() as db:  # key by key: to sort by all five takes SQLite half as long again
            for arena in [ArenaKey(*row) for row in db.execute(sa.select(*key).where(*chosen).distinct())]:
                mine = (*chosen, *(column == value for column, value in zip(key, arena, strict=True)))
                query = sa.select(c.a, c.b, *sums, sa.func.max(c.created), sa.func.max(c.id)).where(*mine)
                columns = found.setdefault(arena, ([], [], [], [], []))
                read = db.execute(query.group_by(c.a, c.b), execution_options={"yield_per": 1000}).partitions()
                for rows in self._db.sound(iter(read), "matches"):  # where many have met few times, as many as matches
                    a, b, *counts, created, last = zip(*rows, strict=True)
                    for column, values in zip(columns, (a, b, zip(*counts, strict=True), created, last), strict=True):
                        column.extend(values)
        logs = [Totals(key, a, b, counts, created, max(last)) for key, (a, b, counts, created, last) in found.items()]
        return {each.arena: each for each in sorted(logs, key=lambda each: -each.newest)}

    def booked(self, league: str) -> tuple[float, float]:
        """Device seconds of the matches that were queued while players learnt, and their first `due`; zeros without."""
        c = t.matches.c
        query = sa.select(sa.func.sum(c.seconds), sa.func.min(c.due)).where(c.league == league, c.due.is_not(None))
        seconds, first = self._db.rows(query)[0]
        return seconds or 0.0, first or 0.0

    def pace(self, league: str, purpose: Sequence[str], until: int) -> Pace:
        """What the matches up to a number, played for these purposes, say of when rating matches were played."""
        c = t.matches.c
        known = (c.league == league, c.id <= until, c.purpose.in_(purpose))
        played = sa.select(sa.func.max(c.created)).where(*known, c.purpose == "rating")
        due = sa.select(c.due).where(*known, c.due.is_not(None)).order_by(c.id.desc()).limit(1).scalar_subquery()
        booked = sa.select(sa.func.max(c.due), sa.func.sum(c.seconds)).where(*known, c.due == due)
        return Pace(self._db.rows(played)[0][0] or 0.0, *self._db.rows(booked)[0])

    def curves(self, league: str, player: str | None = None, after: int = 0) -> list[CurvePoint]:
        """What learning was like after an iteration, for all players or one, by (player, iteration)."""
        c = t.curves.c
        chosen = [c.league == league, c.iteration > after, *([c.player == player] if player is not None else [])]
        return self._db.records(CurvePoint, t.curves, *chosen, order=(c.player, c.iteration))

    def meetings(self, league: str, after: int = 0) -> list[Meeting]:
        """What came of training games, or the part that was written after a row, in the order of commits."""
        c = t.meetings.c
        return self._db.records(Meeting, t.meetings, c.league == league, c.id > after, order=[c.id])
