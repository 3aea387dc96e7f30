"""Evaluation: lineups of snapshots play a batch of episodes, from recorded seeds.

A lineup has a snapshot for each team. Where rosters allow, it plays in all its cyclic rotations from the same seeds: a
pair on either side, which gives seed pairs.
"""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from agents.policy.jax_policy import PolicyStack
from agents.rollout.rollout import PlayedEpisodes, make_play, scripts_for
from arenas.arena import Arena
from league.config.experiment import Config
from league.matches.episode_recording import episode
from league.matches.masking import mask_opponents
from league.matches.match_rows import match_row, ranked_row, seed_clusters
from league.matches.time_slices import TimeSlices
from league.snapshots.codec import Policy, seat, thaw
from league.snapshots.transfer.arena_transfer import elsewhere
from league.state.jobs import RatingMatch
from league.system import batch_sizes, devices
from league.system.compiled import Compiled
from league.system.devices import used
from league.system.gpu_sharing import GpuLock, Pace
from storage.errors import StorageError
from storage.recordings.recording import Recording, to_bytes
from storage.records import ArenaKey, Match, RankedMatch, Snapshot
from storage.store import Store

Sides = tuple[Snapshot, ...]  # the snapshot that plays each team


class MatchEvaluator:
    """Compiled match of one process, of `pairings` lineups, each with as many groups of worlds as there are teams.

    In an arena of one team it has two groups.
    """

    def __init__(
        self, config: Config, arena: Arena, league: str, recorded: tuple[int, ...] | None = None,
        pace: Pace | None = None,
    ):  # fmt: skip
        """Prepare the programs of a match, which compile at their first use.

        `recorded` are the worlds to keep frames of, by default those that the settings choose. With a `pace`, batches
        are played in time slices that keep to the pace and have the GPU to themselves.
        """
        self.config, self.arena, self.league = config, arena, league
        batch = batch_sizes.batch(config.rating, jax.default_backend(), config.budget.by_rating)
        self.pairings, self.groups = batch.pairings, max(2, len(arena.teams))  # groups of worlds of each lineup
        self.each = batch.worlds // (self.groups * batch.pairings)  # episodes per group
        visible = config.rating.record and bool(arena.scene.agents)  # a game without bodies has nothing to show
        self.recorded = (self._first(config.rating.recordings) if recorded is None else recorded) if visible else ()
        self.seconds = 0.0  # of the device, for the batch played last
        self._play = Compiled(make_play(arena, self.recorded), arena) if pace is None else None
        lock = GpuLock(devices.own(jax.default_backend()))
        self._time_slices = None if pace is None else TimeSlices(arena, self.recorded, pace, lock)
        # By digest and whether the policy learnt in another arena; the most recently used policies are last.
        self._policies: OrderedDict[tuple[str, bool], list[Policy]] = OrderedDict()
        # Network shapes met so far, and scripts: they keep their place in the compiled match while nobody plays them.
        scripted = config.rating.scripts != ()
        self._shapes: dict[str, list[Policy]] = {
            agent.name: [0] if scripted and scripts_for(arena, agent.kind) else [] for agent in arena.agents
        }

    @property
    def key(self) -> ArenaKey:
        """Key of the arena under which these matches are filed."""
        return ArenaKey(self.arena.name, self.arena.config_hash, self.arena.engine.name)

    def play(self, store: Store, task: RatingMatch) -> list[Match | RankedMatch]:
        """Play the lineups, store recordings as blobs, and return complete match rows.

        If there are fewer lineups than places, they play more episodes. If there are more, because the task was made
        for another device, they play in rounds. Each match has an equal part of the device time of its round, and
        the time to which the task is booked.
        """
        rounds = [task.lineups[i : i + self.pairings] for i in range(0, len(task.lineups), self.pairings)]
        matches, seconds = [], 0.0
        for lineups in rounds:
            matches += self._round(store, replace(task, lineups=lineups))
            seconds += self.seconds
        self.seconds = seconds
        return matches

    def _round(self, store: Store, task: RatingMatch) -> list[Match | RankedMatch]:
        named = {name for lineup in task.lineups for name in lineup if name is not None}
        snapshots = {s.name: s for s in store.snapshots(self.league, brief=True, named=named)}
        room = [task.lineups[i % len(task.lineups)] for i in range(self.pairings)]
        met = [[_known(snapshots, name) for name in lineup if name is not None] for lineup in room]
        seats = [seating for lineup in met for seating in self.side_orders(*lineup)]
        games = self.games(store, seats, task.seed)
        matches: list[Match | RankedMatch] = []
        for i, lineup in enumerate(met):
            episodes = self.recordings(games, i, seats, task.seed) if task.record else []
            if len(lineup) > 2:
                matches += self.ranked_matches(store, games, i, seats, task, episodes)
                continue
            kept = store.blobs.put(to_bytes(*episodes)) if episodes else None
            a, b = (*lineup, None)[:2]
            assert a is not None
            matches.append(self.pair_match(games, i, a, b, seats, task, kept))
        return matches

    def ranked_matches(
        self, store: Store, games: PlayedEpisodes, i: int, seats: Sequence[Sides], task: RatingMatch,
        episodes: Sequence[Recording] = (),
    ) -> list[RankedMatch]:  # fmt: skip
        """Return the rows of lineup `i`, one for each of its seatings, with the recordings of that seating.

        The first row has the seed clusters of all.
        """
        found, first = [], self.groups * i
        seatings = list(dict.fromkeys(seats[first : first + self.groups]))
        for seating in seatings:
            groups = [k for k in range(first, first + self.groups) if seats[k] == seating]
            worlds = np.concatenate([np.arange(k * self.each, (k + 1) * self.each) for k in groups])
            own = [each for each in episodes if each.header.sides == tuple(s.name for s in seating)]
            kept = store.blobs.put(to_bytes(*own)) if own else None
            found.append(self.ranked_match(games, seating, worlds, task, kept))
        if (K := len(seatings)) > 1:  # groups of worlds with the same keys follow each other, see `_keys`
            blocks = (first + np.arange(self.groups // K * K)).reshape(-1, K)
            worlds = (blocks.T[:, :, None] * self.each + np.arange(self.each)).reshape(K, -1)
            names = [[s.name for s in seating] for seating in seatings]
            found[0] = replace(found[0], seed_clusters=seed_clusters(names, games, worlds))
        return found

    def ranked_match(
        self, games: PlayedEpisodes, seating: Sides, worlds: np.ndarray, task: RatingMatch, recording: str | None = None
    ) -> RankedMatch:
        """Return the row of the episodes in these worlds (n,), all of one seating of three or more teams."""
        names = [s.name for s in seating]
        seconds = self.seconds * len(worlds) / (self.pairings * self.groups * self.each)
        return ranked_row(self.league, self.key, names, games, worlds, task, seconds, recording)

    def _first(self, number: int) -> tuple[int, ...]:
        """Worlds of the first episodes of each lineup, one of each of its groups by turns."""
        order = alternating(self.each, self.groups)[:number]
        return tuple((self.groups * self.each * np.arange(self.pairings)[:, None] + order).reshape(-1).tolist())

    def recordings(self, games: PlayedEpisodes, i: int, seats: Sequence[Sides], seed: int) -> list[Recording]:
        """Convert the recorded episodes of lineup `i`, in the order of `recorded`."""
        worlds = [(k, world) for k, world in enumerate(self.recorded) if world // (self.groups * self.each) == i]
        return [
            episode(self.arena, games, k, seats[world // self.each], self.league, seed, world) for k, world in worlds
        ]

    def games(self, store: Store, seats: Sequence[Sides], seed: int) -> PlayedEpisodes:
        """Play an episode in every world; `seats` are the sides of each group of worlds. The arrays are on the host."""
        return self._played(self._stacks(store, seats), self._keys(seats, seed))

    def compile(self, store: Store) -> None:
        """Compile the match, as far as the first snapshot of one player of each team tells what will play."""
        names = {player.team: f"{player.name}@0" for player in store.players(self.league)}
        found = {s.name: s for s in store.snapshots(self.league, brief=True, named=set(names.values()))}
        lineup = [found[names[team]] for team in sorted(names) if names[team] in found]
        if len(lineup) < len(self.arena.teams):
            return
        seats = self.side_orders(*lineup) * self.pairings
        self.make_room(store, lineup)
        stacks, keys = self._stacks(store, seats), self._keys(seats, 0)
        if self._time_slices is not None:
            self._time_slices.compile(stacks, keys)
        else:
            assert self._play is not None
            self._play.ready(stacks, keys)

    def _stacks(self, store: Store, seats: Sequence[Sides]) -> dict[str, PolicyStack]:
        """Return the policies of these sides, stacked."""
        teams = [[self._load(store, seating[t]) for seating in seats] for t in range(len(self.arena.teams))]
        stacks = seat(self.arena.teams, teams, self._shapes)
        self._remember(teams)
        return stacks

    def mask_opponents_of(self, snapshot: Snapshot, seats: Sequence[Sides]) -> None:
        """Let one of these sides see its opponents as they were at the start, in all games from now on.

        Raises ConfigError if the arena does not say which numbers of its observations are the opponents'.
        """
        teams = [next(t for t, each in enumerate(seating) if each is snapshot) for seating in seats]
        frozen = mask_opponents(self.arena, teams, self.each)
        self._play = Compiled(make_play(self.arena, self.recorded, frozen=frozen), self.arena)

    def _played(self, stacks: dict[str, PolicyStack], keys: jax.Array) -> PlayedEpisodes:
        """Play compiled games and copy them to the host; `seconds` becomes the device time that they took."""
        if self._time_slices is not None:
            games, self.seconds = self._time_slices.play(stacks, keys)
            return games
        assert self._play is not None
        play = self._play.ready(stacks, keys)
        began = used(jax.default_backend())
        games = jax.device_get(play(stacks, keys))
        self.seconds = used(jax.default_backend()) - began
        return games

    def side_orders(self, *lineup: Snapshot | None) -> tuple[Sides, ...]:
        """Return the sides of each of the lineup's groups: its cyclic rotations that rosters allow, repeated in turn.

        A pair is therefore swapped in its second group, or plays twice as it is. Where no rotation fits, the snapshots
        take the first teams that they fit. Raises StorageError if the rosters are not those of the arena.
        """
        players, rosters = [s for s in lineup if s is not None], [team.roster for team in self.arena.teams]
        rotations = [(*players[i:], *players[:i]) for i in range(len(players))]
        possible = [order for order in rotations if [s.roster for s in order] == rosters] or _by_roster(
            players, rosters
        )
        if not possible:
            named = " and ".join(f"{s.name} ({s.roster})" for s in players)
            raise StorageError(f"{named} cannot play {self.arena.name}, whose sides are {', '.join(rosters)}")
        return tuple(possible[i % len(possible)] for i in range(self.groups))

    def _keys(self, seats: Sequence[Sides], seed: int) -> jax.Array:
        """Return a random key for each world; groups of a lineup in its different rotations have the same keys."""
        keys = jax.random.split(jax.random.key(seed), (len(seats), self.each))
        return keys[self._sources(seats)].reshape(-1)

    def _sources(self, seats: Sequence[Sides]) -> np.ndarray:
        """Return for each group of worlds the one whose keys it has."""
        source = []
        for first in range(0, len(seats), self.groups):
            rotations = len(set(seats[first : first + self.groups]))
            source += [first + i - i % rotations for i in range(self.groups)]
        return np.array(source)

    def starts(self, seats: Sequence[Sides]) -> np.ndarray:
        """Return a number for each world: worlds with the same one play from the same seed."""
        return (self._sources(seats)[:, None] * self.each + np.arange(self.each)).reshape(-1)

    def _load(self, store: Store, snapshot: Snapshot) -> list[Policy]:
        """Load a snapshot's policies; the most recently used ones stay in memory, as many as the settings allow."""
        key = snapshot.digest, elsewhere(snapshot, self.arena)
        if key not in self._policies:
            self._policies[key] = thaw(store, snapshot, self.arena)
            while len(self._policies) > self.config.storage.cached_policies:
                self._policies.popitem(last=False)
        self._policies.move_to_end(key)
        return self._policies[key]

    def hold(self, snapshot: Snapshot, policies: list[Policy]) -> None:
        """Let these policies play as a snapshot that is in no store."""
        self._policies[snapshot.digest, False] = policies

    def make_room(self, store: Store, snapshots: Sequence[Snapshot]) -> None:
        """Let one compiled match serve all these snapshots, whatever their networks: else each new shape compiles."""
        self._remember(
            [[self._load(store, s) for s in snapshots if s.roster == team.roster] for team in self.arena.teams]
        )

    def _remember(self, teams: Sequence[Sequence[Sequence[Policy]]]) -> None:
        """Keep a policy of every network shape that has played: the program compiled for all of them serves again."""
        for team, seated in zip(self.arena.teams, teams, strict=True):
            for i, agent in enumerate(team.agents):
                known = self._shapes[agent.name]
                for policy in (policies[i] for policies in seated):
                    if all(_shape(policy) != _shape(other) for other in known):
                        known.append(policy)

    def pair_match(
        self, games: PlayedEpisodes, i: int, a: Snapshot, b: Snapshot | None, seats: Sequence[Sides], task: RatingMatch,
        recording: str | None,
    ) -> Match:  # fmt: skip
        """Return the row of all episodes of pair `i`, with its part of the device time of the batch."""
        worlds = np.arange(self.groups * i * self.each, self.groups * (i + 1) * self.each)
        seconds = self.seconds / self.pairings
        return self.match(games, seats, worlds, a, b, task, seconds, recording, _swapped(seats, i))

    def match(
        self, games: PlayedEpisodes, seats: Sequence[Sides], worlds: np.ndarray, a: Snapshot, b: Snapshot | None,
        task: RatingMatch, seconds: float, recording: str | None = None, seed_pairs: bool = False,
    ) -> Match:  # fmt: skip
        """Return the row of the episodes in these worlds (n,), counted for A; see `match_row`."""
        at = np.array([0 if seats[world // self.each][0] is a else 1 for world in worlds])
        names = a.name, None if b is None else b.name
        return match_row(self.league, self.key, names, games, worlds, at, task, seconds, recording, seed_pairs)


def alternating(each: int, groups: int) -> np.ndarray:
    """Return the worlds (groups × each,) of groups of `each` worlds, one of each group by turns."""
    return np.arange(groups * each).reshape(groups, each).T.reshape(-1)


def _by_roster(players: Sequence[Snapshot], rosters: Sequence[str]) -> list[Sides]:
    """Return the seating in which each team has the first player left with its roster; none if there is no such."""
    left, seating = list(players), []
    for roster in rosters:
        found = next((s for s in left if s.roster == roster), None)
        if found is None:
            return []
        left.remove(found)
        seating.append(found)
    return [] if left else [tuple(seating)]


def _swapped(seats: Sequence[Sides], i: int) -> bool:
    return seats[2 * i] != seats[2 * i + 1]


def _known(snapshots: dict[str, Snapshot], name: str) -> Snapshot:
    if name not in snapshots:
        raise StorageError(f"the match names a snapshot {name!r} that the league does not have")
    return snapshots[name]


def _shape(policy: Policy) -> Any:
    """Return the part of a policy that a compiled match depends on: a network's array shapes, else only its type."""
    return {n: np.shape(x) for n, x in policy.items()} if isinstance(policy, dict) else type(policy)
