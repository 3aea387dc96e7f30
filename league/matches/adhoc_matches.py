"""Ad-hoc matches, which a person requests: played in the requesting process and filed in the store like all others.

A batch is filed in one transaction under a job key that identifies its purpose, so the same games are filed once,
however often a command is killed and repeated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np

from league.config import experiment as configuration
from league.config.experiment import Config
from league.config.schema import ConfigError
from league.queries.query import Open
from league.scheduling.progress_metrics import can_meet
from league.state.jobs import RatingMatch, encode
from league.state.team_exchange import as_made
from storage.records import ArenaKey, Match, Purpose, Snapshot

if TYPE_CHECKING:
    from league.matches.evaluator import MatchEvaluator


@dataclass(frozen=True)
class Pairing:
    """Two snapshots of a league that can meet; in an arena of one team, one snapshot."""

    opened: Open
    a: Snapshot
    b: Snapshot | None

    @property
    def pair(self) -> tuple[str, str | None]:
        """Names of the snapshots."""
        return self.a.name, None if self.b is None else self.b.name

    @property
    def swaps(self) -> bool:
        """Return whether each can play either side."""
        return self.b is not None and self.a.roster == self.b.roster

    def config(self) -> Config:
        """Return the settings with which the league was last run."""
        return configuration.loads(self.opened.store.league(self.opened.league).config)

    def evaluator(self, episodes: int, recorded: tuple[int, ...] = ()) -> "MatchEvaluator":
        """Make an evaluator that plays an even number of episodes of this pair at once.

        It keeps the frames of the worlds in `recorded`.
        """
        from league.matches.evaluator import MatchEvaluator

        config = self.config()
        config = replace(config, rating=replace(config.rating, worlds=episodes, pairings=1, record=bool(recorded)))
        arena = config.arena.build(
            engine=config.engine, worlds=episodes, threads=config.workers.threads, **config.buffers.where()
        )
        players = self.opened.store.players(self.opened.league)
        return MatchEvaluator(config, as_made(arena, players), self.opened.league, recorded)

    def seed(self, *about: object) -> int:
        """Return the random seed of a batch that `about` identifies."""
        return crc32("/".join(map(str, (self.opened.setting("seed", otherwise=1), *self.pair, *about))).encode())

    def file(self, evaluator: "MatchEvaluator", purpose: Purpose, seed: int) -> bool:
        """Play a batch and file it as one match; return False if the same match has been filed meanwhile."""
        task = RatingMatch((self.pair,), seed, purpose, record=False)
        return self.keep(task, evaluator.play(self.opened.store, task))

    def keep(self, task: RatingMatch, matches: Sequence[Match]) -> bool:
        """File the matches of a task in one transaction; return False if they have been filed before."""
        key = matches[0].arena
        job = encode(self.opened.league, task, [task.purpose, *self.pair, task.seed, *key])
        return self.opened.store.file(job, matches)

    def filed(self, purpose: Purpose, key: ArenaKey) -> dict[int, Match]:
        """Return the matches of this pair with that purpose and arena, by seed."""
        log = self.opened.store.matches(self.opened.league, purpose)
        return {m.seed: m for m in log if (m.a, m.b, m.arena) == (*self.pair, key)}


def require_two_teams(opened: Open) -> None:
    """Raise ConfigError, one line, in a league of more than two teams, in which no two meet alone."""
    teams = len({p.team for p in opened.store.players(opened.league)})
    if teams > 2:
        what = f"league {opened.league} has {teams} teams, and this is between two"
        raise ConfigError((), f"{what}: `league ratings` and `league payoff` tell who is better")


def pairing(opened: Open, a: str, b: str | None) -> Pairing:
    """Find two snapshots by the names that `Open.snapshot` accepts.

    Raises UnknownName, or ConfigError, one line, if they cannot meet.
    """
    one, other = opened.snapshot(a), None if b is None else opened.snapshot(b)
    players = opened.store.players(opened.league)
    require_two_teams(opened)
    one_team = len({p.team for p in players}) == 1
    if one_team != (b is None):
        why = "has one team, in which no two meet; `league play` takes one snapshot there"
        raise ConfigError((), f"league {opened.league} {why if one_team else 'has several teams: name two snapshots'}")
    if other is not None and not can_meet(one, other, players):
        raise ConfigError(
            (), f"{one.name} ({one.roster}) and {other.name} ({other.roster}) cannot sit on two sides of league"
            f" {opened.league}'s arena: `league snapshots --format json` tells everyone's roster",
        )  # fmt: skip
    return Pairing(opened, one, other)


def exhibition(found: Pairing, episodes: int, recordings: int) -> list[Match]:
    """Play and file an exhibition, which counts for no rating; return its matches as filed.

    Sides are swapped from one episode to the next if the rosters allow it. The first `recordings` episodes are
    recorded, each in a match of its own because a match has one recording; the others count with the first match.
    """
    from league.matches.evaluator import alternating
    from storage.recordings.recording import to_bytes

    store, half = found.opened.store, -(-episodes // 2)
    order, recorded = alternating(half)[:episodes], max(1, recordings)
    evaluator = found.evaluator(2 * half, tuple(order[:recordings].tolist()))
    seats = evaluator.side_orders(found.a, found.b)
    number = len(store.matches(found.opened.league))  # part of the seed: each exhibition differs
    task = RatingMatch((found.pair,), found.seed("exhibition", number), "exhibition")
    games = evaluator.games(store, seats, task.seed)
    kept = [store.blobs.put(to_bytes(each)) for each in evaluator.recordings(games, 0, seats, task.seed)]
    matches = []
    for i in range(recorded):
        worlds = order[[i]] if i else np.concatenate([order[:1], order[recorded:]])
        seconds, recording = evaluator.seconds * len(worlds) / (2 * half), kept[i] if i < len(kept) else None
        matches.append(evaluator.match(games, seats, worlds, found.a, found.b, task, seconds, recording))
    found.keep(task, matches)
    return [m for m in store.matches(found.opened.league, "exhibition") if m.seed == task.seed]
