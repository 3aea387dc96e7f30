"""Training without a league: rollouts and updates, and the timing of what `benchmarks/train.py` compares.

Parts that are compared alternate. Seconds are arrays (wall-clock, CPU).
"""

import argparse
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property
from itertools import count
from typing import Any

import jax
import numpy as np
from jax import Array

from agents.batch import Batch
from agents.bridge import team_batch, to_jax
from agents.learner.happo import HappoLearner
from agents.policy.jax_policy import PolicyStack
from agents.rollout.new_worlds import make_reset
from agents.rollout.rollout import Trajectory, Worlds, make_rollout
from benchmarks.replay import Pair, clocks
from league.config.experiment import Config
from league.runtime.bootstrap import players_of
from league.snapshots.codec import seat
from league.training.trainer import Trainer
from league.training.update_pool import UpdatePool, UpdateRequest
from scripts.record import spread

Action = Callable[[Worlds, Array], tuple[Worlds, Trajectory]]  # continue from worlds by one rollout, with this key


class Ground:
    """An arena with a number of worlds, its compiled rollout, and the loops that train in it."""

    def __init__(self, config: Config, worlds: int, args: argparse.Namespace):
        self.config = replace(config, training=replace(config.training, rollout_length=args.decisions))
        self.worlds, self.args, self.repeats = worlds, args, args.repeats
        self.arena = self.config.arena.build(engine=self.config.engine, worlds=worlds)
        chunk = self.config.learner.sequence
        self.rollout, self.reset = make_rollout(self.arena, args.decisions, chunk), make_reset(self.arena)
        self.steps = args.decisions * self.arena.timing.hold  # control steps of each world in a rollout

    @cached_property
    def loop(self) -> "Loop":
        """Training in which all teams learn from each other."""
        return Loop(self)

    @cached_property
    def pair(self) -> Pair:
        """The bare engine that replays what was played."""
        return Pair(self.arena, self.worlds, self.args.decisions)

    def learners(self, seed: int = 1, **settings: Any) -> list[HappoLearner]:
        """Make learners of all teams as a league does; `settings` override those of the learner."""
        config = replace(self.config, seed=seed, learner=replace(self.config.learner, **settings))
        return list(Trainer(config, self.arena, players_of(config, self.arena), self.worlds).pool.learners.values())


class Loop:
    """Rollouts and updates of `Trainer.turn` without a store.

    All teams learn, or only the first one against `frozen`: K lists of learners of all teams, whose policies play the
    other teams in K groups of worlds.
    """

    def __init__(self, ground: Ground, frozen: list[list[HappoLearner]] | None = None):
        self.ground, self.learners = ground, ground.learners()
        self.learning = self.learners[:1] if frozen else self.learners
        self._updates = UpdatePool(self.learning)
        self._updates.start_workers(len(self.learning))  # as in a league after its first seconds
        self.frozen = [[to_jax(learner.export()) for learner in teams] for teams in frozen or []]
        self.groups = len(self.frozen) or 1
        self.worlds = ground.worlds // self.groups * self.groups
        self._keys = (jax.random.key(2000 + i) for i in count())
        self.now: Worlds = ground.reset(jax.random.split(jax.random.key(0), self.worlds))
        self.seated = self._seated()
        timing = ground.arena.timing
        for _ in range(1 + round(ground.args.warm / (timing.control_interval * ground.steps))):
            self.play(self.roll)

    def _seated(self) -> dict[str, PolicyStack]:
        """Return each agent's present policies for all groups of worlds."""
        seats = [[to_jax(learner.export())] * self.groups for learner in self.learning]
        seats += [[teams[t] for teams in self.frozen] for t in range(len(seats), len(self.learners))]
        return seat(self.ground.arena.teams, seats)

    def batch(self, team: int, trajectory: Trajectory, worlds: slice | np.ndarray = slice(None)) -> Batch:
        """Return the batch from which a team learns."""
        shaping = 1.0  # the full dense reward, as at the start of a league
        return team_batch(trajectory, self.ground.arena.teams[team], team, worlds, shaping)

    def roll(self, now: Worlds, key: Array) -> tuple[Worlds, Trajectory]:
        """Do a rollout with the policies after the last update."""
        return self.ground.rollout(self.seated, now, key)

    def learn(self, now: Worlds, key: Array) -> tuple[Worlds, Trajectory]:
        """Do a rollout and the updates after it."""
        now, trajectory = self.roll(now, key)
        batches = [self.batch(team, trajectory) for team in range(len(self.learning))]
        self._updates([UpdateRequest(*each) for each in zip(self.learning, batches, strict=True)])
        self.seated = self._seated()
        return now, trajectory

    def play(self, how: Action) -> np.ndarray:
        """Continue by `roll` or `learn`; return seconds (wall-clock, CPU)."""
        key = next(self._keys)
        vars(self).pop("trajectory", None)  # training never holds two trajectories
        jax.block_until_ready((self.now, key))
        began = clocks()
        self.now, self.trajectory = jax.block_until_ready(how(self.now, key))
        jax.block_until_ready(self.seated)
        return clocks() - began

    def beside_bare(self, how: Action) -> dict:
        """Alternate `roll` or `learn` with the bare engine; return speeds and ratios."""
        took: dict[str, list[np.ndarray]] = {"whole": [], "bare": []}
        for _ in range(self.ground.repeats + 1):
            stretch = self.ground.pair.stretch(how, self.now, next(self._keys))
            self.now = stretch.worlds
            took["whole"].append(stretch.whole)
            took["bare"].append(stretch.bare)
        seconds = {name: np.array(each[1:]) for name, each in took.items()}
        return speeds(seconds, self.worlds * self.ground.steps) | ratio(seconds["bare"], seconds["whole"])


def turns(parts: Mapping[str, Callable[[], np.ndarray]], repeats: int) -> dict[str, np.ndarray]:
    """Time alternating parts: seconds (repeats, 2), wall-clock and CPU, without the first round, which compiles."""
    took = np.array([[part() for part in parts.values()] for _ in range(repeats + 1)])[1:]
    return {name: took[:, i] for i, name in enumerate(parts)}


def timed(action: Callable[[], object], before: Callable[[], object] = lambda: None) -> np.ndarray:
    """Return seconds (wall-clock, CPU) until all results of `action()` are ready."""
    before()
    began = clocks()
    jax.block_until_ready(action())
    return clocks() - began


def ratio(top: np.ndarray, bottom: np.ndarray) -> dict:
    """Divide seconds (repeats, 2) pair by pair; return the ratios of wall-clock and of CPU time."""
    found = np.divide(top, bottom)
    return {"ratio": spread(found[:, 0]), "ratio_of_cpu_time": spread(found[:, 1])}


def speeds(seconds: Mapping[str, np.ndarray], steps: int) -> dict:
    """Return control steps/s of each part."""
    return {"steps_per_second": {name: spread(steps / each[:, 0], 0) for name, each in seconds.items()}}
