"""The contents of a store as values: frozen dataclasses without a connection, which may be passed anywhere.

Times are in seconds since the epoch on the database's clock. Digests are SHA-256 in hexadecimal. Within a league,
players and snapshots are identified by name. A snapshot's digest identifies its bytes; two snapshots may share bytes.
"""

from array import array
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

TIMELINE = 1 << 40
"""By so much the revision of a league grows when a standby of its database's server is promoted."""


class ArenaKey(NamedTuple):
    """The conditions that make two matches comparable: the same game, the same rules and bodies, the same physics
    engine.
    """

    arena: str
    config_hash: str
    engine: str


@dataclass(frozen=True)
class League:
    """A named league of a store, with the configuration it was created with or last run with."""

    name: str
    config: str  # TOML, as the user would write it
    created: float = 0.0


@dataclass(frozen=True)
class Run:
    """One `league run`: its configuration, host and versions."""

    id: int
    league: str
    config: str
    host: str
    versions: Mapping[str, str]
    started: float


@dataclass(frozen=True)
class Player:
    """A learning lineage of a league for one team, e.g. `blue`, with a role such as `main`.

    Players of one `group` learn together, at most one for each team. `setbacks` counts how often in a row the player's
    learning has diverged and returned to the last good checkpoint. A `paused` player learns no more; the field has the
    reason.
    """

    league: str
    name: str
    team: int
    role: str
    roster: str  # see Snapshot.roster
    group: str = "1"
    setbacks: int = 0
    paused: str | None = None


@dataclass(frozen=True)
class Checkpoint:
    """A player's private resume state. A player resumes from its newest checkpoint by iteration.

    Iteration, steps and seconds are counted for the player alone.
    """

    league: str
    player: str
    digest: str
    step: int  # environment steps (decisions × worlds) learned from
    iteration: int  # learning iterations done
    seconds: float  # time spent training
    arena: ArenaKey | None = None  # arena of the last learning; None before any learning
    created: float = 0.0


Origin = Literal["trained", "scripted", "imported"]


@dataclass(frozen=True)
class Snapshot:
    """A frozen policy for a whole roster, immutable. A scripted opponent is a snapshot too: its bytes name the script.

    `roster` says which sides it can play: the agents' kinds with their observation and action sizes.
    """

    league: str
    name: str  # unique in its league, e.g. blue@16 (iteration 16) or pusher
    digest: str  # of its bytes
    roster: str
    player: str | None = None  # the lineage it belongs to; None for a scripted or imported one
    script: str | None = None
    origin: Origin = "trained"
    parent: str | None = None  # name of the snapshot that it continues from
    initial: bool = False  # the policy that its player began with, the reference for its progress
    arena: ArenaKey | None = None  # arena in which its player had learned
    settings: str = ""  # the league's configuration (TOML) that was in force
    step: int = 0
    iteration: int = 0
    seconds: float = 0.0
    created: float = 0.0
    thinned: float | None = None  # when its bytes were removed: its matches count, and it plays no more


Purpose = Literal["rating", "request", "gate", "exploit", "exhibition", "training"]
"""Purpose of a match: the league's own rating, rating that a person requests (`league rate`, cross-play), a sequential
test, the measurement of a new exploiter, or an exhibition. "training" is an episode with exploring policies; `a` and
`b` are the newest snapshots before it.
"""
RATED_PURPOSES: tuple[Purpose, ...] = ("rating", "request", "gate", "exploit")
"""Purposes whose matches count for ratings: their pairs were chosen before play, and every game of them is kept."""


class PairCounts(NamedTuple):
    """Results of seed pairs for A: two games from one seed, sides swapped, scored together 0, ½, 1, 1½ or 2."""

    ll: int = 0
    ld: int = 0
    dd_wl: int = 0
    dw: int = 0
    ww: int = 0


@dataclass(frozen=True)
class Match:
    """A batch of episodes between two snapshots, counted for A. One row holds a batch, never a single episode.

    `wins`, `draws` and `losses` count every valid episode. `side_*` count only the episodes in which A played team 0,
    so that an arena's side advantage can be estimated. `pairs` counts the complete seed pairs (empty where sides were
    not swapped). `voids` were stopped by unstable physics and count for nobody. `voids_a` and `voids_b` count the voids
    in which only that side's robots became unstable. `causes` has the bits of `arenas.physics.void_causes` that
    occurred in any episode. In an arena of one team there is no B: a win is a success. `seconds` is the match's share
    of the device time spent on playing, without compilation (0 where it was not measured). `due` is set for a batch
    that was queued during training: the second of the league's training to which it is booked.
    """

    league: str
    arena: ArenaKey
    a: str  # snapshot names
    b: str | None
    wins: int
    draws: int
    losses: int
    voids: int
    side_wins: int
    side_draws: int
    side_losses: int
    pairs: PairCounts
    seed: int
    steps: int = 0  # environment steps simulated
    purpose: str = "rating"
    recording: str | None = None  # digest of an MCAP blob
    voids_a: int = 0
    voids_b: int = 0
    seconds: float = 0.0
    due: float | None = None
    causes: int = 0
    id: int = 0  # 1, 2, 3, ... in the order of commits, within the league
    created: float = 0.0

    @property
    def players(self) -> tuple[str, ...]:
        """Names of the snapshots that played: A, and B if there is one."""
        return (self.a,) if self.b is None else (self.a, self.b)

    @property
    def episodes(self) -> int:
        """Number of valid episodes."""
        return self.wins + self.draws + self.losses


SeedCluster = tuple[tuple[int, ...], ...]
"""Rankings of the episodes that share a seed: one for each rotation of a lineup, all in the same order of snapshots."""


@dataclass(frozen=True)
class RankedMatch:
    """A batch of episodes between three to eight snapshots, one for each team. Batches of two teams are `Match`.

    `rankings` counts the valid episodes by their outcome: the rank of each team in team order, where 1 is the best and
    equal ranks are a tie. Ranks are those of standard competition ranking: a team's rank is 1 plus the number of teams
    ahead of it, so 1, 2, 2, 4. `voids`, `causes`, `seconds` and `due` are as in `Match`. `voids_by_team` counts the
    voids in which only that team's robots became unstable. A snapshot may play several teams.

    A lineup plays all its rotations of seats from the same seeds, each in a row of its own. `seed_clusters` counts the
    seeds from which every rotation ended without a void, by the rankings of these episodes, as ranks of the snapshots
    in this row's order. The first of them is that of this row. Only the row of a lineup's first rotation has them; it
    is empty in the others, and where no two episodes share a seed.
    """

    league: str
    arena: ArenaKey
    snapshots: tuple[str, ...]  # names, in team order
    rankings: Mapping[tuple[int, ...], int]
    voids: int
    voids_by_team: tuple[int, ...]
    seed: int
    steps: int = 0  # environment steps simulated
    purpose: str = "rating"
    recording: str | None = None  # digest of an MCAP blob
    seconds: float = 0.0
    due: float | None = None
    causes: int = 0
    seed_clusters: Mapping[SeedCluster, int] = field(default_factory=dict)
    id: int = 0  # from the same counter as that of Match
    created: float = 0.0

    @property
    def players(self) -> tuple[str, ...]:
        """Names of the snapshots that played, in team order."""
        return self.snapshots

    @property
    def episodes(self) -> int:
        """Number of valid episodes."""
        return sum(self.rankings.values())


def competition_ranks(order: Sequence[float]) -> tuple[int, ...]:
    """Return standard competition ranks, from 1, of places: the smallest is first, and equal ones are a tie."""
    return tuple(1 + sum(other < each for other in order) for each in order)


class CurveColumns(NamedTuple):
    """A player's learning curve in columns, by iteration; nan where a metric was not recorded."""

    iterations: "array[int]"
    steps: "array[int]"
    seconds: "array[float]"
    values: "Mapping[str, array[float]]"  # of the metrics that were asked for
    recorded: set[str]  # names of all metrics in the curve


class LineupTotals(NamedTuple):
    """Ranked matches of one ArenaKey between the same snapshots in the same teams, summed."""

    rankings: Mapping[tuple[int, ...], int]  # as in RankedMatch
    voids: int
    voids_by_team: tuple[int, ...]
    created: float  # time of the newest match
    seed_clusters: Mapping[SeedCluster, int] = MappingProxyType({})  # as in RankedMatch

    @classmethod
    def of(cls, match: RankedMatch) -> "LineupTotals":
        """Return the sums of one match."""
        return cls(match.rankings, match.voids, match.voids_by_team, match.created, match.seed_clusters)

    def plus(self, other: "LineupTotals | None") -> "LineupTotals":
        """Return the sums of these and other matches of the same snapshots."""
        if other is None:
            return self
        by_team = tuple(map(sum, zip(self.voids_by_team, other.voids_by_team, strict=True)))
        rankings, clusters = Counter(self.rankings), Counter(self.seed_clusters)
        rankings.update(other.rankings)
        clusters.update(other.seed_clusters)
        return LineupTotals(rankings, self.voids + other.voids, by_team, max(self.created, other.created), clusters)


class MatchTotals(NamedTuple):
    """Matches of one ArenaKey, summed for each a and b: everything that ratings need of a match log, in fewer rows.

    Ranked matches are summed for each tuple of snapshots, in `lineups`.
    """

    arena: ArenaKey
    a: Sequence[str]
    b: Sequence[str | None]
    counts: Sequence[int] | Sequence[Sequence[int]]  # (rows, 14) or these in one line, in the order of COUNT_COLUMNS
    created: Sequence[float]  # time of the newest match in the row
    newest: int  # id of the newest match of all
    lineups: Mapping[tuple[str, ...], LineupTotals] = MappingProxyType({})


class RatingPace(NamedTuple):
    """Time of the last rating matches, and the cost of the last ones queued during training."""

    played: float  # when the last rating match was written, 0 if there is none
    due: float | None  # the second of training to which the last matches are booked
    seconds: float | None  # device time that they took


COUNT_COLUMNS = (
    "wins", "draws", "losses", "side_wins", "side_draws", "side_losses", *PairCounts._fields,
    "voids", "voids_a", "voids_b",
)  # fmt: skip
"""Columns of `matches` that are summed, by name."""


@dataclass(frozen=True)
class CurvePoint:
    """Metrics of one learning iteration of one player. `values` holds finite numbers by name."""

    league: str
    player: str
    iteration: int  # iterations done, so the first is 1
    step: int
    seconds: float
    values: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Meeting:
    """The outcome of a player's training games against one opponent in one turn, counted for the player.

    A draw counts as a draw. `opponent` is a snapshot, or a learning player in its state at that time. `chance` is the
    probability with which each group of worlds drew that snapshot from a pool of `pool` snapshots. A learning player
    has chance 1 and pool 0.
    """

    league: str
    player: str
    iteration: int  # of the player, when the turn ended
    opponent: str
    wins: int
    draws: int
    losses: int
    voids: int = 0
    chance: float = 1.0
    pool: int = 0
    id: int = 0


@dataclass(frozen=True)
class Phase:
    """The players of a group that learn now, since when, and the condition that ends the phase.

    A group's phases are numbered 0, 1, 2, ...
    """

    league: str
    group: str
    number: int
    learners: tuple[str, ...]  # players
    since: Mapping[str, int]  # player -> its iteration at the start of the phase, for every player of the group
    until: Mapping[str, Any] = field(default_factory=dict)  # e.g. {"iterations": 50}; empty: no end
    created: float = 0.0


JobState = Literal["queued", "leased", "done", "failed"]


@dataclass(frozen=True)
class Job:
    """A unit of work: queued once under its key, leased to one worker at a time, finished once.

    A job that failed waits until `not_before` and is tried again. After enough `failures` it is set aside in the state
    `failed`, with its `error`, and the league continues without it.
    """

    league: str
    kind: str  # see league/state/jobs.py
    key: str  # unique within the league: queueing the same key again changes nothing
    payload: Mapping[str, Any] = field(default_factory=dict)
    priority: int = 0  # larger first, then oldest first
    state: JobState = "queued"
    attempt: int = 0
    failures: int = 0
    not_before: float = 0.0
    holder: str | None = None
    lease_until: float | None = None
    error: str | None = None
    id: int = 0
    created: float = 0.0


class Lease(NamedTuple):
    """Proof of a claim. Renewing and finishing require all three values; an outdated lease is refused."""

    job: int
    holder: str
    attempt: int


@dataclass(frozen=True)
class Worker:
    """A process that reported to be alive, and what it was doing then."""

    id: str  # host:pid:start
    league: str
    kinds: str
    pid: int
    host: str
    status: Mapping[str, Any]
    started: float
    seen: float
