"""Matches that a person asks for: played in the process that asks, and filed in the store like any other.

A batch is filed in one transaction under a job's key that says what it was for, so the same games are filed once,
however often a command is killed and given again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np

from league.config import experiment as configuration
from league.config.experiment import Config
from league.config.schema import ConfigError
from league.jobs import RatingMatch, encode
from league.measures import can_meet
from league.query import Open
from storage.records import ArenaKey, Match, PairCounts, Purpose, Snapshot

if TYPE_CHECKING:
    from league.evaluate import Referee


@dataclass(frozen=True)
class Bout:
    """Two snapshots of a league that can meet; in an arena of one team there is no second one."""

    opened: Open
    a: Snapshot
    b: Snapshot | None

    @property
    def pair(self) -> tuple[str, str | None]:
        """Their names."""
        return self.a.name, None if self.b is None else self.b.name

    @property
    def swaps(self) -> bool:
        """Whether each can play either side."""
        return self.b is not None and self.a.roster == self.b.roster

    def config(self) -> Config:
        """The settings with which the league was last run."""
        return configuration.loads(self.opened.store.league(self.opened.league).config)

    def referee(self, episodes: int, recorded: tuple[int, ...] = ()) -> "Referee":
        """Who plays an even number of episodes of this pair at once, and keeps frames of the `recorded` ones."""
        from league.evaluate import Referee

        config = self.config()
        config = replace(config, rating=replace(config.rating, worlds=episodes, pairings=1, record=bool(recorded)))
        arena = config.arena.build(engine=config.engine, worlds=episodes, threads=config.workers.threads)
        return Referee(config, arena, self.opened.league, recorded)

    def seed(self, *about: object) -> int:
        """The dice of a batch that is `about` this."""
        return crc32("/".join(map(str, (self.opened.setting("seed", otherwise=1), *self.pair, *about))).encode())

    def file(self, referee: "Referee", purpose: Purpose, seed: int) -> bool:
        """Play a batch and file it as one match; False where the same one has been filed meanwhile."""
        task = RatingMatch((self.pair,), seed, purpose, record=False)
        (found,) = referee.play(self.opened.store, task)
        return self.keep(task, [replace(found, seconds=referee.seconds)])

    def keep(self, task: RatingMatch, matches: Sequence[Match]) -> bool:
        """File the matches that a task gave."""
        key = matches[0].arena
        job = encode(self.opened.league, task, [task.purpose, *self.pair, task.seed, *key])
        return self.opened.store.file(job, matches)

    def filed(self, purpose: Purpose, key: ArenaKey) -> dict[int, Match]:
        """What this pair has played for that purpose under a key, by seed."""
        log = self.opened.store.matches(self.opened.league, purpose)
        return {m.seed: m for m in log if (m.a, m.b, m.arena) == (*self.pair, key)}


def bout(opened: Open, a: str, b: str | None) -> Bout:
    """Two snapshots, as `Open.snapshot` names them.

    Raises UnknownName, or ConfigError, one line, where they cannot meet.
    """
    one, other = opened.snapshot(a), None if b is None else opened.snapshot(b)
    players = opened.store.players(opened.league)
    one_team = len({p.team for p in players}) == 1
    if one_team != (b is None):
        why = "has one team, in which no two meet; `league play` takes one snapshot there"
        raise ConfigError((), f"league {opened.league} {why if one_team else 'has several teams: name two snapshots'}")
    if other is not None and not can_meet(one, other, players):
        raise ConfigError(
            (), f"{one.name} ({one.roster}) and {other.name} ({other.roster}) cannot sit on two sides of league"
            f" {opened.league}'s arena: `league snapshots --format json` tells everyone's roster",
        )  # fmt: skip
    return Bout(opened, one, other)


def exhibition(found: Bout, episodes: int, recordings: int) -> list[Match]:
    """Play an exhibition and file it: it is recorded and counts for no rating. Its matches, as filed.

    Sides are swapped from one episode to the next where rosters allow. The first episodes are recorded, each in a match
    of its own, for a match has one recording; those that are not are counted with the first one.
    """
    from league.evaluate import tallied
    from league.replays import episode
    from storage.recording import to_bytes

    store, half = found.opened.store, -(-episodes // 2)
    order = np.arange(2 * half).reshape(2, half).T.reshape(-1)[:episodes]  # one on either side, by turns
    referee = found.referee(2 * half, tuple(order[:recordings].tolist()))
    seats = referee.seatings(found.a, found.b)
    number = len(store.matches(found.opened.league))  # so that another exhibition is another
    task = RatingMatch((found.pair,), found.seed("exhibition", number), "exhibition")
    games = referee.games(store, seats, task.seed)
    matches = []
    for i in range(max(1, recordings)):
        worlds = order[[i]] if i else np.concatenate([order[:1], order[max(1, recordings) :]])
        at = np.array([0 if seats[world // half][0] is found.a else 1 for world in worlds])
        tally, kept = tallied(games, worlds, at), None
        if i < len(referee.recorded):
            world = referee.recorded[i]
            recording = episode(referee.arena, games, i, seats[world // half], found.opened.league, task.seed, world)
            kept = store.blobs.put(to_bytes(recording))
        matches.append(Match(
            found.opened.league, referee.key, *found.pair, *tally.counts, tally.voids, *tally.home, PairCounts(),
            task.seed, tally.steps, task.purpose, kept, *tally.broke,
        ))  # fmt: skip
    found.keep(task, matches)
    return [m for m in store.matches(found.opened.league, "exhibition") if m.seed == task.seed]
