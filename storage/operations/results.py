"""Operations that read the results of playing and learning: the match log, learning curves, training games."""

from collections.abc import Sequence
from typing import Any

import sqlalchemy as sa

from storage.database import schema as t
from storage.database.garbage_collection import paused_garbage_collection
from storage.errors import StorageError
from storage.operations.base import StoreBase
from storage.records import COUNT_COLUMNS, ArenaKey, CurvePoint, Match, MatchTotals, Meeting, RatingPace


class Results(StoreBase):
    """The part of `storage.store.Store` that reads results."""

    def matches(
        self, league: str, purpose: str | Sequence[str] | None = None, after: int = 0,
        among: Sequence[str] | None = None,
    ) -> list[Match]:  # fmt: skip
        """Return the league's match log in commit order, optionally restricted.

        `purpose` selects purposes, `after` the matches after that id, and `among` the matches between two of these
        snapshots. A reader that continues after the last id it has read misses nothing: later commits have larger ids.
        """
        c = t.matches.c
        wanted = (purpose,) if isinstance(purpose, str) else purpose
        chosen = [c.purpose.in_(wanted)] if wanted is not None else []
        chosen += [c.a.in_(among), c.b.in_(among)] if among is not None else []
        return self._db.records(Match, t.matches, c.league == league, c.id > after, *chosen, order=[c.id])

    def last_match(self, league: str) -> int:
        """Return the number of the newest match of the log, which is also the number of matches; 0 before the first."""
        found = self._db.rows(sa.select(t.leagues.c.matches).where(t.leagues.c.name == league))
        return found[0][0] if found else 0

    def totals(
        self, league: str, purpose: str | Sequence[str], until: float | None = None
    ) -> dict[ArenaKey, MatchTotals]:
        """Return sums of the matches played for a purpose under each ArenaKey, the key of the newest match first.

        `until` restricts to matches written up to then, in seconds since the epoch on the database's clock.
        """
        c = t.matches.c
        wanted = (purpose,) if isinstance(purpose, str) else purpose
        chosen = [c.league == league, c.purpose.in_(wanted), *([c.created <= until] if until is not None else [])]
        sums = [sa.cast(sa.func.sum(c[name]), sa.BigInteger) for name in COUNT_COLUMNS]  # PostgreSQL sums to decimals
        key = [c[name] for name in ArenaKey._fields]
        found: dict[ArenaKey, tuple[list[Any], ...]] = {}  # lists of column values
        with (
            self._db.repeatable_read() as db,
            paused_garbage_collection(),
        ):  # one query per key: SQLite takes half as long again to group by all five columns
            for arena in [ArenaKey(*row) for row in db.execute(sa.select(*key).where(*chosen).distinct())]:
                mine = (*chosen, *(column == value for column, value in zip(key, arena, strict=True)))
                query = sa.select(c.a, c.b, *sums, sa.func.max(c.created), sa.func.max(c.id)).where(*mine)
                columns = found.setdefault(arena, ([], [], [], [], []))
                read = db.execute(query.group_by(c.a, c.b), execution_options={"yield_per": 1000}).partitions()
                for rows in self._db.checked(
                    iter(read), "matches"
                ):  # up to one row per match, where many pairs have met rarely
                    a, b, *counts, created, last = zip(*rows, strict=True)
                    if not all(isinstance(number, int) for number in last):
                        raise StorageError(
                            f"{self.where}: a row of table 'matches' is damaged: an id is no whole number."
                        )
                    for column, values in zip(columns, (a, b, zip(*counts, strict=True), created, last), strict=True):
                        column.extend(values)
        logs = [
            MatchTotals(key, a, b, counts, created, max(last)) for key, (a, b, counts, created, last) in found.items()
        ]
        return {each.arena: each for each in sorted(logs, key=lambda each: -each.newest)}

    def voids(self, league: str, purpose: Sequence[str], after: int) -> list[tuple[int, int, int]]:
        """Return causes, void episodes and valid episodes, summed by causes, of later matches played for these
        purposes.
        """
        c = t.matches.c
        sums = [sa.cast(sa.func.sum(x), sa.BigInteger) for x in (c.voids, c.wins + c.draws + c.losses)]
        query = sa.select(c.causes, *sums).where(c.league == league, c.id > after, c.purpose.in_(purpose))
        return [tuple(row) for row in self._db.rows(query.group_by(c.causes))]

    def booked(self, league: str) -> tuple[float, float]:
        """Return device seconds of the matches queued during training, and their first `due`; zeros if none."""
        c = t.matches.c
        query = sa.select(sa.func.sum(c.seconds), sa.func.min(c.due)).where(c.league == league, c.due.is_not(None))
        seconds, first = self._db.rows(query)[0]
        return seconds or 0.0, first or 0.0

    def booked_episodes(self, league: str) -> int:
        """Return the number of episodes, void ones included, of the matches whose device seconds `booked` sums."""
        c = t.matches.c
        episodes = sa.func.sum(c.wins + c.draws + c.losses + c.voids)
        query = sa.select(episodes).where(c.league == league, c.due.is_not(None), c.seconds > 0)
        return int(self._db.rows(query)[0][0] or 0)

    def pace(self, league: str, purpose: Sequence[str], until: int) -> RatingPace:
        """Return the pace of rating matches among the matches up to id `until` that were played for these purposes."""
        c = t.matches.c
        known = (c.league == league, c.id <= until, c.purpose.in_(purpose))
        played = sa.select(sa.func.max(c.created)).where(*known, c.purpose == "rating")
        due = sa.select(c.due).where(*known, c.due.is_not(None)).order_by(c.id.desc()).limit(1).scalar_subquery()
        booked = sa.select(sa.func.max(c.due), sa.func.sum(c.seconds)).where(*known, c.due == due)
        return RatingPace(self._db.rows(played)[0][0] or 0.0, *self._db.rows(booked)[0])

    def curves(self, league: str, player: str | None = None, after: int = 0) -> list[CurvePoint]:
        """Return the metrics of iterations after `after`, for all players or one, by (player, iteration)."""
        c = t.curves.c
        chosen = [c.league == league, c.iteration > after, *([c.player == player] if player is not None else [])]
        return self._db.records(CurvePoint, t.curves, *chosen, order=(c.player, c.iteration))

    def meetings(self, league: str, after: int = 0) -> list[Meeting]:
        """Return the outcomes of training games, or those written after a row, in commit order."""
        c = t.meetings.c
        return self._db.records(Meeting, t.meetings, c.league == league, c.id > after, order=[c.id])
