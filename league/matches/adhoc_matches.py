"""Ad-hoc matches, which a person requests: played in the requesting process and filed in the store like all others.

A batch is filed in one transaction under a job key that identifies its purpose, so the same games are filed once,
however often a command is killed and repeated.
"""

from collections import Counter
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
from matchmaking.ratings.scores import Score
from storage.records import ArenaKey, Match, Purpose, RankedMatch, Snapshot

if TYPE_CHECKING:
    from agents.rollout.rollout import PlayedEpisodes
    from league.matches.evaluator import MatchEvaluator


@dataclass(frozen=True)
class Pairing:
    """Snapshots of a league that can meet, one for each team; in an arena of one team, one snapshot."""

    opened: Open
    a: Snapshot
    b: Snapshot | None
    others: tuple[Snapshot, ...] = ()  # in an arena of three and more teams

    @property
    def pair(self) -> tuple[str | None, ...]:
        """Names of the snapshots; in an arena of one team the second is None."""
        return self.a.name, None if self.b is None else self.b.name, *(s.name for s in self.others)

    @property
    def players(self) -> tuple[Snapshot, ...]:
        """The snapshots."""
        return (self.a,) if self.b is None else (self.a, self.b, *self.others)

    @property
    def swaps(self) -> bool:
        """Return whether each can play every side."""
        return self.b is not None and len({s.roster for s in self.players}) == 1

    def config(self) -> Config:
        """Return the settings with which the league was last run."""
        return configuration.loads(self.opened.store.league(self.opened.league).config)

    def evaluator(self, episodes: int, recorded: tuple[int, ...] = ()) -> "MatchEvaluator":
        """Make an evaluator that plays an even number of episodes of this pair at once, or a multiple of its teams.

        It keeps the frames of the worlds in `recorded`.
        """
        from league.matches.evaluator import MatchEvaluator

        config = self.config()
        even = episodes + episodes % 2  # as settings require; three groups of an odd number leave one world unused
        config = replace(config, rating=replace(config.rating, worlds=even, pairings=1, record=bool(recorded)))
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

    def keep(self, task: RatingMatch, matches: Sequence[Match | RankedMatch]) -> bool:
        """File the matches of a task in one transaction; return False if they have been filed before."""
        key = matches[0].arena
        job = encode(self.opened.league, task, [task.purpose, *self.pair, task.seed, *key])
        return self.opened.store.file(job, matches)

    def filed(self, purpose: Purpose, key: ArenaKey) -> dict[int, Match]:
        """Return the matches of this pair with that purpose and arena, by seed."""
        log = self.opened.store.matches(self.opened.league, purpose)
        return {m.seed: m for m in log if (m.a, m.b, m.arena) == (*self.pair, key)}


def pairing(opened: Open, a: str, b: str | None = None, *others: str) -> Pairing:
    """Find snapshots by the names that `Open.snapshot` accepts, one for each team.

    Raises UnknownName, or ConfigError, one line, if they cannot meet.
    """
    found = [opened.snapshot(name) for name in (a, b, *others) if name is not None]
    players = opened.store.players(opened.league)
    rosters = {p.team: p.roster for p in players}
    if len(found) != len(rosters):
        why = f"has {len(rosters)} teams: name {len(rosters)} snapshots, not {len(found)}"
        if len(rosters) == 1:
            why = "has one team, in which no two meet; `league play` takes one snapshot there"
        elif len(found) == 1:
            why = f"has several teams: name {'two' if len(rosters) == 2 else len(rosters)} snapshots"
        raise ConfigError((), f"league {opened.league} {why}")
    if len(found) == 2:
        fit = can_meet(found[0], found[1], players)
    else:
        fit = len(found) == 1 or Counter(s.roster for s in found) == Counter(rosters.values())
    if not fit:
        named, sides = " and ".join(f"{s.name} ({s.roster})" for s in found), "two" if len(found) == 2 else len(found)
        raise ConfigError(
            (), f"{named} cannot sit on {sides} sides of league {opened.league}'s arena: `league snapshots --format"
            " json` tells everyone's roster",
        )  # fmt: skip
    return Pairing(opened, found[0], found[1] if len(found) > 1 else None, tuple(found[2:]))


def require_two_sides(opened: Open, what: str) -> None:
    """Raise ConfigError, one line, in a league whose arena has more than two teams."""
    teams = len({p.team for p in opened.store.players(opened.league)})
    if teams > 2:
        message = f"league {opened.league} has {teams} teams, and {what} is for two: `league ratings` ranks its players"
        raise ConfigError((), message)


@dataclass(frozen=True)
class Exhibition:
    """The matches of an exhibition as filed, and what is not filed."""

    matches: list[Match | RankedMatch]
    events: dict[str, dict[str, float]]  # snapshot -> event -> share of its episodes in which it happened to its team
    seconds: float  # of simulated time in an episode, mean; void ones are left out
    scores: dict[str, Score]  # of each snapshot against the others, where there are others


def exhibition(found: Pairing, episodes: int, recordings: int) -> Exhibition:
    """Play and file an exhibition, which counts for no rating.

    Sides change from one episode to the next if the rosters allow it. The first `recordings` episodes are recorded,
    each in a match of its own because a match has one recording; of one team or two the others count with the first
    match, of more teams each seating of the others is a match.
    """
    from league.matches.evaluator import alternating
    from league.matches.match_rows import scores_by_seed
    from storage.recordings.recording import to_bytes

    store, groups = found.opened.store, max(2, len(found.players))
    each = -(-episodes // groups)
    order = alternating(each, groups)[:episodes]
    evaluator = found.evaluator(groups * each, tuple(order[:recordings].tolist()))
    seats = evaluator.side_orders(*found.players)
    number = store.last_match(found.opened.league)  # part of the seed: each exhibition differs
    task = RatingMatch((found.pair,), found.seed("exhibition", number), "exhibition")
    games = evaluator.games(store, seats, task.seed)
    kept = [store.blobs.put(to_bytes(each)) for each in evaluator.recordings(games, 0, seats, task.seed)]
    matches: list[Match | RankedMatch] = []
    for worlds, recording in _parts(order, [seats[world // each] for world in order], recordings, kept):
        if len(found.players) > 2:
            matches.append(evaluator.ranked_match(games, seats[worlds[0] // each], worlds, task, recording))
        else:
            seconds = evaluator.seconds * len(worlds) / (groups * each)
            matches.append(evaluator.match(games, seats, worlds, found.a, found.b, task, seconds, recording))
    found.keep(task, matches)
    filed = [m for m in store.log(found.opened.league, "exhibition") if m.seed == task.seed]
    sound = order[~np.asarray(games.void)[order]]
    decisions = float(np.asarray(games.decisions)[sound].mean()) if len(sound) else 0.0
    events = _event_shares(games, [(world, seats[world // each]) for world in sound])
    names = [[s.name for s in seating] for seating in seats]
    scores = scores_by_seed(games, order, evaluator.starts(seats)[order], names, order // each)
    return Exhibition(filed, events, decisions * evaluator.arena.timing.decision_interval, scores)


def _event_shares(
    games: "PlayedEpisodes", seatings: Sequence[tuple[int, tuple[Snapshot, ...]]]
) -> dict[str, dict[str, float]]:
    """Return by snapshot and event the share of its episodes with it; `seatings` are worlds and who had which team."""
    seats = [(world, team, s.name) for world, seating in seatings for team, s in enumerate(seating)]
    shares: dict[str, dict[str, float]] = {name: {} for _, _, name in seats}
    for name in shares:
        worlds, teams = np.array([(world, team) for world, team, who in seats if who == name]).T
        shares[name] = {event: float(np.asarray(had)[worlds, teams].mean()) for event, had in games.events.items()}
    return shares


def _parts(
    order: np.ndarray, seatings: Sequence[tuple[Snapshot, ...]], recordings: int, kept: Sequence[str]
) -> list[tuple[np.ndarray, str | None]]:
    """Return the worlds of each match of an exhibition, and its recording."""
    if len(seatings[0]) < 3:
        recorded = max(1, recordings)
        first = np.concatenate([order[:1], order[recorded:]])
        parts = [first, *(order[[i]] for i in range(1, recorded))]
        return [(worlds, kept[i] if i < len(kept) else None) for i, worlds in enumerate(parts)]
    found: list[tuple[np.ndarray, str | None]] = [(order[[i]], kept[i] if kept else None) for i in range(recordings)]
    rest = range(recordings, len(order))
    for seating in dict.fromkeys(seatings[i] for i in rest):
        found.append((order[[i for i in rest if seatings[i] == seating]], None))
    return found
