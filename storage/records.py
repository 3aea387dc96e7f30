"""What the store holds, as values: frozen dataclasses that carry no connection and may be passed anywhere.

Times are seconds since the epoch on the database's clock. Digests are SHA-256 in hexadecimal.
"""

from collections.abc import Mapping
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
    arena: ArenaKey
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
    """A learning lineage of a league for one team, e.g. `blue`, with a role such as `main`."""

    league: str
    name: str
    team: int
    role: str
    roster: str  # see Snapshot.roster


@dataclass(frozen=True)
class Checkpoint:
    """A player's private resume state; the newest of a player is where it goes on."""

    league: str
    player: str
    digest: str
    step: int  # environment steps (decisions × worlds) learnt from
    iteration: int  # learning iterations done
    seconds: float  # time spent training
    created: float = 0.0


@dataclass(frozen=True)
class Snapshot:
    """A frozen policy for a whole roster: immutable, named by the hash of its bytes.

    A scripted opponent is a snapshot too: its bytes name the script. `roster` says which sides it can play: the agents'
    kinds with their observation and action sizes.
    """

    digest: str
    league: str
    name: str  # e.g. blue@16 (iteration 16) or script:pusher
    roster: str
    player: str | None = None  # None for a scripted opponent
    script: str | None = None
    step: int = 0
    iteration: int = 0
    seconds: float = 0.0
    created: float = 0.0


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
    swapped). `voids` were stopped by unstable physics and count for nobody.
    """

    league: str
    arena: ArenaKey
    a: str  # snapshot digests
    b: str
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
    id: int = 0
    created: float = 0.0


JobState = Literal["queued", "leased", "done", "failed"]


@dataclass(frozen=True)
class Job:
    """A unit of work: queued once under its key, leased to one worker at a time, finished once."""

    league: str
    kind: str  # train | match
    key: str  # unique within the league: queueing the same key again changes nothing
    payload: Mapping[str, Any] = field(default_factory=dict)
    priority: int = 0  # larger first, then oldest first
    state: JobState = "queued"
    attempt: int = 0
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
