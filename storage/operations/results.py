"""Operations that read the results of playing and learning: the match log, learning curves, training games."""

from array import array
from collections.abc import Sequence
from itertools import chain
from typing import Any

import sqlalchemy as sa

from storage.database import schema as t
from storage.database.garbage_collection import paused_garbage_collection
from storage.errors import StorageError
from storage.operations.base import StoreBase
from storage.operations.curve_columns import curve_pieces, joined
from storage.records import (
    COUNT_COLUMNS,
    ArenaKey,
    CurveColumns,
    CurvePoint,
    LineupTotals,
    Match,
    MatchTotals,
    Meeting,
    RankedMatch,
    RatingPace,
)


class Results(StoreBase):
    """The part of `storage.store.Store` that reads results."""

    def matches(
        self, league: str, purpose: str | Sequence[str] | None = None, after: int = 0,
        among: Sequence[str] | None = None,
    ) -> list[Match]:  # fmt: skip
        """Return the league's matches of one and two teams in commit order, optionally restricted.

        `purpose` selects purposes, `after` the matches after that id, and `among` the matches between two of these
        snapshots. A reader that continues after the last id it has read misses nothing: later commits have larger ids.
        """
        return self._db.records(
            Match, t.matches, *_chosen(t.matches, league, purpose, after, among), order=[t.matches.c.id]
        )

    def ranked_matches(
        self, league: str, purpose: str | Sequence[str] | None = None, after: int = 0,
        among: Sequence[str] | None = None,
    ) -> list[RankedMatch]:  # fmt: skip
        """Return the league's matches of three and more teams in commit order, restricted as `matches` are.

        `among` selects the matches in which at least two of these snapshots met, or one met itself.
        """
        table = t.ranked_matches
        found = self._db.records(RankedMatch, table, *_chosen(table, league, purpose, after), order=[table.c.id])
        return found if among is None else [m for m in found if _met(m, set(among))]

    def log(
        self, league: str, purpose: str | Sequence[str] | None = None, after: int = 0, recorded: bool = False,
        newest: int | None = None, number: int | None = None,
    ) -> list[Match | RankedMatch]:  # fmt: skip
        """Return the matches of all numbers of teams in commit order, restricted as `matches` are.

        With `recorded`, only those with a recording; with `newest`, at most so many, the last of them; with `number`,
        only the match of that id.
        """
        found: list[Match | RankedMatch] = []
        with self._db.repeatable_read() as db:  # else a match could be missed beside a later one of the other table
            for record, table in ((Match, t.matches), (RankedMatch, t.ranked_matches)):
                c = table.c
                chosen = _chosen(table, league, purpose, after)
                chosen += [c.recording.is_not(None)] if recorded else []
                chosen += [c.id == number] if number is not None else []
                order = [c.id if newest is None else c.id.desc()]
                found += self._db.records_in(db, record, table, *chosen, order=order, limit=newest)
        found.sort(key=lambda match: match.id)
        return found if newest is None else found[max(0, len(found) - newest) :]

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
        chosen = [*_chosen(t.matches, league, purpose, 0), *([c.created <= until] if until is not None else [])]
        sums = [sa.cast(sa.func.sum(c[name]), sa.BigInteger) for name in COUNT_COLUMNS]  # PostgreSQL sums to decimals
        key = [c[name] for name in ArenaKey._fields]
        found: dict[ArenaKey, tuple[list[str], list[str | None], array[int], array[float], int]] = {}
        names: dict[str | None, str | None] = {}  # so that each text is in memory once
        with (
            self._db.repeatable_read() as db,
            paused_garbage_collection(),
        ):  # one query per key: SQLite takes half as long again to group by all five columns
            for arena in [ArenaKey(*row) for row in db.execute(sa.select(*key).where(*chosen).distinct())]:
                mine = (*chosen, *(column == value for column, value in zip(key, arena, strict=True)))
                query = sa.select(c.a, c.b, *sums, sa.func.max(c.created), sa.func.max(c.id)).where(*mine)
                of_a, of_b, sums_of, times, newest = [], [], array("q"), array("d"), 0
                read = db.execute(query.group_by(c.a, c.b), execution_options={"yield_per": 1000}).partitions()
                for rows in self._db.checked(
                    iter(read), "matches"
                ):  # up to one row per match, where many pairs have met rarely
                    a, b, *counts, created, last = zip(*rows, strict=True)
                    if not all(isinstance(number, int) for number in last):
                        raise StorageError(
                            f"{self.where}: a row of table 'matches' is damaged: an id is no whole number."
                        )
                    of_a += [names.setdefault(name, name) for name in a]
                    of_b += [names.setdefault(name, name) for name in b]
                    try:
                        sums_of.extend(chain.from_iterable(zip(*counts, strict=True)))
                        times.extend(created)
                    except (TypeError, OverflowError) as error:
                        raise StorageError(f"{self.where}: the log of matches is damaged: {error}.") from None
                    newest = max(newest, *last)
                found[arena] = of_a, of_b, sums_of, times, newest
            ranked = self._lineups(db, league, purpose, until)
        logs = [
            MatchTotals(key, a, b, counts, created, max(last, newest), lineups)
            for key in {**found, **ranked}
            for a, b, counts, created, last in (found.get(key, ([], [], array("q"), array("d"), 0)),)
            for newest, lineups in (ranked.get(key, (0, {})),)
        ]
        return {each.arena: each for each in sorted(logs, key=lambda each: -each.newest)}

    def _lineups(
        self, db: sa.Connection, league: str, purpose: str | Sequence[str], until: float | None
    ) -> dict[ArenaKey, tuple[int, dict[tuple[str, ...], LineupTotals]]]:
        """Return for each ArenaKey the id of its newest ranked match, and the sums of its lineups."""
        table = t.ranked_matches
        chosen = [*_chosen(table, league, purpose, 0), *([table.c.created <= until] if until is not None else [])]
        found: dict[ArenaKey, tuple[int, dict[tuple[str, ...], LineupTotals]]] = {}
        for match in self._db.records_in(db, RankedMatch, table, *chosen, order=[table.c.id]):
            lineups = found.get(match.arena, (0, {}))[1]
            lineups[match.snapshots] = LineupTotals.of(match).plus(lineups.get(match.snapshots))
            found[match.arena] = (match.id, lineups)
        return found

    def voids(self, league: str, purpose: Sequence[str], after: int) -> list[tuple[int, int, int]]:
        """Return causes, void episodes and valid episodes, summed by causes, of later matches played for these
        purposes.
        """
        c = _both(league, after=after, purpose=purpose).c
        sums = [sa.cast(sa.func.sum(x), sa.BigInteger) for x in (c.voids, c.episodes)]
        return [tuple(row) for row in self._db.rows(sa.select(c.causes, *sums).group_by(c.causes))]

    def booked(self, league: str) -> tuple[float, float]:
        """Return device seconds of the matches queued during training, and their first `due`; zeros if none."""
        c = _both(league, booked=True).c
        seconds, first = self._db.rows(sa.select(sa.func.sum(c.seconds), sa.func.min(c.due)))[0]
        return seconds or 0.0, first or 0.0

    def booked_episodes(self, league: str) -> int:
        """Return the number of episodes, void ones included, of the matches whose device seconds `booked` sums."""
        c = _both(league, booked=True).c
        query = sa.select(sa.func.sum(c.episodes + c.voids)).where(c.seconds > 0)
        return int(self._db.rows(query)[0][0] or 0)

    def pace(self, league: str, purpose: Sequence[str], until: int) -> RatingPace:
        """Return the pace of rating matches among the matches up to id `until` that were played for these purposes."""
        c = _both(league, until=until, purpose=[each for each in purpose if each == "rating"]).c
        played = sa.select(sa.func.max(c.created))
        c = _both(league, until=until, purpose=purpose, booked=True).c
        due = sa.select(c.due).order_by(c.id.desc()).limit(1).scalar_subquery()
        booked = sa.select(sa.func.max(c.due), sa.func.sum(c.seconds)).where(c.due == due)
        return RatingPace(self._db.rows(played)[0][0] or 0.0, *self._db.rows(booked)[0])

    def curves(self, league: str, player: str | None = None, after: int = 0) -> list[CurvePoint]:
        """Return the metrics of iterations after `after`, for all players or one, by (player, iteration)."""
        c = t.curves.c
        chosen = [c.league == league, c.iteration > after, *([c.player == player] if player is not None else [])]
        return self._db.records(CurvePoint, t.curves, *chosen, order=(c.player, c.iteration))

    def newest_curves(self, league: str, most: int) -> list[CurvePoint]:
        """Return the metrics of the newest iterations of all players, at most so many, by (iteration, player)."""
        c = t.curves.c
        order = (c.iteration.desc(), c.player.desc())
        return self._db.records(CurvePoint, t.curves, c.league == league, order=order, limit=most)[::-1]

    def curve_columns(self, league: str, metrics: Sequence[str]) -> dict[str, CurveColumns]:
        """Return these metrics of all iterations of each player, by player.

        It takes a fifth of the time of `curves`, and a tenth of its memory.
        """
        c = t.curves.c
        query = sa.select(c.player, c.iteration, c.step, c.seconds, sa.cast(c["values"], sa.Text))
        query = query.where(c.league == league).order_by(c.player, c.iteration)
        with self._db.repeatable_read() as db:
            read = db.execute(query, execution_options={"yield_per": 1000}).partitions()
            return joined(self._db.checked(curve_pieces(read, metrics), "curves"))

    def meetings(self, league: str, after: int = 0, limit: int | None = None) -> list[Meeting]:
        """Return the outcomes of training games, or the first ones written after a row, in commit order."""
        c = t.meetings.c
        return self._db.records(Meeting, t.meetings, c.league == league, c.id > after, order=[c.id], limit=limit)


def _chosen(
    table: sa.Table, league: str, purpose: str | Sequence[str] | None, after: int, among: Sequence[str] | None = None
) -> list[Any]:
    """Return the conditions of a selection of matches."""
    c = table.c
    wanted = (purpose,) if isinstance(purpose, str) else purpose
    chosen = [c.league == league, c.id > after, *([c.purpose.in_(wanted)] if wanted is not None else [])]
    return chosen + ([c.a.in_(among), c.b.in_(among)] if among is not None else [])


def _met(match: RankedMatch, among: set[str]) -> bool:
    """Return whether at least two teams were played by these snapshots."""
    return sum(name in among for name in match.snapshots) > 1


def _both(
    league: str, after: int = 0, until: int | None = None, purpose: Sequence[str] | None = None, booked: bool = False
) -> sa.Subquery:
    """Return a selection of the matches of both tables, with the columns that both have and valid episodes.

    The conditions are set in either table: no database is trusted to move them there.
    """
    m, r = t.matches.c, t.ranked_matches.c
    shared = ("id", "causes", "voids", "seconds", "due", "created")
    parts = [
        sa.select(*(c[name] for name in shared), episodes.label("episodes")).where(
            c.league == league, c.id > after, *([c.id <= until] if until is not None else []),
            *([c.purpose.in_(purpose)] if purpose is not None else []), *([c.due.is_not(None)] if booked else []),
        )
        for c, episodes in ((m, m.wins + m.draws + m.losses), (r, r.episodes))
    ]  # fmt: skip
    return sa.union_all(*parts).subquery()
