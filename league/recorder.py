"""Recordings of training: now and then an episode as it is played while players learn, with what critics make of it.

It is played beside training, in a world of its own and by dice of its own, so that whatever learns is the same with it
and without. Its policies are no snapshots: the file's header names each by its player and iteration, as a snapshot of
it would be called, while the match's row, which counts for no rating, names the newest snapshot of that player.
"""

import hashlib
import sys
import time
from collections.abc import Collection, Mapping, Sequence
from zlib import crc32

import jax
import numpy as np

from agents.bridge import unlearnt
from agents.policy import Crew
from agents.rollout import Games, make_play
from arenas.arena import Arena
from league.compiled import Compiled
from league.config.experiment import Config
from league.evaluate import tallied
from league.jobs import TrainingTurn
from league.learners import batch_of
from league.lineup import Lineup
from league.replays import episode
from league.squad import Squad
from storage.recording import to_bytes
from storage.records import ArenaKey, Match, PairCounts, Snapshot
from storage.store import Store

EVERY = 100  # learning iterations between two recordings on a CPU, unless settings say otherwise


class Recorder:
    """What one process that learns records of it; of several ranks the first one does."""

    def __init__(self, config: Config, squad: Squad):
        self.config, self.squad = config, squad
        self.matches: list[Match] = []  # of this turn, to be written with it
        visible = bool(squad.arena.scene.agents)  # a game without bodies has nothing to show
        every = config.training.record_every
        if every is None:  # what compiling it costs a GPU that trains was not measured
            every = EVERY if jax.default_backend() == "cpu" else 0
        self._every = every if visible and squad.together.rank == 0 else 0
        self._stage: tuple[Arena, Compiled] | None = None  # made when it is needed first

    def begin(self) -> None:
        """A turn begins: nothing is recorded of it."""
        self.matches = []

    def due(self, turn: TrainingTurn) -> bool:
        """Whether an episode is to be recorded after the iteration that has just ended: the first learner's count."""
        return self._every > 0 and self.squad.counters[turn.learners[0]].iteration % self._every == 0

    def record(
        self, store: Store, turn: TrainingTurn, lineup: Lineup, crews: Mapping[str, Crew], judges: Collection[str]
    ) -> float:
        """Play and keep an episode of the turn's first group of worlds; the seconds that it took.

        `crews` are who sits there, `judges` the players whose critics follow the learning. Where it fails that is told
        on standard error, once: nobody learns less for want of a recording.
        """
        began = time.monotonic()
        try:
            self.matches.append(self._recorded(store, turn, lineup, crews, judges))
        except Exception as error:
            self._every = 0
            why = " ".join(str(error).split()) or type(error).__name__
            print(
                f"league: this process records no more of training, which goes on: {why}", file=sys.stderr, flush=True
            )
        return time.monotonic() - began

    def _recorded(
        self, store: Store, turn: TrainingTurn, lineup: Lineup, crews: Mapping[str, Crew], judges: Collection[str]
    ) -> Match:
        arena, play = self._stage = self._stage or self._built()
        at = self.squad.counters[turn.learners[0]].iteration
        seed = crc32(f"{self.config.seed}/{turn.group}/{turn.dice}/recording/{turn.learners[0]}@{at}".encode())
        keys = jax.random.key(seed)[None]
        played = play.ready(crews, keys)(crews, keys)
        games = jax.device_get(played._replace(seen=None))
        seated = lineup.seated[0]
        sides = [self._shown(name, lineup) for name in seated]
        values = self._judged(
            arena, played, int(games.decisions[0]), [name if name in judges else "" for name in seated]
        )
        recording = episode(arena, games, 0, sides, self.squad.league, seed, 0, values)
        a, *b = (self._filed(name, lineup) for name in seated)
        tally = tallied(games, np.array([0]), np.array([0]))
        return Match(
            self.squad.league, ArenaKey(arena.name, arena.config_hash, arena.engine.name), a, b[0] if b else None,
            *tally.counts, tally.voids, *tally.home, PairCounts(), seed, tally.steps, "training",
            store.blobs.put(to_bytes(recording)), *tally.broke,
        )  # fmt: skip

    def _built(self) -> tuple[Arena, Compiled]:
        config = self.config
        arena = config.arena.build(engine=config.engine, worlds=1, threads=1)
        privileged = config.learner.critic_input == "privileged"
        return arena, Compiled(make_play(arena, (0,), seen=True, privileged=privileged), arena)

    def _judged(self, arena: Arena, played: Games, decisions: int, judges: Sequence[str]) -> dict[str, np.ndarray]:
        """(decisions,) What the critics of those who sit in each team made of them, by the team or the agent judged.

        `judges` has "" where there is none.
        """
        seen = jax.tree.map(lambda x: x[:decisions], played.seen)
        trajectory = unlearnt(seen, arena.teams, self.config.learner.sequence is not None)
        found: dict[str, np.ndarray] = {}
        for team, name in zip(arena.teams, judges, strict=True):
            if not name:
                continue
            learner = self.squad.learners[name]
            batch = batch_of(self.config, arena, self.squad.players[name], trajectory)
            values = [each[:, 0].float().cpu().numpy() for each in learner.values(batch)]
            own = self.config.learner.method == "ippo"
            found |= dict(zip([a.name for a in team.agents] if own else [team.name], values, strict=True))
        return found

    def _shown(self, name: str, lineup: Lineup) -> Snapshot:
        """Who sits somewhere, as a snapshot; a player as it is now, by the bytes that it would be frozen as."""
        if name in lineup.past:
            return lineup.past[name]
        player, iteration = self.squad.players[name], self.squad.counters[name].iteration
        digest = hashlib.sha256(self.squad.freeze(name)).hexdigest()
        return Snapshot(player.league, f"{name}@{iteration}", digest, player.roster, name, iteration=iteration)

    def _filed(self, name: str, lineup: Lineup) -> str:
        """The snapshot under which a match's row has who sits somewhere."""
        return name if name in lineup.past else self.squad.histories[name][-1].name
