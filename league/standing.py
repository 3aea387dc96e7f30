"""A league as its store has it now, as one value: what the plan, the tables and the progress line look at."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

from matchmaking.ladder import Ladder, Pool
from matchmaking.payoff import Score
from matchmaking.schedule import Schedule, turn_score
from storage.records import RATED, ArenaKey, Checkpoint, CurvePoint, Job, Match, Meeting, Phase, Player, Snapshot
from storage.store import Store


class Batches(NamedTuple):
    """The rating batches that were queued last, together, while players learnt."""

    due: float  # the second of training to which they are booked, see share.py
    seconds: float  # device time that they took


@dataclass(frozen=True)
class Standing:
    """How a league stands: its players, where they are, their frozen policies, what waits, and who beat whom."""

    players: Sequence[Player] = ()
    snapshots: Sequence[Snapshot] = ()  # of no player first, then by (iteration, name)
    checkpoints: Mapping[str, Checkpoint] = field(default_factory=dict)  # player -> its newest
    phases: Mapping[str, Phase] = field(default_factory=dict)  # group -> its newest
    jobs: Sequence[Job] = ()  # that wait, are worked on or were set aside, oldest first
    arena: ArenaKey | None = None  # under which matches are rated now; None before the first
    ladder: Ladder = field(default_factory=lambda: Ladder(()))  # of the rating matches under it
    read: int = 0  # the last rated match that was read, under whatever key
    played: float = 0.0  # when the last of the league's own rating matches was written, on the database's clock
    meetings: Sequence[Meeting] = ()  # what came of all training games, in the order of their turns
    batches: Batches | None = None  # None before the first
    rewards: Mapping[str, float] = field(default_factory=dict)  # player -> reward per episode, if it was asked for
    scores: Mapping[str, Score] = field(default_factory=dict)  # of learners whose turn a score ends: see turn_scores
    revision: int = -1  # of the store when this was read

    @classmethod
    def of(
        cls,
        store: Store,
        league: str,
        before: "Standing | None" = None,
        arena: ArenaKey | None = None,
        recent: int = 0,
    ) -> "Standing":
        """Read it. `before` itself where nothing has changed since; of the match log only what came after it.

        The ladder is that of `arena`, without one that of the newest rating match. `recent` is the number of learning
        iterations over which `rewards` are taken; with 0 there are none. Raises UnknownName for a league that is not
        there.
        """
        # In this order: what changes while we read is read again next time, and a job whose results we have read may
        # look unfinished for that long, but no job looks finished whose results we have not read.
        revision = store.revision(league)
        if before is not None and before.revision == revision and arena in (None, before.arena):
            return before
        before = before or cls()
        jobs, players = store.jobs(league, ("queued", "leased", "failed")), store.players(league)
        known = store.snapshot_count(league) == (
            len(before.snapshots),
            sum(s.thinned is not None for s in before.snapshots),
        )
        snapshots = before.snapshots if known else store.snapshots(league)
        log = _Log.of(store, league, before, arena, Pool.of(snapshots, players))
        checkpoints, phases = store.newest_checkpoints(league), store.phases(league)
        met = before.meetings[-1].id if before.meetings else 0
        return cls(
            players, snapshots, checkpoints, phases, jobs, *log[:4],
            [*before.meetings, *store.meetings(league, met)],
            log.batches, _rewards(store, checkpoints, recent), turn_scores(store, phases), revision,
        )  # fmt: skip

    def history(self, player: str) -> list[Snapshot]:
        """A player's snapshots, oldest first."""
        return [s for s in self.snapshots if s.player == player]

    @cached_property
    def groups(self) -> Mapping[str, Sequence[Player]]:
        """The players that learn together, by the name of their group."""
        names = dict.fromkeys(player.group for player in self.players)
        return {name: [player for player in self.players if player.group == name] for name in names}

    def spent(self, group: str, schedule: Schedule) -> tuple[float, int]:
        """Seconds and environment steps that a group has been trained for.

        A player's own count only grows while it learns: where they take turns the group's is the sum, else that of the
        one that has come furthest.
        """
        own = [self.checkpoints[p.name] for p in self.groups[group] if p.name in self.checkpoints]
        total = sum if schedule.adds_up else max
        return total([c.seconds for c in own] or [0.0]), total([c.step for c in own] or [0])

    def trained(self, schedule: Schedule) -> float:
        """Seconds that devices have trained for: of all groups together, each of which has one to itself."""
        return sum(self.spent(group, schedule)[0] for group in self.groups)

    @property
    def newest(self) -> Checkpoint | None:
        """The checkpoint of the player that has come furthest, None before the first."""
        return max(self.checkpoints.values(), key=lambda c: c.iteration, default=None)

    @property
    def one_team(self) -> bool:
        """Whether all players are of one team, which then has nobody to play against."""
        return len({player.team for player in self.players}) == 1


def turn_scores(store: Store, phases: Mapping[str, Phase]) -> dict[str, Score]:
    """How each learner whose turn a score may end has scored in it of late, by its learning curve.

    Those are the episodes of training, over all worlds from which it learns: they are there after each iteration, in
    the store with the checkpoint that they led to, and the same on every machine where training is.
    """
    return {
        learner: turn_score(episode_scores(store.curves(phase.league, learner, after=phase.since.get(learner, 0))))
        for phase in phases.values()
        if "score" in phase.until
        for learner in phase.learners
    }


def episode_scores(points: Sequence[CurvePoint]) -> list[tuple[float, float]]:
    """Episodes that ended in each iteration, and their mean score, where any did."""
    return [(p.values["episodes"], p.values["score"]) for p in points if "score" in p.values]


def _rewards(store: Store, checkpoints: Mapping[str, Checkpoint], recent: int) -> dict[str, float]:
    """Reward per episode of each player over its last `recent` iterations, of those that have so many and ended any."""
    found = {}
    for name, at in checkpoints.items() if recent else ():
        points = [p.values for p in store.curves(at.league, name, after=at.iteration - recent)]
        lengths = [p["length"] for p in points if "length" in p]
        if len(points) >= recent and lengths:
            found[name] = sum(p["reward"] for p in points) / len(points) * sum(lengths) / len(lengths)
    return found


def _batches(last: Batches | None, new: Sequence[Match]) -> Batches | None:
    """The newest batches, given those before the `new` matches."""
    for match in new:
        if match.due is not None:
            paid = last.seconds if last is not None and last.due == match.due else 0.0
            last = Batches(match.due, paid + match.seconds)
    return last


class _Log(NamedTuple):
    """What is kept of the log of rated matches, see Standing."""

    arena: ArenaKey | None
    ladder: Ladder
    read: int
    played: float
    batches: Batches | None

    @classmethod
    def of(cls, store: Store, league: str, before: Standing, arena: ArenaKey | None, pool: Pool) -> "_Log":
        """That of one ladder: what is new since before, added; of a ladder not seen before, the log's sums."""
        new = store.matches(league, RATED, after=before.read) if before.read else []
        key = arena or (new[-1].arena if new else before.arena)
        if not before.read or key != before.arena:
            return cls._summed(store, league, arena, pool)
        ladder = before.ladder.extended([m for m in new if m.arena == key], pool)
        played = max((m.created for m in new if m.purpose == "rating"), default=before.played)
        return cls(key, ladder, new[-1].id if new else before.read, played, _batches(before.batches, new))

    @classmethod
    def _summed(cls, store: Store, league: str, arena: ArenaKey | None, pool: Pool) -> "_Log":
        totals = store.totals(league, RATED)
        key, read = arena or next(iter(totals), None), max((log.newest for log in totals.values()), default=0)
        pace = store.pace(league, RATED, until=read)
        batches = None if pace.due is None else Batches(pace.due, pace.seconds or 0.0)
        return cls(key, Ladder(pool, totals.get(key, ()) if key else ()), read, pace.played, batches)
