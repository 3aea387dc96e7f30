"""A rating match job: pairs of snapshots play a batch of episodes, sides swapped, from recorded seeds."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from agents.rollout import Games, make_play
from arenas.arena import Arena
from league.config import Config
from league.policies import seat, thaw
from league.versions import versions
from storage.recording import Recording, RecordingHeader, to_bytes
from storage.records import ArenaKey, Match, PairCounts, Snapshot
from storage.store import Store


class Referee:
    """One process's compiled match: 2 × `pairings` groups of worlds, two for each pair of snapshots."""

    def __init__(self, config: Config, arena: Arena, league: str):
        self.config, self.arena, self.league = config, arena, league
        self.pairings = config.rating.pairings
        self.each = config.rating.worlds // (2 * self.pairings)  # episodes per group
        self.recorded = tuple(range(0, config.rating.worlds, 2 * self.each)) if config.rating.record else ()
        self._play = make_play(arena, self.recorded)
        self._policies: dict[str, list] = {}

    @property
    def key(self) -> ArenaKey:
        """What these matches are filed under."""
        return ArenaKey(self.arena.name, self.arena.config_hash, self.arena.engine.name)

    def play(self, store: Store, pairs: Sequence[tuple[str, str]], seed: int) -> list[Match]:
        """Play the pairs and put recordings into the blobs. Pairs fewer than places play more episodes."""
        snapshots = {s.digest: s for s in store.snapshots(self.league)}
        room = [pairs[i % len(pairs)] for i in range(self.pairings)]
        seats = [seating for a, b in room for seating in self._seatings(snapshots[a], snapshots[b])]
        teams = [[self._thawed(store, seating[t]) for seating in seats] for t in range(2)]
        games = jax.device_get(self._play(seat(self.arena.teams, teams), self._keys(seats, seed)))
        matches = []
        for i, (a, b) in enumerate(room):
            recording = self._record(store, games, i, seats[2 * i], seed) if self.recorded else None
            matches.append(self._count(games, i, snapshots[a], snapshots[b], seats, seed, recording))
        return matches

    def _seatings(self, a: Snapshot, b: Snapshot) -> list[tuple[Snapshot, Snapshot]]:
        """Who sits where in the pair's two groups: sides swapped if both rosters allow it, else twice the same."""
        home, away = (team.roster for team in self.arena.teams)
        possible = [(x, y) for x, y in ((a, b), (b, a)) if x.roster == home and y.roster == away]
        if not possible:
            raise ValueError(f"{a.name} ({a.roster}) and {b.name} ({b.roster}) cannot meet in {self.arena.name}")
        return [possible[0], possible[-1]]

    def _keys(self, seats: Sequence[tuple[Snapshot, Snapshot]], seed: int) -> jax.Array:
        """A key per world; where a pair swaps sides, its second group repeats the first one's keys."""
        keys = jax.random.split(jax.random.key(seed), (len(seats), self.each))
        source = [k - 1 if k % 2 and _swapped(seats, k // 2) else k for k in range(len(seats))]
        return keys[np.array(source)].reshape(-1)

    def _thawed(self, store: Store, snapshot: Snapshot) -> list:
        if snapshot.digest not in self._policies:
            self._policies[snapshot.digest] = thaw(store, snapshot, self.arena)
        return self._policies[snapshot.digest]

    def _count(
        self, games: Games, i: int, a: Snapshot, b: Snapshot, seats: Sequence[tuple[Snapshot, Snapshot]], seed: int,
        recording: str | None,
    ) -> Match:  # fmt: skip
        """Pair `i` as a match row, counted for A."""
        results, valid = [], []  # of the two groups: A's wins minus losses, (each,)
        for k in (2 * i, 2 * i + 1):
            worlds = slice(k * self.each, (k + 1) * self.each)
            gap = games.score[worlds, 0] - games.score[worlds, 1]
            results.append(np.sign(gap if seats[k][0] == a else -gap))
            valid.append(~games.void[worlds])
        at_home = [valid[j] & (seats[2 * i + j][0] == a) for j in range(2)]
        result, home = np.concatenate(results), np.concatenate(at_home)
        ok = np.concatenate(valid)
        pairs = PairCounts()
        if _swapped(seats, i):
            both = valid[0] & valid[1]
            points = (results[0] + results[1])[both]  # -2, -1, 0, 1, 2
            pairs = PairCounts(*(int((points == p).sum()) for p in (-2, -1, 0, 1, 2)))
        wins, draws, losses = (int((ok & (result == r)).sum()) for r in (1, 0, -1))
        side_wins, side_draws, side_losses = (int((home & (result == r)).sum()) for r in (1, 0, -1))
        steps = int(games.decisions[2 * i * self.each : (2 * i + 2) * self.each].sum())
        return Match(
            self.league, self.key, a.digest, b.digest, wins, draws, losses, int((~ok).sum()),
            side_wins, side_draws, side_losses, pairs, seed, steps,
            recording=recording,
        )  # fmt: skip

    def _record(self, store: Store, games: Games, i: int, sides: tuple[Snapshot, Snapshot], seed: int) -> str:
        """Put the pair's first episode into the blobs, frame by frame to its end."""
        world, arena, hold = self.recorded[i], self.arena, self.arena.timing.hold
        decisions = int(games.decisions[world])
        frames = jax.tree.map(lambda x: x[:decisions, :, i].reshape(decisions * hold, *x.shape[3:]), games.frames)
        score = games.score[world]
        void = bool(games.void[world])
        names = [team.name for team in arena.teams]
        first = int(np.argmax(score))
        outcome = "void" if void else "draw" if score[0] == score[1] else f"{sides[first].name} wins as {names[first]}"
        rewards = np.zeros((decisions * hold, len(names)))
        rewards[hold - 1 :: hold] = games.reward[:decisions, i]
        header = RecordingHeader(
            self.league, 0, seed, world, self.key, tuple(s.name for s in sides), tuple(s.digest for s in sides),
            tuple(names), tuple(tuple(a.name for a in team.agents) for team in arena.teams),
            tuple(float(s) for s in score), outcome, arena.timing.control_interval, arena.marker_kinds, versions(),
        )  # fmt: skip
        scores = np.zeros_like(rewards)
        scores[-1] = score
        recording = Recording(
            header, arena.scene.xml, frames.time, frames.qpos,
            {name: np.repeat(a[:decisions, i], hold, axis=0) for name, a in games.actions.items()},
            rewards, scores, frames.markers, [(decisions * hold - 1, outcome)],
        )  # fmt: skip
        return store.blobs.put(to_bytes(recording))


def _swapped(seats: Sequence[tuple[Snapshot, Snapshot]], i: int) -> bool:
    return seats[2 * i] != seats[2 * i + 1]


def pairs_of(payload: Any) -> list[tuple[str, str]]:
    """The pairs in a match job's payload."""
    return [(a, b) for a, b in payload["pairs"]]
