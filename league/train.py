"""A training turn: the file to read first.

A *turn* is what one lease covers: some learning iterations of the players whose turn it is, and at its end a checkpoint
of each, and snapshots where they are due, in one transaction. In the words of HARL-A (Peterson et al., 2025): all teams
act in N worlds; then each learning team updates its agents one after the other by HAPPO, from its own rewards, with a
critic and a value normaliser of its own. What is added: in some worlds the other teams may be past snapshots.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, dataclass
from typing import NamedTuple
from zlib import crc32

import jax
import jax.numpy as jnp
from jax import Array

from agents.bridge import team_batch, to_jax
from agents.happo import Learner
from agents.rollout import make_reset, make_rollout
from arenas.arena import Arena, State
from league.config import Config
from league.lineup import Lineup, Turn
from league.policies import freeze
from matchmaking.schedule import next_due
from storage import arrays
from storage.records import Checkpoint, Lease, Player, Snapshot
from storage.store import Store


@dataclass
class Counters:
    """How far the league has come, as the newest checkpoint's row says it."""

    iteration: int = 0
    steps: int = 0  # decisions × worlds
    seconds: float = 0.0  # of training


class Progress(NamedTuple):
    """How a turn stands after an iteration."""

    counters: Counters
    steps_per_second: float  # in this turn, learning included
    diagnostics: dict[str, dict[str, float]]  # player -> losses and the like


class Trainer:
    """One process's learners, compiled rollout and worlds. The store's checkpoints are the truth about the learners."""

    def __init__(self, config: Config, arena: Arena, players: Sequence[Player]):
        self.config, self.arena, self.players = config, arena, players
        self.learners = [_new_learner(config, arena, player.team) for player in players]
        self.counters = Counters()
        self.worlds: State | None = None
        self._at = [""] * len(players)  # digests of the checkpoints that the learners stand at
        self._reset = make_reset(arena)
        self._rollout = make_rollout(arena, config.training.rollout)
        self._compiled: dict[tuple[int, int], Callable] = {}

    def turn(self, store: Store, turn: Turn, stop: Callable[[], bool]) -> Iterator[Progress]:
        """Learn, and yield after every iteration; end early, between two iterations, when `stop()` says so."""
        training = self.config.training
        self._restore(store)
        lineup = Lineup(turn, training.opponents, training.worlds, self.players, store, self.arena)
        collect = self._prepare(lineup, turn)
        counters = self.counters
        began, before = time.monotonic(), Counters(*astuple(counters))

        for iteration in range(turn.first, turn.last):
            policies = lineup.policies([to_jax(learner.policies()) for learner in self.learners])
            self.worlds, trajectory = collect(policies, self.worlds, random_key(self.config.seed, "rollout", iteration))
            diagnostics = {}
            for team in turn.learners:
                batch = team_batch(trajectory, self.arena.teams[team], team, lineup.worlds_of(team), self._shaping())
                diagnostics[self.players[team].name] = self.learners[team].update(batch)

            elapsed = time.monotonic() - began
            counters.iteration = iteration + 1
            counters.steps += lineup.worlds * training.rollout
            counters.seconds = before.seconds + elapsed
            yield Progress(counters, (counters.steps - before.steps) / elapsed, diagnostics)
            if stop() or self._enough(before):
                break

    def commit(self, store: Store, lease: Lease, turn: Turn) -> None:
        """Write the turn's checkpoints, and snapshots where they are due, and end the job, in one transaction.

        Raises LeaseLost if the job has meanwhile gone to somebody else; then nothing was written.
        """
        c = self.counters
        checkpoints, snapshots = [], []
        for team in turn.learners if c.iteration else range(len(self.players)):
            player, learner = self.players[team], self.learners[team]
            digest = store.blobs.put(arrays.to_bytes(learner.state()))
            checkpoints.append(Checkpoint(player.league, player.name, digest, c.steps, c.iteration, c.seconds))
            if self._snapshot_due(store, player):
                actors = [{k: v.cpu().numpy() for k, v in actor.items()} for actor in learner.policies()]
                frozen, name = store.blobs.put(freeze(actors)), f"{player.name}@{c.iteration}"
                snapshots.append(
                    Snapshot(
                        frozen, player.league, name, player.roster, player.name, None, c.steps, c.iteration, c.seconds
                    )
                )
            self._at[team] = digest
        store.finish(lease, checkpoints=checkpoints, snapshots=snapshots)

    # Inside ----------------------------------------------------------------------------------------------------------

    def _restore(self, store: Store) -> None:
        """Bring every learner to its newest checkpoint, unless it stands there already."""
        newest = Checkpoint("", "", "", 0, 0, 0.0)
        for i, player in enumerate(self.players):
            checkpoint = store.checkpoint(player.league, player.name)
            if checkpoint is None:
                continue
            if checkpoint.digest != self._at[i]:
                self.learners[i].load(arrays.from_bytes(store.blobs.get(checkpoint.digest)))
                self._at[i] = checkpoint.digest
                self.worlds = None  # they belong to a history that is not the store's
            newest = max(newest, checkpoint, key=lambda c: c.iteration)
        self.counters = Counters(newest.iteration, newest.step, newest.seconds)

    def _prepare(self, lineup: Lineup, turn: Turn) -> Callable:
        """Make worlds and compile the rollout, so that neither counts as training time."""
        if self.worlds is None or self.config.deterministic or self.worlds.done.shape[0] != lineup.worlds:
            keys = jax.random.split(random_key(self.config.seed, "worlds", turn.first), lineup.worlds)
            self.worlds = jax.block_until_ready(self._reset(keys))
        shape = (lineup.groups, lineup.worlds)
        if shape not in self._compiled:
            policies = lineup.policies([to_jax(learner.policies()) for learner in self.learners])
            self._compiled[shape] = self._rollout.lower(policies, self.worlds, jax.random.key(0)).compile()
            if self.arena.engine.name == "warp":  # its kernels are compiled and loaded when they first run
                copy = jax.tree.map(jnp.copy, self.worlds)
                jax.block_until_ready(self._compiled[shape](policies, copy, jax.random.key(0)))
        return self._compiled[shape]

    def _shaping(self) -> float:
        """Weight of the dense reward now: it fades linearly to none."""
        span = self.config.training.shaping_steps
        return max(0.0, 1.0 - self.counters.steps / span) if span else 0.0

    def _enough(self, before: Counters) -> bool:
        """Whether the turn should end here because of the clock: the budget is spent or a milestone was passed."""
        if self.config.deterministic:
            return False
        marks = (*self.config.rating.milestone_seconds, self.config.budget.train_seconds)
        return any(before.seconds < mark <= self.counters.seconds for mark in marks)

    def _snapshot_due(self, store: Store, player: Player) -> bool:
        """At the start, on the logarithmic axis, after a milestone of training time, and when the budget is spent."""
        kept = store.snapshots(player.league, player.name)
        if not kept:
            return True
        last, now = kept[-1], self.counters
        on_axis = now.iteration >= next_due(last.iteration, self.config.training.snapshots_per_doubling)
        marks = () if self.config.deterministic else self.config.rating.milestone_seconds
        passed = any(last.seconds < mark <= now.seconds for mark in marks)
        return on_axis or passed or self.config.budget.spent(now.seconds, now.steps)


def random_key(seed: int, purpose: str, number: int) -> Array:
    """A key for one purpose, the same in every process and after every restart."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), crc32(purpose.encode())), number)


def _new_learner(config: Config, arena: Arena, team: int) -> Learner:
    agents = arena.teams[team].agents
    seed = crc32(f"{config.seed}/{team}".encode())  # teams that start from the same bytes would share a snapshot
    sizes = [a.observation_size for a in agents], [a.action_size for a in agents]
    return Learner(*sizes, config.learner, seed, config.training.device)
