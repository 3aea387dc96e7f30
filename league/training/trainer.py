"""Training turns: the file to read first.

A *turn* is the work of one lease: some learning iterations of a group's players, and at its end a checkpoint of each
and the snapshots that are due, in one transaction. As in HARL-A (Peterson et al., 2025), all teams act in N worlds;
then each learning team updates its agents one after the other by HAPPO, from its own rewards, with a critic and a value
normaliser of its own. Two things are added: in some worlds the other teams may be past snapshots, and a player whose
generation ends (`league/scheduling/player_resets.py`) is snapshotted and may be reset.
"""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple
from zlib import crc32

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from agents.batch import Batch
from agents.bridge import CriticMemories, scatter_memories
from agents.devices.distributed import SINGLE_PROCESS, Communicator
from agents.errors import Diverged
from agents.learner.learner_state import check_ranks_agree
from agents.policy.jax_policy import PolicyStack
from agents.rollout.metrics import episode_results, rollout_metrics
from agents.rollout.rollout import Trajectory, Worlds, with_memory
from arenas.arena import Arena
from league.config.experiment import Config
from league.state.jobs import TrainingTurn
from league.system import devices, memory
from league.system.gpu_sharing import GpuLock
from league.training.learner_factory import batch_of
from league.training.learner_pool import Counters, LearnerPool
from league.training.matchups import Matchups
from league.training.own_learner import OwnLearner
from league.training.setback import PlayerDiverged
from league.training.training_programs import TrainingPrograms
from league.training.training_recorder import TrainingRecorder
from league.training.turn_end import TurnFinalizer
from league.training.update_pool import UpdateRequest
from storage.records import ArenaKey, CurvePoint, Lease, Meeting, Player
from storage.store import Store


class Progress(NamedTuple):
    """Progress of a turn after an iteration."""

    counters: Mapping[str, Counters]  # of the learners
    trained: tuple[float, int]  # seconds and environment steps of the group, which its budget limits
    steps_per_second: float  # in this turn, learning included
    points: tuple[CurvePoint, ...]  # of this iteration


class Trainer:
    """Learners, compiled rollout and worlds of one process. The store's checkpoints are authoritative for the learners.

    Each of several ranks (`league/training/data_parallel/`) has a trainer with its part of the `worlds`, and all do
    the same turns: their decisions depend on values that are equal on all ranks or come from rank 0. Only rank 0
    commits.
    """

    def __init__(
        self, config: Config, arena: Arena, players: Sequence[Player], worlds: int, comm: Communicator = SINGLE_PROCESS,
        programs: TrainingPrograms | None = None,
    ):  # fmt: skip
        """Make the learners of these players.

        Args:
            config: the league's settings.
            arena: the arena, built for the worlds of this process.
            players: all players of the league.
            worlds: worlds simulated at once by all ranks together.
            comm: the ranks of a turn that is spread over several devices.
            programs: compiled programs of an earlier trainer of this process; by default new ones.

        Raises ValueError if `programs` were made for another arena or for other settings.
        """
        if programs is not None and not programs.fit(config, arena):
            raise ValueError("the compiled programs are those of another arena or of other settings")
        self.config, self.arena, self.comm = config, arena, comm
        self.asked = worlds // comm.size
        self.pool = LearnerPool(config, arena, players, comm)
        self.interrupted = False  # whether the last turn was stopped before its end
        self._worlds: dict[str, tuple[Worlds, list[tuple[str, ...]]]] = {}  # of each group, and their matchups
        self._critic_memories: dict[
            str, CriticMemories
        ] = {}  # of players: the memory of their critics in the group's worlds
        self._points: list[CurvePoint] = []  # of this turn
        self._meetings: list[Meeting] = []  # of this turn: results of each learner against each opponent
        self._recorder = TrainingRecorder(config, self.pool)
        self._restarted = 0.0  # share of the worlds that began anew with this turn
        self.programs = programs or TrainingPrograms(config, arena)
        self._shapes = self._architectures()
        self._gpu_lock = GpuLock(devices.own(jax.default_backend()))
        self._device = next(iter(self.pool.learners.values())).device
        self._room = memory.room(self._device)

    def turn(self, store: Store, turn: TrainingTurn, stop: Callable[[], bool]) -> Iterator[Progress]:
        """Learn, and yield after every iteration; end early, between two iterations, if `stop()` returns true.

        The turn also ends with its phase. A phase may be counted in environment steps, whose number in an iteration
        depends on the worlds of this machine. Raises PlayerDiverged.
        """
        pool = self.pool
        self.interrupted, self._points, self._meetings = False, [], []
        moved = pool.restore(store, turn)
        if pool.copy(store, turn) or moved:
            self._worlds.pop(turn.group, None)  # they belong to policies that the store does not have
        self._recorder.begin()
        self._finalizer = TurnFinalizer(pool, turn, store)
        if turn.iterations == 0:
            self._finalizer.begin(store)
            check_ranks_agree(pool.learners)
            return
        matchups = self._matchups(store, turn)
        worlds, collect = self._prepare(matchups, turn)
        self._introduce(matchups)
        began, before, steps = time.monotonic(), dict(pool.counters), 0
        met = {name: np.zeros((matchups.groups, len(self.arena.teams), 4)) for name in turn.learners}

        for left in reversed(range(turn.iterations)):
            with self._gpu_lock.training():
                worlds, trajectory = collect(self._policy_stacks(matchups), worlds, self._key(turn, "rollout"))
                figures = self._learn(turn, trajectory, matchups)
            for name in turn.learners:
                met[name] += episode_results(
                    trajectory, pool.players[name].team, matchups.groups, self.comm.sum_numbers
                )
            del trajectory  # two at once would need twice the memory

            steps += self._steps(matchups)
            elapsed = self.comm.broadcast(time.monotonic() - began)
            points = tuple(self._count(name, before[name], steps, elapsed, figures[name]) for name in turn.learners)
            self._points.extend(points)
            if self._recorder.due(turn):  # not part of the training time
                began += self._recorder.record(
                    store,
                    turn,
                    matchups,
                    self._policy_stacks(matchups, 1),
                    self._players_with_learning_critics(turn, matchups),
                )
            counters = {name: pool.counters[name] for name in turn.learners}
            yield Progress(counters, pool.trained(turn), steps / elapsed, points)
            if self._finalizer.reached(self._points):
                break
            if left and self.comm.broadcast(stop()):
                self.interrupted = True
                break
        self._worlds[turn.group] = worlds, matchups.assigned
        for name, won in met.items():
            self._meetings += matchups.meetings(pool.players[name], pool.counters[name].iteration, won)
        if self._finalizer.close(store, self._points, self._meetings):
            self._worlds.pop(turn.group)
        check_ranks_agree(pool.learners)

    def commit(self, store: Store, lease: Lease, turn: TrainingTurn) -> None:
        """Write the turn's checkpoints, curves, games and due snapshots, and end the job, in one transaction.

        Raises LeaseLost if another process has meanwhile continued the job or a player; then nothing was written.
        """
        also = self.pool.resting(turn) if self.config.training.resting_critics else self._finalizer.copied
        learnt = [*turn.learners, *also]
        key = ArenaKey(self.arena.name, self.arena.config_hash, self.arena.engine.name)
        checkpoints = [self.pool.checkpoint(store, name, key) for name in learnt]
        store.finish(
            lease, bases={name: turn.bases[name] for name in learnt}, checkpoints=checkpoints,
            snapshots=self._finalizer.snapshots(store, key), curves=self._points, meetings=self._meetings,
            matches=self._recorder.matches, keep=self.config.storage.checkpoints,
        )  # fmt: skip
        self._points, self._meetings = [], []
        self.pool.written(checkpoints)

    def compile(self, store: Store, turn: TrainingTurn) -> None:
        """Compile the programs with which the turn begins, for XLA's cache; run nothing and make no worlds."""
        self.pool.restore(store, turn)
        matchups = self._matchups(store, turn)
        key = jax.random.key(0)
        reset = self.programs.reset.lower(jax.eval_shape(lambda: jax.random.split(key, matchups.worlds)))
        reset.compile()
        stacks = self._policy_stacks(matchups)
        worlds = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), reset.out_info)
        self.programs.rollout.compile(stacks, jax.eval_shape(with_memory, worlds, stacks), key)

    def too_large(self) -> memory.TooLarge:
        """Return the error for a turn that ran out of memory, with its need by XLA's count and the size of a batch."""
        at_once = len(self.arena.teams) if self._device.type == "cpu" else 1
        needed = self.programs.rollout.bytes + memory.learning(self.config, self.arena, self.asked, at_once)
        worlds = self.asked * self.comm.size
        return memory.TooLarge(memory.describe(self.config, worlds, needed, self._room))

    # An iteration ----------------------------------------------------------------------------------------------------

    def _learn(self, turn: TrainingTurn, trajectory: Trajectory, matchups: Matchups) -> dict[str, dict[str, float]]:
        """Make one HAPPO update of every learner and of resting players' critics; return each learner's metrics.

        Raises PlayerDiverged. If all worlds are void, no player can learn; then the error names the learner whose
        robots alone were at fault most often.
        """
        names = self._players_with_learning_critics(turn, matchups)
        resting = names[len(turn.learners) :]
        batches = [self._batch(name, trajectory, matchups) for name in names]
        figures = {
            name: rollout_metrics(
                trajectory, self.pool.players[name].team, matchups.worlds_of(name), self.comm.sum_numbers
            )
            for name in turn.learners
        }
        learners = [self.pool.learners[name] for name in names]
        rests = [name in resting for name in names]
        taught = self.pool.updates([UpdateRequest(*each) for each in zip(learners, batches, rests, strict=True)])
        self._store_critic_memories(names, matchups)
        diverged: dict[str, object] = {}
        for name, losses in zip(names, taught, strict=True):
            if isinstance(losses, Diverged):
                diverged[name] = self._reason(losses, figures.get(name, {}))
            elif name in figures:
                if not losses:  # of a batch that is void as a whole
                    diverged.setdefault("", f"physics became unstable in every world of {name}")
                figures[name] |= {**losses, "past_share": matchups.past_share(name)}
        if "" in diverged and len(diverged) == 1:
            culprit = max(turn.learners, key=lambda name: figures[name]["own_voids"])
            raise PlayerDiverged(culprit, diverged[""])
        for name in filter(None, diverged):
            raise PlayerDiverged(name, diverged[name])
        return figures

    def _reason(self, error: Diverged, figures: Mapping[str, float]) -> str:
        """Return what was not finite, and which command tells more if the arena gave it."""
        given = [f"{name}s" for name in ("reward", "shaping") if not math.isfinite(figures.get(name, 0.0))]
        asked = f" ({' and '.join(given)}); `league check {self.config.arena.name}` names the term"
        return f"{error}{asked if given else ''}"

    def _introduce(self, matchups: Matchups) -> None:
        """Tell learners of other classes against whom they learn in this turn."""
        iterations = {name: at.iteration for name, at in self.pool.counters.items()}
        for name in matchups.turn.learners:
            learner = self.pool.learners[name]
            if isinstance(learner, OwnLearner):
                learner.meet(matchups.opponents_of(name, iterations))

    def _players_with_learning_critics(self, turn: TrainingTurn, matchups: Matchups) -> list[str]:
        """Return the players whose critics learn in the turn: the learners, then the resting players."""
        resting = self.pool.resting(turn) if self.config.training.resting_critics else []
        return [*turn.learners, *(name for name in resting if matchups.teaches(name) and self.pool.judges(name))]

    def _store_critic_memories(self, names: Sequence[str], matchups: Matchups) -> None:
        """Keep the critics' memory of the worlds that they have just learnt from, for the rollout that continues there.

        Their memory of other worlds is empty, and so is that of a critic that did not learn now, because it has missed
        too much. Like the worlds, the memory is not part of a checkpoint: a restored player begins in fresh worlds.
        """
        for name in filter(None, matchups.turn.present):
            final_memories = self.pool.learners[name].final_memories if name in names else ()
            self._critic_memories[name] = scatter_memories(final_memories, matchups.worlds_of(name), matchups.worlds)

    def _batch(self, name: str, trajectory: Trajectory, matchups: Matchups) -> Batch:
        return batch_of(
            self.config, self.arena, self.pool.players[name], trajectory, matchups.worlds_of(name),
            self.pool.shaping(name), self._critic_memories.get(name, ()), self.pool.skills[name], self.pool.gamma(name),
            self._steps(matchups),
        )  # fmt: skip

    def _steps(self, matchups: Matchups) -> int:
        """Return the environment steps of an iteration, those in other players' groups of worlds included."""
        return matchups.worlds * self.comm.size * self.config.training.rollout_length

    def _count(
        self, name: str, before: Counters, steps: int, elapsed: float, figures: Mapping[str, float]
    ) -> CurvePoint:
        """Advance a player's counters by one iteration; return the point of its learning curve."""
        at = self.pool.counters[name]
        now = Counters(at.iteration + 1, before.steps + steps, before.seconds + elapsed)
        self.pool.counters[name] = now
        self.pool.note(name, figures)
        values = {
            **figures, **{f"hyperparameter.{k}": v for k, v in self.pool.moved(name).items()},
            "steps_per_second": steps / elapsed, "shaping_weight": self.pool.shaping(name),
            "begun_anew": self._restarted if at == before else 0.0,
        }  # fmt: skip
        return CurvePoint(self.pool.players[name].league, name, now.iteration, now.steps, now.seconds, values)

    def _policy_stacks(self, matchups: Matchups, groups: int | None = None) -> dict[str, PolicyStack]:
        turn = matchups.turn
        now = {name: self.pool.acting(name, name in turn.learners) for name in turn.present if name}
        return matchups.stacks(now, self._shapes, groups)

    def _architectures(self) -> dict[str, list]:
        """Return, by agent, the actors of all players of its team, so that the compiled shapes fit each of them."""
        ways = {name: self.pool.ways(name) for name in self.pool.learners}
        return {
            agent.name: [way[i] for p in self.pool.players.values() if p.team == t for way in ways[p.name]]
            for t, team in enumerate(self.arena.teams)
            for i, agent in enumerate(team.agents)
        }

    def _matchups(self, store: Store, turn: TrainingTurn) -> Matchups:
        """Return the turn's matchups, in which each learner has the share of past opponents that its rule asks for.

        A learner without past opponents has that share in any number of present groups, and learns from all.
        """
        alone = "" in turn.present
        groups = {n: 0 if alone else self.config.opponents(self.pool.players[n]).split().present for n in turn.learners}
        present = max(groups.values())
        if not any(turn.past.values()):
            present = 1  # without past opponents all groups would be alike
        learns_from = {name: wanted for name, wanted in groups.items() if turn.past.get(name)}
        return Matchups(turn, present, self.asked, store, self.pool.league, self.arena, learns_from)

    def _prepare(self, matchups: Matchups, turn: TrainingTurn) -> tuple[Worlds, Callable]:
        """Return the worlds and the compiled rollout, prepared here because neither counts as training time.

        Worlds whose matchup differs from the previous turn's are restarted, because an episode must not continue with a
        new opponent. A change of the player that learns from a world always comes with another matchup. All worlds of
        the group begin anew in a deterministic league, after a copy or a reset, and where this process has not done the
        group's last turn.
        """
        self._restarted = 0.0
        worlds, before = self._worlds.pop(turn.group, (None, []))
        if worlds is not None and len(before) == matchups.groups and not self.config.deterministic:
            changed = matchups.changed(before)
            if changed.any():
                keys = jax.random.split(self._key(turn, "restart"), matchups.worlds)
                worlds = self.programs.restart(worlds, keys, jnp.asarray(changed))
                self._restarted = float(changed.mean())
        else:
            keys = jax.random.split(self._key(turn, "worlds"), matchups.worlds)
            worlds = jax.block_until_ready(self.programs.reset(keys))
            self._critic_memories |= {name: [] for name in turn.present}
            self._restarted = float(any(self.pool.counters[name].iteration for name in turn.present if name))
        stacks = self._policy_stacks(matchups)
        worlds = with_memory(worlds, stacks)
        return worlds, self.programs.rollout.ready(stacks, worlds, jax.random.key(0))

    def _key(self, turn: TrainingTurn, purpose: str) -> Array:
        """Return the random key of a purpose at this moment; it is the same in every process and after a restart."""
        moment = sum(self.pool.counters[name].iteration for name in turn.present if name)
        key = random_key(self.config.seed, f"{turn.group}/{turn.retry}/{purpose}", moment)
        return key if self.comm.size == 1 else jax.random.fold_in(key, self.comm.rank)


def random_key(seed: int, purpose: str, number: int) -> Array:
    """Return the random key of a purpose and a number; it is the same in every process and after a restart."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), crc32(purpose.encode())), number)
