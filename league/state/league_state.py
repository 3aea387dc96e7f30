"""The current state of a league in its store as one value, for the plan, the tables and the progress line."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

from league.state import recent_curves
from league.state.recent_curves import RecentCurve
from league.state.training_games import TrainingGames
from league.state.void_rates import Voids
from league.state.void_rates import found as voids_found
from matchmaking.ratings.ladder import Ladder, Pool
from matchmaking.ratings.scores import Score
from matchmaking.schedule import Schedule
from storage.records import (
    RATED_PURPOSES,
    TIMELINE,
    ArenaKey,
    Checkpoint,
    Job,
    Match,
    Meeting,
    Phase,
    Player,
    RankedMatch,
    Snapshot,
)
from storage.store import Store


class Batches(NamedTuple):
    """The rating batches that were queued last, at the same time, during training."""

    due: float  # the second of training to which they are booked (league/scheduling/match_scheduler.py)
    seconds: float  # device time that they took


class Group(NamedTuple):
    """Players that learn together, with their training so far."""

    name: str
    players: Sequence[Player]
    seconds: float  # of training
    steps: int  # environment steps of training
    phase: Phase | None  # the newest; None before the first
    histories: Sequence[Sequence[Snapshot]]  # of each player, oldest first


NO_MATCHES = Ladder(())
NEW = 500  # snapshots that are read by name
AT_ONCE = 10_000  # training games that are read at once


@dataclass(frozen=True)
class LeagueState:
    """The state of a league: players, checkpoints, phases, snapshots, jobs, ladder and results of training games."""

    players: Sequence[Player] = ()
    snapshots: Sequence[Snapshot] = ()  # those of no player first, then by (iteration, name)
    checkpoints: Mapping[str, Checkpoint] = field(default_factory=dict)  # player -> newest checkpoint
    phases: Mapping[str, Phase] = field(default_factory=dict)  # group -> newest phase
    jobs: Sequence[Job] = ()  # queued, leased or failed, oldest first
    arena: ArenaKey | None = None  # key under which matches are rated now; None before the first match
    ladder: Ladder = NO_MATCHES  # of the rating matches under `arena`
    read: int = 0  # the last rated match that was read, under any key
    last_elsewhere: int = 0  # the last rated match under any other key than `arena`; 0 if there is none
    played: float = 0.0  # database time at which the last rating match of the league itself was written
    meetings: Sequence[Meeting] = ()  # results of all training games, in the order of their turns
    batches: Batches | None = None  # None before the first batch
    curves: Mapping[str, RecentCurve] = field(default_factory=dict)  # by player
    revision: int = -1  # of the store at the time of reading
    voids: Sequence[Voids] = ()  # shares of void episodes that deserve a warning

    @classmethod
    def of(
        cls,
        store: Store,
        league: str,
        before: "LeagueState | None" = None,
        arena: ArenaKey | None = None,
        recent: int = 0,
    ) -> "LeagueState":
        """Read the state of a league: `before` itself if nothing has changed, else only the new part of the match log.

        The ladder is that of `arena`, by default that of the newest rating match. `recent` is the number of learning
        iterations over which `rewards` and `successes` are averaged; with 0 there are none. Raises UnknownName for an
        unknown league.
        """
        # The order matters: changes during the reading are read again next time. Until then a job can look unfinished
        # although its results were read, but no job looks finished before its results were read.
        revision = store.revision(league)
        if before is not None and before.revision == revision and arena in (None, before.arena):
            return before
        if before is None or revision < before.revision or revision // TIMELINE != before.revision // TIMELINE:
            before = cls()  # a failover may have lost what was read
        jobs, players = store.jobs(league, ("queued", "leased", "failed")), store.players(league)
        snapshots = _snapshots(store, league, before.snapshots)
        log = _Log.of(store, league, before, arena, Pool.of(snapshots, players))
        checkpoints, phases = store.newest_checkpoints(league), store.phases(league)
        curves = recent_curves.read(store, league, checkpoints, phases, recent, before.curves)
        return cls(
            players, snapshots, checkpoints, phases, jobs, *log[:5],
            read_games(store, league, before.training_games),
            log.batches, curves, revision, voids_found(store, league, [each.voids for each in curves.values()]),
        )  # fmt: skip

    @classmethod
    def without_games(cls, store: Store, league: str) -> "LeagueState":
        """Read all except snapshots, training games and rating matches, which are many in an old league."""
        checkpoints, phases = store.newest_checkpoints(league), store.phases(league)
        curves = recent_curves.read(store, league, checkpoints, phases)
        return cls(
            store.players(league),
            checkpoints=checkpoints,
            phases=phases,
            jobs=store.jobs(league, ("queued", "leased", "failed")),
            curves=curves,
            voids=voids_found(store, league, [each.voids for each in curves.values()]),
        )

    def history(self, player: str) -> Sequence[Snapshot]:
        """Return a player's snapshots, oldest first."""
        return self._histories.get(player, ())

    @cached_property
    def _histories(self) -> Mapping[str | None, Sequence[Snapshot]]:
        found = defaultdict[str | None, list[Snapshot]](list)
        for snapshot in self.snapshots:
            found[snapshot.player].append(snapshot)
        return found

    @property
    def rewards(self) -> dict[str, float]:
        """Reward per episode of each player that has one, over the `recent` iterations."""
        return {name: each.reward for name, each in self.curves.items() if each.reward is not None}

    @property
    def successes(self) -> dict[str, float]:
        """Share of successes of each player that has one, over the `recent` iterations."""
        return {name: each.success for name, each in self.curves.items() if each.success is not None}

    @property
    def scores(self) -> dict[str, Score]:
        """Recent score of each learner whose phase ends by a score: of the training episodes of this turn."""
        return {name: each.score for name, each in self.curves.items() if each.score is not None}

    @cached_property
    def by_name(self) -> Mapping[str, Snapshot]:
        """All snapshots by name."""
        return {snapshot.name: snapshot for snapshot in self.snapshots}

    @cached_property
    def parents(self) -> Mapping[str, str | None]:
        """Snapshot -> its parent, and player -> its newest snapshot."""
        newest = {s.player: s.name for s in self.snapshots if s.player}
        return {s.name: s.parent for s in self.snapshots} | newest

    @cached_property
    def initials(self) -> Sequence[Snapshot]:
        """The initial snapshots of all players."""
        return [snapshot for snapshot in self.snapshots if snapshot.initial]

    @cached_property
    def training_games(self) -> TrainingGames:
        """The results of all training games, in columns."""
        return self.meetings if isinstance(self.meetings, TrainingGames) else TrainingGames(self.meetings)

    @cached_property
    def newest_snapshots(self) -> Sequence[Snapshot]:
        """Each player's newest snapshot, by iteration."""
        return [history[-1] for p in self.players if (history := self.history(p.name))]

    @cached_property
    def groups(self) -> Mapping[str, Sequence[Player]]:
        """The players that learn together, by the name of their group."""
        names = dict.fromkeys(player.group for player in self.players)
        return {name: [player for player in self.players if player.group == name] for name in names}

    def learning_groups(self, schedule: Schedule) -> list[Group]:
        """Return the groups of players, with the training that counts under this schedule."""
        return [
            Group(name, own, *self.spent(name, schedule), self.phases.get(name), [self.history(p.name) for p in own])
            for name, own in self.groups.items()
        ]

    def spent(self, group: str, schedule: Schedule) -> tuple[float, int]:
        """Return seconds and environment steps of training of a group.

        A player's own count grows only while it learns. If players take turns, the group's count is their sum, else the
        largest count.
        """
        own, total = self._newest(group), sum if schedule.sums_counts else max
        return total([c.seconds for c in own] or [0.0]), total([c.step for c in own] or [0])

    def iterations(self, group: str, schedule: Schedule) -> int:
        """Return the learning iterations of a group, which count as `spent` does."""
        return (sum if schedule.sums_counts else max)([c.iteration for c in self._newest(group)] or [0])

    def _newest(self, group: str) -> list[Checkpoint]:
        return [self.checkpoints[p.name] for p in self.groups[group] if p.name in self.checkpoints]

    def trained(self, schedule: Schedule) -> float:
        """Return device seconds of training: the sum over groups, since each group trains on a device of its own."""
        return sum(self.spent(group, schedule)[0] for group in self.groups)

    @property
    def newest(self) -> Checkpoint | None:
        """The checkpoint with the highest iteration of all players; None before the first."""
        return max(self.checkpoints.values(), key=lambda c: c.iteration, default=None)

    @property
    def one_team(self) -> bool:
        """True if all players are of one team, so that there are no opponents."""
        return len({player.team for player in self.players}) == 1


def read_games(store: Store, league: str, before: TrainingGames) -> TrainingGames:
    """Return a league's training games, of which those `before` were read; some at a time, to save memory."""
    while True:
        new = store.meetings(league, before.newest, limit=AT_ONCE)
        before = before.extended(new)
        if len(new) < AT_ONCE:
            return before


def _snapshots(store: Store, league: str, before: Sequence[Snapshot]) -> Sequence[Snapshot]:
    """Return the snapshots of a league; if none was thinned since `before`, only new ones are read."""
    count, thinned = store.snapshot_count(league)
    if thinned != sum(s.thinned is not None for s in before):
        return store.snapshots(league, brief=True)
    if count == len(before):
        return before
    new = set(store.snapshot_names(league)) - {s.name for s in before}
    if len(new) > NEW:
        return store.snapshots(league, brief=True)
    found = [*before, *store.snapshots(league, brief=True, named=new)]
    return sorted(found, key=lambda s: (s.player is not None, s.iteration, s.name))


def _batches(last: Batches | None, new: Sequence[Match | RankedMatch]) -> Batches | None:
    """Return the newest batches, given the newest before the `new` matches."""
    for match in new:
        if match.due is not None:
            paid = last.seconds if last is not None and last.due == match.due else 0.0
            last = Batches(match.due, paid + match.seconds)
    return last


class _Log(NamedTuple):
    """The part of LeagueState that comes from the log of rated matches."""

    arena: ArenaKey | None
    ladder: Ladder
    read: int
    last_elsewhere: int
    played: float
    batches: Batches | None

    @classmethod
    def of(cls, store: Store, league: str, before: LeagueState, arena: ArenaKey | None, pool: Pool) -> "_Log":
        """Read the log for one ladder: add new matches to `before`, or take the log's sums for a new ladder."""
        new = store.log(league, RATED_PURPOSES, after=before.read) if before.read else []
        key = arena or (new[-1].arena if new else before.arena)
        if not before.read or key != before.arena:
            return cls._summed(store, league, arena, pool)
        ladder = before.ladder.extended([m for m in new if m.arena == key], pool)
        played = max((m.created for m in new if m.purpose == "rating"), default=before.played)
        last = max((m.id for m in new if m.arena != key), default=before.last_elsewhere)
        return cls(key, ladder, new[-1].id if new else before.read, last, played, _batches(before.batches, new))

    @classmethod
    def _summed(cls, store: Store, league: str, arena: ArenaKey | None, pool: Pool) -> "_Log":
        totals = store.totals(league, RATED_PURPOSES)
        key, read = arena or next(iter(totals), None), max((log.newest for log in totals.values()), default=0)
        pace = store.pace(league, RATED_PURPOSES, until=read)
        batches = None if pace.due is None else Batches(pace.due, pace.seconds or 0.0)
        last = max((log.newest for other, log in totals.items() if other != key), default=0)
        return cls(key, Ladder(pool, totals.get(key, ()) if key else ()), read, last, pace.played, batches)
