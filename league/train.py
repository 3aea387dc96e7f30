"""A training turn: the file to read first.

A *turn* is what one lease covers: some learning iterations of the players whose turn it is, and at its end a checkpoint
of each, and snapshots where they are due, in one transaction. In the words of HARL-A (Peterson et al., 2025): all teams
act in N worlds; then each learning team updates its agents one after the other by HAPPO, from its own rewards, with a
critic and a value normaliser of its own. What is added: in some worlds the other teams may be past snapshots; and a
player whose life ends (`league/lives.py`) is frozen, and then may begin anew.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple
from zlib import crc32

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from agents.batch import Batch
from agents.bridge import Recalled, everywhere, to_jax
from agents.errors import Diverged
from agents.happo import compare
from agents.outcomes import outcomes, results
from agents.parallel import ALONE, Together
from agents.policy import Crew
from agents.rollout import Trajectory, Worlds, make_reset, make_restart, make_rollout, remembering
from arenas.arena import Arena
from league import memory
from league.compiled import Compiled
from league.config.experiment import Config
from league.ending import Ending
from league.jobs import TrainingTurn
from league.learners import batch_of
from league.lineup import Lineup
from league.recorder import Recorder
from league.squad import Counters, Squad
from league.studies import Study
from storage.records import ArenaKey, CurvePoint, Lease, Meeting, Player
from storage.store import Store


class Progress(NamedTuple):
    """How a turn stands after an iteration."""

    counters: Mapping[str, Counters]  # of the learners
    steps_per_second: float  # in this turn, learning included
    points: tuple[CurvePoint, ...]  # of this iteration


class PlayerDiverged(Exception):  # noqa: N818  (a sentence: "the player diverged")
    """A player's learning went bad; the store still holds its last good checkpoint."""

    def __init__(self, player: str, reason: object):
        super().__init__(f"{player} diverged: {reason}")
        self.player = player


class Trainer:
    """One process's learners, compiled rollout and worlds. The store's checkpoints are the truth about the learners.

    Of several ranks (`league/ranks.py`) each has one, with its part of the `worlds`, and all do the same turns: what
    they decide by is equal everywhere, or what rank 0 says. Rank 0 alone commits.
    """

    def __init__(
        self, config: Config, arena: Arena, players: Sequence[Player], worlds: int, together: Together = ALONE
    ):  # fmt: skip
        self.config, self.arena, self.together = config, arena, together
        self.asked = worlds // together.size
        self.squad = Squad(config, arena, players, together)
        self.interrupted = False  # whether the last turn was told to stop before its end
        self._worlds: dict[str, tuple[Worlds, list[tuple[str, ...]]]] = {}  # of each group, and who sat in them
        self._recalled: dict[str, Recalled] = {}  # of players: what their critics remember of the group's worlds
        self._points: list[CurvePoint] = []  # of this turn
        self._meetings: list[Meeting] = []  # of this turn: what came of the games of each learner against each opponent
        self._recorder = Recorder(config, self.squad)
        self._begun_anew = 0.0  # share of the worlds whose episodes were broken off for this turn's opponents
        stagger = config.training.stagger
        self._reset, self._restart = make_reset(arena, stagger), make_restart(arena, stagger)
        chunk, privileged = config.learner.sequence, config.learner.critic_input == "privileged"
        self._rollout = Compiled(make_rollout(arena, config.training.rollout, chunk, privileged), arena)
        self._shapes = self._architectures()
        self._device = next(iter(self.squad.learners.values())).device
        self._room = memory.room(self._device)

    def turn(self, store: Store, turn: TrainingTurn, stop: Callable[[], bool]) -> Iterator[Progress]:
        """Learn, and yield after every iteration; end early, between two iterations, when `stop()` says so.

        The turn also ends with its phase, where that is counted in environment steps: how many an iteration has depends
        on the worlds of this machine. Raises PlayerDiverged where a player's learning went bad.
        """
        squad = self.squad
        self.interrupted, self._points, self._meetings = False, [], []
        moved = squad.restore(store, turn)
        if squad.copy(store, turn) or moved:
            self._worlds.pop(turn.group, None)  # they belong to a history that is not the store's
        self._recorder.begin()
        self._ending = Ending(squad, turn, store)
        if turn.iterations == 0:
            self._ending.begin(store)
            compare(squad.learners)
            return
        lineup = self._lineup(store, turn)
        worlds, collect = self._prepare(lineup, turn)
        began, before, steps = time.monotonic(), dict(squad.counters), 0
        met = {name: np.zeros((lineup.groups, 4)) for name in turn.learners}

        for left in reversed(range(turn.iterations)):
            worlds, trajectory = collect(self._crews(lineup), worlds, self._key(turn, "rollout"))
            figures = self._learn(turn, trajectory, lineup)
            for name in turn.learners:
                met[name] += results(trajectory, squad.players[name].team, lineup.groups, self.together.add)
            del trajectory  # two of them at once would be twice the memory

            steps += lineup.worlds * self.together.size * self.config.training.rollout
            elapsed = self.together.first(time.monotonic() - began)
            points = tuple(self._count(name, before[name], steps, elapsed, figures[name]) for name in turn.learners)
            self._points.extend(points)
            if self._recorder.due(turn):  # which is no time of training
                began += self._recorder.record(store, turn, lineup, self._crews(lineup, 1), self._judges(turn, lineup))
            yield Progress({name: squad.counters[name] for name in turn.learners}, steps / elapsed, points)
            if self._ending.reached(self._points):
                break
            if left and self.together.first(stop()):
                self.interrupted = True
                break
        self._worlds[turn.group] = worlds, lineup.seated
        for name, won in met.items():
            self._meetings += lineup.meetings(squad.players[name], squad.counters[name].iteration, won)
        if self._ending.close(store, self._points, self._meetings):
            self._worlds.pop(turn.group)
        compare(squad.learners)

    def commit(self, store: Store, lease: Lease, turn: TrainingTurn) -> None:
        """Write the turn's checkpoints, curves, games, and snapshots where they are due; end the job: one transaction.

        Raises LeaseLost if the job, or a player, has meanwhile gone on elsewhere; then nothing was written.
        """
        also = self.squad.resting(turn) if self.config.training.resting_critics else self._ending.copied
        learnt = [*turn.learners, *also]
        key = ArenaKey(self.arena.name, self.arena.config_hash, self.arena.engine.name)
        checkpoints = [self.squad.checkpoint(store, name, key) for name in learnt]
        store.finish(
            lease, bases={name: turn.bases[name] for name in learnt}, checkpoints=checkpoints,
            snapshots=self._ending.snapshots(store, key), curves=self._points, meetings=self._meetings,
            matches=self._recorder.matches, keep=self.config.storage.checkpoints,
        )  # fmt: skip
        self._points, self._meetings = [], []
        self.squad.written(checkpoints)

    def too_large(self) -> memory.TooLarge:
        """What to say where a turn ran out of memory: what it needed, by XLA's count and the numbers of a batch."""
        at_once = len(self.arena.teams) if self._device.type == "cpu" else 1
        needed = self._rollout.bytes + memory.learning(self.config, self.arena, self.asked, at_once)
        worlds = self.asked * self.together.size
        return memory.TooLarge(memory.words(self.config, worlds, needed, self._room))

    # An iteration ----------------------------------------------------------------------------------------------------

    def _learn(self, turn: TrainingTurn, trajectory: Trajectory, lineup: Lineup) -> dict[str, dict[str, float]]:
        """One HAPPO update of every learner, and what the iteration was like for each; critics of who rests follow.

        Raises PlayerDiverged. Where no world stayed sound nobody can learn: then it is whose robots alone went bad.
        """
        names = self._judges(turn, lineup)
        resting = names[len(turn.learners) :]
        batches = [self._batch(name, trajectory, lineup) for name in names]
        figures = {
            name: outcomes(trajectory, self.squad.players[name].team, lineup.worlds_of(name), self.together.add)
            for name in turn.learners
        }
        learners = [self.squad.learners[name] for name in names]
        rests = [name in resting for name in names]
        taught = self.squad.studies([Study(*each) for each in zip(learners, batches, rests, strict=True)])
        self._recall(names, lineup)
        diverged: dict[str, object] = {}
        for name, losses in zip(names, taught, strict=True):
            if isinstance(losses, Diverged):
                diverged[name] = losses
            elif name in figures:
                if not losses:
                    diverged.setdefault("", f"physics became unstable in every world of {name}")
                figures[name] |= {**losses, "past_share": lineup.past_share(name)}
        if "" in diverged and len(diverged) == 1:
            culprit = max(turn.learners, key=lambda name: figures[name]["own_voids"])
            raise PlayerDiverged(culprit, diverged[""])
        for name in filter(None, diverged):
            raise PlayerDiverged(name, diverged[name])
        return figures

    def _judges(self, turn: TrainingTurn, lineup: Lineup) -> list[str]:
        """Players whose critics learn in the turn: the learners, then who rests and is followed."""
        resting = self.squad.resting(turn) if self.config.training.resting_critics else []
        return [*turn.learners, *(name for name in resting if lineup.teaches(name))]

    def _recall(self, names: Sequence[str], lineup: Lineup) -> None:
        """Keep what critics remember of the worlds that they have just learnt from, for the rollout that goes on there.

        Of other worlds they remember nothing, and nor does a critic that did not learn now: it has missed too much.
        Like the worlds this is no part of a checkpoint: who goes on from one begins in fresh worlds.
        """
        for name in filter(None, lineup.turn.present):
            remembered = self.squad.learners[name].remembered if name in names else ()
            self._recalled[name] = everywhere(remembered, lineup.worlds_of(name), lineup.worlds)

    def _batch(self, name: str, trajectory: Trajectory, lineup: Lineup) -> Batch:
        return batch_of(
            self.config, self.arena, self.squad.players[name], trajectory, lineup.worlds_of(name),
            self.squad.shaping(name), self._recalled.get(name, ()),
        )  # fmt: skip

    def _count(
        self, name: str, before: Counters, steps: int, elapsed: float, figures: Mapping[str, float]
    ) -> CurvePoint:
        """Move a player's counters on by one iteration."""
        at = self.squad.counters[name]
        now = Counters(at.iteration + 1, before.steps + steps, before.seconds + elapsed)
        self.squad.counters[name] = now
        self.squad.note(name, figures)
        values = {
            **figures, **{f"hyperparameter.{k}": v for k, v in self.squad.moved(name).items()},
            "steps_per_second": steps / elapsed, "shaping_weight": self.squad.shaping(name),
            "begun_anew": self._begun_anew if at == before else 0.0,
        }  # fmt: skip
        return CurvePoint(self.squad.players[name].league, name, now.iteration, now.steps, now.seconds, values)

    def _crews(self, lineup: Lineup, groups: int | None = None) -> dict[str, Crew]:
        now = {name: to_jax(self.squad.learners[name].policies()) for name in lineup.turn.present if name}
        return lineup.crews(now, self._shapes, groups)

    def _architectures(self) -> dict[str, list]:
        """Actors by agent of every player of the agent's team: whoever sits there, the compiled shape is the same."""
        actors = {name: to_jax(learner.policies()) for name, learner in self.squad.learners.items()}
        return {
            agent.name: [actors[p.name][i] for p in self.squad.players.values() if p.team == t]
            for t, team in enumerate(self.arena.teams)
            for i, agent in enumerate(team.agents)
        }

    def _lineup(self, store: Store, turn: TrainingTurn) -> Lineup:
        alone = "" in turn.present
        groups = {
            n: 0 if alone else self.config.opponents(self.squad.players[n]).split().present for n in turn.learners
        }
        present = max(groups.values())
        if not any(turn.past.values()):
            present = 1  # without past opponents all groups would be alike
        aloof = [name for name, wanted in groups.items() if not wanted and turn.past.get(name)]
        return Lineup(turn, present, self.asked, store, self.squad.league, self.arena, aloof)

    def _prepare(self, lineup: Lineup, turn: TrainingTurn) -> tuple[Worlds, Callable]:
        """Worlds and the compiled rollout, so that neither counts as training time.

        Where somebody else sits than in the turn before, an episode must not go on with a new opponent: those worlds
        begin anew. Which of the group's worlds learn from whom may have changed too; that is seen as other seats.
        """
        self._begun_anew = 0.0
        worlds, before = self._worlds.pop(turn.group, (None, []))
        if worlds is not None and len(before) == lineup.groups and not self.config.deterministic:
            changed = lineup.changed(before)
            if changed.any():
                keys = jax.random.split(self._key(turn, "restart"), lineup.worlds)
                worlds = self._restart(worlds, keys, jnp.asarray(changed))
                self._begun_anew = float(changed.mean())
        else:
            keys = jax.random.split(self._key(turn, "worlds"), lineup.worlds)
            worlds = jax.block_until_ready(self._reset(keys))
            self._recalled |= {name: [] for name in turn.present}
        crews = self._crews(lineup)
        worlds = remembering(worlds, crews)
        return worlds, self._rollout.ready(crews, worlds, jax.random.key(0))

    def _key(self, turn: TrainingTurn, purpose: str) -> Array:
        """A key for one purpose and moment, the same in every process and after every restart."""
        moment = sum(self.squad.counters[name].iteration for name in turn.present if name)
        key = random_key(self.config.seed, f"{turn.group}/{turn.dice}/{purpose}", moment)
        return key if self.together.size == 1 else jax.random.fold_in(key, self.together.rank)


def random_key(seed: int, purpose: str, number: int) -> Array:
    """A key for one purpose, the same in every process and after every restart."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), crc32(purpose.encode())), number)
