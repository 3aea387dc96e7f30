"""Recordings of training: at intervals, an episode of the present policies with the values of their critics.

The episode is played beside training, in a world and with random numbers of its own, so recording does not change
learning. Its policies are not snapshots. The file's header names each by its player and iteration, like a snapshot of
it; the match's row, which counts for no rating, names the player's newest snapshot.
"""

import hashlib
import sys
import time
from collections.abc import Collection, Mapping, Sequence
from zlib import crc32

import jax
import numpy as np

from agents.bridge import evaluation_trajectory
from agents.learner.happo import HappoLearner
from agents.policy.jax_policy import PolicyStack
from agents.rollout.rollout import PlayedEpisodes, make_play
from arenas.arena import Arena
from league.config.experiment import Config
from league.matches.episode_recording import episode
from league.matches.match_rows import match_row, ranked_row
from league.state.jobs import RatingMatch, TrainingTurn
from league.state.team_exchange import as_made
from league.system.compiled import Compiled
from league.training.learner_factory import batch_of
from league.training.learner_pool import LearnerPool
from league.training.matchups import Matchups
from storage.recordings.recording import to_bytes
from storage.records import ArenaKey, Match, RankedMatch, Snapshot
from storage.store import Store

EVERY = 100  # learning iterations between two recordings on a CPU, unless settings say otherwise


class TrainingRecorder:
    """Recorder of one training process; of several ranks, only rank 0 records."""

    def __init__(self, config: Config, pool: LearnerPool):
        self.config, self.pool = config, pool
        self.matches: list[Match | RankedMatch] = []  # of this turn, to be written with it
        visible = bool(pool.arena.scene.agents)  # a game without bodies has nothing to show
        every = config.training.record_every
        if every is None:  # the cost of compiling it on a GPU that trains was not measured
            every = EVERY if jax.default_backend() == "cpu" else 0
        self._every = every if visible and pool.comm.rank == 0 else 0
        self._stage: tuple[Arena, Compiled] | None = None  # built at its first use

    def begin(self) -> None:
        """Forget the matches of the previous turn."""
        self.matches = []

    def due(self, turn: TrainingTurn) -> bool:
        """Return whether to record an episode after the iteration that has just ended, by the first learner's count."""
        return self._every > 0 and self.pool.counters[turn.learners[0]].iteration % self._every == 0

    def record(
        self,
        store: Store,
        turn: TrainingTurn,
        matchups: Matchups,
        stacks: Mapping[str, PolicyStack],
        judges: Collection[str],
    ) -> float:
        """Play and keep an episode of the turn's first group of worlds; return the seconds that it took.

        `stacks` are the policies of that group, `judges` the players whose critics learn in the turn. A failure is
        reported on standard error, once, and ends recording: training continues without it.
        """
        began = time.monotonic()
        try:
            self.matches.append(self._recorded(store, turn, matchups, stacks, judges))
        except Exception as error:
            self._every = 0
            why = " ".join(str(error).split()) or type(error).__name__
            print(f"league: this process stops recording training, which continues: {why}", file=sys.stderr, flush=True)
        return time.monotonic() - began

    def _recorded(
        self,
        store: Store,
        turn: TrainingTurn,
        matchups: Matchups,
        stacks: Mapping[str, PolicyStack],
        judges: Collection[str],
    ) -> Match | RankedMatch:
        arena, play = self._stage = self._stage or self._built()
        at = self.pool.counters[turn.learners[0]].iteration
        seed = crc32(f"{self.config.seed}/{turn.group}/{turn.retry}/recording/{turn.learners[0]}@{at}".encode())
        keys = jax.random.key(seed)[None]
        played = play.ready(stacks, keys)(stacks, keys)
        games = jax.device_get(played._replace(seen=None))
        assigned = matchups.assigned[0]
        sides = [self._shown(name, matchups) for name in assigned]
        values = self._judged(
            arena, played, int(games.decisions[0]), [name if name in judges else "" for name in assigned]
        )
        recording = episode(arena, games, 0, sides, self.pool.league, seed, 0, values)
        a, *others = (self._filed(name, matchups) for name in assigned)
        league, key = self.pool.league, ArenaKey(arena.name, arena.config_hash, arena.engine.name)
        kept, only = store.blobs.put(to_bytes(recording)), np.array([0])
        if len(others) > 1:
            task = RatingMatch(((a, *others),), seed, "training")
            return ranked_row(league, key, (a, *others), games, only, task, recording=kept)
        names = a, others[0] if others else None
        return match_row(league, key, names, games, only, only, RatingMatch((names,), seed, "training"), recording=kept)

    def _built(self) -> tuple[Arena, Compiled]:
        config = self.config
        arena = as_made(
            config.arena.build(engine=config.engine, worlds=1, threads=1, **config.buffers.where()),
            list(self.pool.players.values()),
        )
        privileged = config.learner.critic_input == "privileged"
        return arena, Compiled(make_play(arena, (0,), seen=True, privileged=privileged), arena)

    def _judged(
        self, arena: Arena, played: PlayedEpisodes, decisions: int, judges: Sequence[str]
    ) -> dict[str, np.ndarray]:
        """(decisions,) Values by the critics of the players in `judges`, by the team or agent that they are of.

        `judges` has a player for each team, "" for a team without values. What follows the episode is judged too, and
        cut off then: inputs of its length would be compiled for each length anew, and JAX forgets no program.
        """
        assert played.seen is not None
        trajectory = evaluation_trajectory(played.seen, arena.teams, self.config.learner.sequence is not None)
        found: dict[str, np.ndarray] = {}
        for team, name in zip(arena.teams, judges, strict=True):
            if not name:
                continue
            learner = self.pool.learners[name]
            if not isinstance(learner, HappoLearner):
                continue
            batch = batch_of(self.config, arena, self.pool.players[name], trajectory)
            values = [each[:decisions, 0].float().cpu().numpy() for each in learner.values(batch)]
            own = self.config.learner.method == "ippo"
            found |= dict(zip([a.name for a in team.agents] if own else [team.name], values, strict=True))
        return found

    def _shown(self, name: str, matchups: Matchups) -> Snapshot:
        """Return the snapshot of a name in the matchups; for a player, one with the digest of its present actors."""
        if name in matchups.past:
            return matchups.past[name]
        player, iteration = self.pool.players[name], self.pool.counters[name].iteration
        digest = hashlib.sha256(self.pool.freeze(name)).hexdigest()
        return Snapshot(player.league, f"{name}@{iteration}", digest, player.roster, name, iteration=iteration)

    def _filed(self, name: str, matchups: Matchups) -> str:
        """Return the name for a match's row: a past snapshot's own, or that of the player's newest snapshot."""
        return name if name in matchups.past else self.pool.histories[name][-1].name
