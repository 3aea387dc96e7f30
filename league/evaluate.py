"""A rating match job: pairs of snapshots play a batch of episodes, sides swapped, from recorded seeds."""

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from agents.policy import Crew
from agents.rollout import Games, make_play, scripts_of
from arenas.arena import Arena
from league.compiled import Compiled
from league.config.experiment import Config
from league.devices import used
from league.jobs import RatingMatch
from league.policies import Policy, seat, thaw
from league.replays import episode
from storage.errors import StorageError
from storage.recording import Recording, to_bytes
from storage.records import ArenaKey, Match, PairCounts, Snapshot
from storage.store import Store

Seating = tuple[Snapshot, ...]  # who sits in each team


class Referee:
    """One process's compiled match: 2 × `pairings` groups of worlds, two for each pair of snapshots."""

    def __init__(self, config: Config, arena: Arena, league: str, recorded: tuple[int, ...] | None = None):
        """Compile for these settings; `recorded` are the worlds to keep frames of, by default as the settings say."""
        self.config, self.arena, self.league = config, arena, league
        self.pairings = config.rating.pairings
        self.each = config.rating.worlds // (2 * self.pairings)  # episodes per group
        visible = config.rating.record and bool(arena.scene.agents)  # a game without bodies has nothing to show
        self.recorded = (self._first(config.rating.recordings) if recorded is None else recorded) if visible else ()
        self.seconds = 0.0  # of the device, for the batch played last
        self._play = Compiled(make_play(arena, self.recorded), arena)
        self._policies: OrderedDict[str, list[Policy]] = OrderedDict()  # by digest, those used last at the end
        # What keeps its place in the compiled match though it sits nowhere now: network shapes met, and scripts.
        scripted = config.rating.scripts != ()
        self._shapes: dict[str, list[Policy]] = {
            agent.name: [0] if scripted and scripts_of(arena, agent.kind) else [] for agent in arena.agents
        }

    @property
    def key(self) -> ArenaKey:
        """What these matches are filed under."""
        return ArenaKey(self.arena.name, self.arena.config_hash, self.arena.engine.name)

    def play(self, store: Store, task: RatingMatch) -> list[Match]:
        """Play the pairs and put recordings into the blobs. Pairs fewer than places play more episodes."""
        snapshots = {s.name: s for s in store.snapshots(self.league)}
        room = [task.pairs[i % len(task.pairs)] for i in range(self.pairings)]
        met = [(_known(snapshots, a), None if b is None else _known(snapshots, b)) for a, b in room]
        seats = [seating for a, b in met for seating in self.seatings(a, b)]
        games = self.games(store, seats, task.seed)
        matches = []
        for i, (a, b) in enumerate(met):
            episodes = self._episodes(games, i, seats, task.seed) if task.record else []
            kept = store.blobs.put(to_bytes(*episodes)) if episodes else None
            matches.append(self._count(games, i, a, b, seats, task, kept))
        return matches

    def _first(self, number: int) -> tuple[int, ...]:
        """The first episodes of each pairing, one of each of its two groups by turns."""
        order = np.arange(2 * self.each).reshape(2, self.each).T.reshape(-1)[:number]
        return tuple((2 * self.each * np.arange(self.pairings)[:, None] + order).reshape(-1).tolist())

    def _episodes(self, games: Games, i: int, seats: Sequence[Seating], seed: int) -> list[Recording]:
        """What was recorded of pair `i`."""
        worlds = [(k, world) for k, world in enumerate(self.recorded) if world // (2 * self.each) == i]
        return [
            episode(self.arena, games, k, seats[world // self.each], self.league, seed, world) for k, world in worlds
        ]

    def games(self, store: Store, seats: Sequence[Seating], seed: int) -> Games:
        """An episode in every world, by who sits in which team of each group of worlds; as the host has them."""
        teams = [[self._thawed(store, seating[t]) for seating in seats] for t in range(len(self.arena.teams))]
        crews = seat(self.arena.teams, teams, self._shapes)
        self._remember(teams)
        return self._played(crews, self._keys(seats, seed))

    def _played(self, crews: dict[str, Crew], keys: jax.Array) -> Games:
        """The games, on the host; notes how much of the device they took."""
        play = self._play.ready(crews, keys)
        began = used(jax.default_backend())
        games = jax.device_get(play(crews, keys))
        self.seconds = used(jax.default_backend()) - began
        return games

    def seatings(self, a: Snapshot, b: Snapshot | None) -> tuple[Seating, Seating]:
        """Who sits where in the pair's two groups: sides swapped if both rosters allow it, else twice the same."""
        rosters = tuple(team.roster for team in self.arena.teams)
        orders: list[Seating] = [(a,)] if b is None else [(a, b), (b, a)]
        possible = [order for order in orders if tuple(s.roster for s in order) == rosters]
        if not possible:
            with_whom = "" if b is None else f" and {b.name} ({b.roster})"
            raise StorageError(
                f"{a.name} ({a.roster}){with_whom} cannot play {self.arena.name}, whose sides are {', '.join(rosters)}"
            )
        return possible[0], possible[-1]

    def _keys(self, seats: Sequence[Seating], seed: int) -> jax.Array:
        """A key per world; where a pair swaps sides, its second group repeats the first one's keys."""
        keys = jax.random.split(jax.random.key(seed), (len(seats), self.each))
        source = [k - 1 if k % 2 and _swapped(seats, k // 2) else k for k in range(len(seats))]
        return keys[np.array(source)].reshape(-1)

    def _thawed(self, store: Store, snapshot: Snapshot) -> list[Policy]:
        """A snapshot's policies; those used last stay in memory, as many as the settings allow."""
        if snapshot.digest not in self._policies:
            self._policies[snapshot.digest] = thaw(store, snapshot, self.arena)
            while len(self._policies) > self.config.storage.policies:
                self._policies.popitem(last=False)
        self._policies.move_to_end(snapshot.digest)
        return self._policies[snapshot.digest]

    def _remember(self, teams: Sequence[Sequence[Sequence[Policy]]]) -> None:
        """Keep a policy of every network shape that sat anywhere: what was compiled for all of them serves again."""
        for team, seated in zip(self.arena.teams, teams, strict=True):
            for i, agent in enumerate(team.agents):
                known = self._shapes[agent.name]
                for policy in (policies[i] for policies in seated):
                    if all(_shape(policy) != _shape(other) for other in known):
                        known.append(policy)

    def _count(
        self, games: Games, i: int, a: Snapshot, b: Snapshot | None, seats: Sequence[Seating], task: RatingMatch,
        recording: str | None,
    ) -> Match:  # fmt: skip
        """Pair `i` as a match row, counted for A."""
        at = [0 if seats[k][0] is a else 1 for k in (2 * i, 2 * i + 1)]
        worlds = np.arange(2 * i * self.each, (2 * i + 2) * self.each)
        tally = tallied(games, worlds, np.repeat(at, self.each))
        pairs = PairCounts()
        if _swapped(seats, i):
            both = tally.valid.reshape(2, -1).all(0)
            points = tally.results.reshape(2, -1).sum(0)[both]  # -2, -1, 0, 1, 2
            pairs = PairCounts(*(int((points == p).sum()) for p in (-2, -1, 0, 1, 2)))
        return Match(
            self.league, self.key, a.name, None if b is None else b.name, *tally.counts, tally.voids, *tally.home,
            pairs, task.seed, tally.steps, task.purpose, recording, *tally.broke,
        )  # fmt: skip


class Tally(NamedTuple):
    """How some episodes ended for A. In an arena of one team a win is a success."""

    results: np.ndarray  # (n,) 1, 0, -1
    valid: np.ndarray  # (n,) whether physics stayed sound
    counts: tuple[int, int, int]  # wins, draws, losses of the valid ones
    home: tuple[int, int, int]  # the same where A played team 0
    voids: int
    broke: tuple[int, int]  # void ones in which only A's robots went bad, only B's
    steps: int


def tallied(games: Games, worlds: np.ndarray, at: np.ndarray) -> Tally:
    """Count the episodes of these worlds (n,) for A, who sat in team `at` (n,) of each."""
    score, valid = np.asarray(games.score)[worlds], ~np.asarray(games.void)[worlds]
    each, culprits = np.arange(len(worlds)), np.asarray(games.culprits)[worlds]
    alone = (~valid & (culprits.sum(1) == 1))[:, None] & culprits
    if score.shape[1] == 1:
        results, broke = np.sign(score[:, 0] - 0.5).astype(int), (int(alone.sum()), 0)
    else:
        results = np.sign(score[each, at] - score[each, 1 - at]).astype(int)
        broke = int(alone[each, at].sum()), int(alone[each, 1 - at].sum())

    def counted(which: np.ndarray) -> tuple[int, int, int]:
        wins, draws, losses = (int((which & (results == r)).sum()) for r in (1, 0, -1))
        return wins, draws, losses

    counts, home = counted(valid), counted(valid & (at == 0))
    return Tally(results, valid, counts, home, int((~valid).sum()), broke, int(games.decisions[worlds].sum()))


def _swapped(seats: Sequence[Seating], i: int) -> bool:
    return seats[2 * i] != seats[2 * i + 1]


def _known(snapshots: dict[str, Snapshot], name: str) -> Snapshot:
    if name not in snapshots:
        raise StorageError(f"the match names a snapshot {name!r} that the league does not have")
    return snapshots[name]


def _shape(policy: Policy) -> Any:
    """What a compiled match depends on: the shapes of a network; of a script, that it is one."""
    return None if isinstance(policy, int) else {name: np.shape(array) for name, array in policy.items()}
