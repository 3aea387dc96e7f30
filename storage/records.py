"""What the store holds, as values: frozen dataclasses that carry no connection and may be passed anywhere.

Times are seconds since the epoch on the database's clock. Digests are SHA-256 in hexadecimal. Within a league a
snapshot, like a player, is known by its name; its digest says which bytes it holds, and two may hold the same.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple


class ArenaKey(NamedTuple):
    """What makes two matches comparable: the same game, the same rules and bodies, the same physics engine."""

    arena: str
    config_hash: str
    engine: str


@dataclass(frozen=True)
class League:
    """A named league of a store and the configuration it was created with or last run with."""

    name: str
    config: str  # TOML, as the user would write it
    created: float = 0.0


@dataclass(frozen=True)
class Run:
    """One `league run`: what was asked for and where it ran."""

    id: int
    league: str
    config: str
    host: str
    versions: Mapping[str, str]
    started: float


@dataclass(frozen=True)
class Player:
    """A learning lineage of a league for one team, e.g. `blue`, with a role such as `main`.

    Players of one `group` learn together, at most one for each team. `setbacks` counts how often in a row its learning
    has diverged and gone back to the last good checkpoint; a player that is `paused` learns no more, for that reason.
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
    """A player's private resume state; the newest of a player, by iteration, is where it goes on.

    Iteration, steps and seconds are the player's own.
    """

    league: str
    player: str
    digest: str
    step: int  # environment steps (decisions × worlds) learnt from
    iteration: int  # learning iterations done
    seconds: float  # time spent training
    arena: ArenaKey | None = None  # what it learnt in last; None before it has learnt
    created: float = 0.0


Origin = Literal["trained", "scripted", "imported"]


@dataclass(frozen=True)
class Snapshot:
    """A frozen policy for a whole roster: immutable. A scripted opponent is one too: its bytes name the script.

    `roster` says which sides it can play: the agents' kinds with their observation and action sizes.
    """

    league: str
    name: str  # unique in its league, e.g. blue@16 (iteration 16) or pusher
    digest: str  # of its bytes
    roster: str
    player: str | None = None  # the lineage it belongs to; None for a scripted or imported one
    script: str | None = None
    origin: Origin = "trained"
    parent: str | None = None  # name of the snapshot that it goes on from
    initial: bool = False  # the policy that its player began with, by which progress is told
    arena: ArenaKey | None = None  # what its player had learnt in
    settings: str = ""  # the league's configuration (TOML) that was in force
    step: int = 0
    iteration: int = 0
    seconds: float = 0.0
    created: float = 0.0
    thinned: float | None = None  # when its bytes were given up: what it has played counts, and it plays no more


Purpose = Literal["rating", "gate", "exploit", "exhibition", "training"]
"""What a match was played for: the league's own rating, a sequential test, a new attacker's measure, or to be seen;
"training" is an episode as those who learn played it, of which `a` and `b` are the newest snapshots before it."""
RATED: tuple[Purpose, ...] = ("rating", "gate", "exploit")
"""Those that count for ratings: their pairs were told before they began, and every game of them is kept."""


class PairCounts(NamedTuple):
    """How seed pairs ended for A: two games from one seed, sides swapped, scored together 0, ½, 1, 1½ or 2."""

    ll: int = 0
    ld: int = 0
    dd_wl: int = 0
    dw: int = 0
    ww: int = 0


@dataclass(frozen=True)
class Match:
    """A batch of episodes between two snapshots, counted for A. One row per batch, never per episode.

    `wins`, `draws` and `losses` count every valid episode; `side_*` count only those in which A played team 0, so that
    an arena's side advantage can be estimated. `pairs` counts the complete seed pairs (empty where sides were not
    swapped). `voids` were stopped by unstable physics and count for nobody; `voids_a` and `voids_b` are those of them
    in which only that side's robots went bad. In an arena of one team there is no B: a win is a success. `seconds` is
    its part of the device time that was spent on playing, compiling left out (0 where nobody measured it); `due` is set
    for a batch that was queued while players learnt: the second of the league's training to which it is booked.
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
    id: int = 0  # 1, 2, 3, ... in the order of commits, within the league
    created: float = 0.0


class Totals(NamedTuple):
    """Matches under one ArenaKey, summed for each a and b: all that ratings need of a log, in fewer rows."""

    arena: ArenaKey
    a: Sequence[str]
    b: Sequence[str | None]
    counts: Sequence[Sequence[int]]  # (rows, 14), in the order of COUNTS
    created: Sequence[float]  # of the newest match in the row
    newest: int  # id of the newest match of all


class Pace(NamedTuple):
    """When rating matches were played, and what the last ones took that were queued while players learnt."""

    played: float  # when the last one was written, 0 without one
    due: float | None  # to which second of training the last ones are booked
    seconds: float | None  # of a device, that they took


COUNTS = (
    "wins", "draws", "losses", "side_wins", "side_draws", "side_losses", *PairCounts._fields,
    "voids", "voids_a", "voids_b",
)  # fmt: skip
"""What is summed of matches, by the names of their columns."""


@dataclass(frozen=True)
class CurvePoint:
    """What one learning iteration of one player was like. `values` holds figures by name, all finite."""

    league: str
    player: str
    iteration: int  # done, so the first one is 1
    step: int
    seconds: float
    values: Mapping[str, float]


@dataclass(frozen=True)
class Meeting:
    """What came of a player's training games against one opponent in one turn, counted for the player.

    A draw is a draw. `opponent` is a snapshot, or a player that sat there as it was then. `chance` is the probability
    with which each group of worlds drew that snapshot, out of `pool` of them; 1 of 0 for a player.
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
    """Who of a group learns now, since when, and what will end it. A group's phases are numbered 0, 1, 2, ..."""

    league: str
    group: str
    number: int
    learners: tuple[str, ...]  # players
    since: Mapping[str, int]  # player -> its iteration when the phase began, for every player of the group
    until: Mapping[str, Any] = field(default_factory=dict)  # e.g. {"iterations": 50}; empty: nothing ends it
    created: float = 0.0


JobState = Literal["queued", "leased", "done", "failed"]


@dataclass(frozen=True)
class Job:
    """A unit of work: queued once under its key, leased to one worker at a time, finished once.

    A job that failed waits until `not_before` and is tried again; after enough `failures` it is set aside in the state
    `failed`, with its `error`, and the league goes on without it.
    """

    league: str
    kind: str  # see league/jobs.py
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
    """Proof of a claim. Renewing and finishing name all three; a stale one is refused."""

    job: int
    holder: str
    attempt: int


@dataclass(frozen=True)
class Worker:
    """A process that said it was alive, and what it was doing then."""

    id: str  # host:pid:start
    league: str
    kinds: str
    pid: int
    host: str
    status: Mapping[str, Any]
    started: float
    seen: float
