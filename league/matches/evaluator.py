"""Evaluation: pairs of snapshots play a batch of episodes with swapped sides, from recorded seeds."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np

from agents.policy.jax_policy import PolicyStack
from agents.rollout.rollout import PlayedEpisodes, make_play, scripts_for
from arenas.arena import Arena
from league.config.experiment import Config
from league.matches.episode_recording import episode
from league.matches.masking import mask_opponents
from league.matches.time_slices import TimeSlices
from league.snapshots.arena_transfer import elsewhere
from league.snapshots.codec import Policy, seat, thaw
from league.state.jobs import RatingMatch
from league.system import batch_sizes, devices
from league.system.compiled import Compiled
from league.system.devices import used
from league.system.gpu_sharing import GpuLock, Pace
from storage.errors import StorageError
from storage.recordings.recording import Recording, to_bytes
from storage.records import ArenaKey, Match, PairCounts, Snapshot
from storage.store import Store

Sides = tuple[Snapshot, ...]  # the snapshot that plays each team


class MatchEvaluator:
    """Compiled match of one process: 2 × `pairings` groups of worlds, two for each pair of snapshots."""

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
        self.pairings, self.each = batch.pairings, batch.worlds // (2 * batch.pairings)  # episodes per group
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

    def play(self, store: Store, task: RatingMatch) -> list[Match]:
        """Play the pairs, store recordings as blobs, and return complete match rows.

        If there are fewer pairs than places, pairs play more episodes. If there are more, because the task was made for
        another device, they play in rounds. Each match has an equal part of the device time of its round, and the time
        to which the task is booked.
        """
        rounds = [task.pairs[i : i + self.pairings] for i in range(0, len(task.pairs), self.pairings)]
        matches, seconds = [], 0.0
        for pairs in rounds:
            matches += self._round(store, replace(task, pairs=pairs))
            seconds += self.seconds
        self.seconds = seconds
        return matches

    def _round(self, store: Store, task: RatingMatch) -> list[Match]:
        snapshots = {s.name: s for s in store.snapshots(self.league, brief=True)}
        room = [task.pairs[i % len(task.pairs)] for i in range(self.pairings)]
        met = [(_known(snapshots, a), None if b is None else _known(snapshots, b)) for a, b in room]
        seats = [seating for a, b in met for seating in self.side_orders(a, b)]
        games = self.games(store, seats, task.seed)
        matches = []
        for i, (a, b) in enumerate(met):
            episodes = self.recordings(games, i, seats, task.seed) if task.record else []
            kept = store.blobs.put(to_bytes(*episodes)) if episodes else None
            matches.append(self.pair_match(games, i, a, b, seats, task, kept))
        return matches

    def _first(self, number: int) -> tuple[int, ...]:
        """Worlds of the first episodes of each pairing, one of each of its two groups by turns."""
        order = alternating(self.each)[:number]
        return tuple((2 * self.each * np.arange(self.pairings)[:, None] + order).reshape(-1).tolist())

    def recordings(self, games: PlayedEpisodes, i: int, seats: Sequence[Sides], seed: int) -> list[Recording]:
        """Convert the recorded episodes of pair `i`, in the order of `recorded`."""
        worlds = [(k, world) for k, world in enumerate(self.recorded) if world // (2 * self.each) == i]
        return [
            episode(self.arena, games, k, seats[world // self.each], self.league, seed, world) for k, world in worlds
        ]

    def games(self, store: Store, seats: Sequence[Sides], seed: int) -> PlayedEpisodes:
        """Play an episode in every world; `seats` are the sides of each group of worlds. The arrays are on the host."""
        teams = [[self._load(store, seating[t]) for seating in seats] for t in range(len(self.arena.teams))]
        stacks = seat(self.arena.teams, teams, self._shapes)
        self._remember(teams)
        return self._played(stacks, self._keys(seats, seed))

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

    def side_orders(self, a: Snapshot, b: Snapshot | None) -> tuple[Sides, Sides]:
        """Return the sides of the pair's two groups: swapped if both rosters allow it, otherwise twice the same.

        Raises StorageError if the rosters are not those of the arena.
        """
        rosters = tuple(team.roster for team in self.arena.teams)
        orders: list[Sides] = [(a,)] if b is None else [(a, b), (b, a)]
        possible = [order for order in orders if tuple(s.roster for s in order) == rosters]
        if not possible:
            other = "" if b is None else f" and {b.name} ({b.roster})"
            raise StorageError(
                f"{a.name} ({a.roster}){other} cannot play {self.arena.name}, whose sides are {', '.join(rosters)}"
            )
        return possible[0], possible[-1]

    def _keys(self, seats: Sequence[Sides], seed: int) -> jax.Array:
        """Return a random key for each world; if a pair swaps sides, its second group repeats the keys of its first."""
        keys = jax.random.split(jax.random.key(seed), (len(seats), self.each))
        source = [k - 1 if k % 2 and _swapped(seats, k // 2) else k for k in range(len(seats))]
        return keys[np.array(source)].reshape(-1)

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
        worlds = np.arange(2 * i * self.each, (2 * i + 2) * self.each)
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


def match_row(
    league: str, key: ArenaKey, names: tuple[str, str | None],
    games: PlayedEpisodes, worlds: np.ndarray, at: np.ndarray,
    task: RatingMatch, seconds: float = 0.0, recording: str | None = None, seed_pairs: bool = False,
) -> Match:  # fmt: skip
    """Return the complete row of a match. No other function builds one from played episodes.

    Args:
        league: the league's name.
        key: the arena under which the match counts.
        names: the snapshots A and B; no B in an arena of one team.
        games: the played episodes.
        worlds: (n,) worlds whose episodes belong to the match.
        at: (n,) the team of A in each of these worlds.
        task: the task of the match, which has its seed, its purpose and the time to which it is booked.
        seconds: device time of the match.
        recording: digest of its recording.
        seed_pairs: whether the second half of `worlds` repeats the first half's seeds with swapped sides.
    """
    tally, pairs = tallied(games, worlds, at), PairCounts()
    if seed_pairs:
        both = tally.valid.reshape(2, -1).all(0)
        points = tally.results.reshape(2, -1).sum(0)[both]  # -2, -1, 0, 1, 2
        pairs = PairCounts(*(int((points == p).sum()) for p in (-2, -1, 0, 1, 2)))
    return Match(
        league, key, *names, *tally.counts, tally.voids, *tally.home, pairs, task.seed, tally.steps, task.purpose,
        recording, *tally.broke, seconds=seconds, due=task.due, causes=tally.causes,
    )  # fmt: skip


def alternating(each: int) -> np.ndarray:
    """(2 each,) Worlds of two groups of `each` worlds, one of each group by turns."""
    return np.arange(2 * each).reshape(2, each).T.reshape(-1)


class Tally(NamedTuple):
    """Results of some episodes for A. In an arena of one team a win is a success."""

    results: np.ndarray  # (n,) 1, 0, -1
    valid: np.ndarray  # (n,) whether the episode is not void
    counts: tuple[int, int, int]  # wins, draws, losses of the valid ones
    home: tuple[int, int, int]  # the same, only episodes in which A played team 0
    voids: int
    broke: tuple[int, int]  # void episodes in which only A's robots were at fault, only B's
    steps: int
    causes: int = 0  # bits of arenas.physics.void_causes that occurred in any void episode


def tallied(games: PlayedEpisodes, worlds: np.ndarray, at: np.ndarray) -> Tally:
    """Count the episodes of these worlds (n,) for A, which played team `at` (n,) of each."""
    score, valid = np.asarray(games.score)[worlds], ~np.asarray(games.void)[worlds]
    each, at_fault = np.arange(len(worlds)), np.asarray(games.at_fault)[worlds]
    alone = (~valid & (at_fault.sum(1) == 1))[:, None] & at_fault
    if score.shape[1] == 1:
        results, broke = np.sign(score[:, 0] - 0.5).astype(int), (int(alone.sum()), 0)
    else:
        results = np.sign(score[each, at] - score[each, 1 - at]).astype(int)
        broke = int(alone[each, at].sum()), int(alone[each, 1 - at].sum())

    def counted(which: np.ndarray) -> tuple[int, int, int]:
        wins, draws, losses = (int((which & (results == r)).sum()) for r in (1, 0, -1))
        return wins, draws, losses

    counts, home = counted(valid), counted(valid & (at == 0))
    causes = 0 if games.causes is None else int(np.bitwise_or.reduce(np.asarray(games.causes)[worlds][~valid]))
    return Tally(results, valid, counts, home, int((~valid).sum()), broke, int(games.decisions[worlds].sum()), causes)


def _swapped(seats: Sequence[Sides], i: int) -> bool:
    return seats[2 * i] != seats[2 * i + 1]


def _known(snapshots: dict[str, Snapshot], name: str) -> Snapshot:
    if name not in snapshots:
        raise StorageError(f"the match names a snapshot {name!r} that the league does not have")
    return snapshots[name]


def _shape(policy: Policy) -> Any:
    """Return the part of a policy that a compiled match depends on: a network's array shapes, else only its type."""
    return {n: np.shape(x) for n, x in policy.items()} if isinstance(policy, dict) else type(policy)
