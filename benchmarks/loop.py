"""The training loop of a league without the league, and how what `benchmarks/train.py` compares is timed.

Parts that are compared take turns. Seconds are by the wall's clock and of CPU time, in this order.
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
from agents.happo import Learner
from agents.policy import Crew
from agents.rollout import Trajectory, Worlds, make_reset, make_rollout
from benchmarks.record import spread
from benchmarks.replay import Pair, clocks
from league.config.experiment import Config
from league.create import players_of
from league.policies import seat
from league.studies import Studies, Study
from league.train import Trainer

Verb = Callable[[Worlds, Array], tuple[Worlds, Trajectory]]  # goes on from worlds by one rollout, with this key


class Ground:
    """An arena with so many worlds, its compiled rollout, and the loops that train in it."""

    def __init__(self, config: Config, worlds: int, args: argparse.Namespace):
        self.config = replace(config, training=replace(config.training, rollout=args.decisions))
        self.worlds, self.args, self.repeats = worlds, args, args.repeats
        self.arena = self.config.arena.build(engine=self.config.engine, worlds=worlds)
        chunk = self.config.learner.sequence
        self.rollout, self.reset = make_rollout(self.arena, args.decisions, chunk), make_reset(self.arena)
        self.steps = args.decisions * self.arena.timing.hold  # control steps of each world in a rollout

    @cached_property
    def loop(self) -> "Loop":
        """All teams learn from each other."""
        return Loop(self)

    @cached_property
    def pair(self) -> Pair:
        """The bare engine beside it."""
        return Pair(self.arena, self.worlds, self.args.decisions)

    def learners(self, seed: int = 1, **settings: Any) -> list[Learner]:
        """Fresh learners of all teams, as a league makes them; `settings` are of the learner, where they differ."""
        config = replace(self.config, seed=seed, learner=replace(self.config.learner, **settings))
        return list(Trainer(config, self.arena, players_of(config, self.arena), self.worlds).squad.learners.values())


class Loop:
    """Rollouts and updates of `Trainer.turn` without a store: all teams learn, or the first from `frozen` others.

    `frozen` holds K times the learners of all teams, whose policies sit in K groups of worlds in every other team.
    """

    def __init__(self, ground: Ground, frozen: list[list[Learner]] | None = None):
        self.ground, self.learners = ground, ground.learners()
        self.learning = self.learners[:1] if frozen else self.learners
        self._studies = Studies(self.learning)
        self._studies.assist(len(self.learning))  # as a league has it from its first seconds on
        self.frozen = [[to_jax(learner.policies()) for learner in teams] for teams in frozen or []]
        self.groups = len(self.frozen) or 1
        self.worlds = ground.worlds // self.groups * self.groups
        self._keys = (jax.random.key(2000 + i) for i in count())
        self.now: Worlds = ground.reset(jax.random.split(jax.random.key(0), self.worlds))
        self.seated = self._seated()
        timing = ground.arena.timing
        for _ in range(1 + round(ground.args.warm / (timing.control_interval * ground.steps))):
            self.play(self.roll)

    def _seated(self) -> dict[str, Crew]:
        """The crews of the policies as they are now."""
        seats = [[to_jax(learner.policies())] * self.groups for learner in self.learning]
        seats += [[teams[t] for teams in self.frozen] for t in range(len(seats), len(self.learners))]
        return seat(self.ground.arena.teams, seats)

    def batch(self, team: int, trajectory: Trajectory, worlds: slice | np.ndarray = slice(None)) -> Batch:
        """What a team learns from."""
        shaping = 1.0  # the whole dense reward, as at the start of a league
        return team_batch(trajectory, self.ground.arena.teams[team], team, worlds, shaping)

    def roll(self, now: Worlds, key: Array) -> tuple[Worlds, Trajectory]:
        """A rollout with the policies as they were seated last."""
        return self.ground.rollout(self.seated, now, key)

    def learn(self, now: Worlds, key: Array) -> tuple[Worlds, Trajectory]:
        """A rollout and the updates after it."""
        now, trajectory = self.roll(now, key)
        batches = [self.batch(team, trajectory) for team in range(len(self.learning))]
        self._studies([Study(*each) for each in zip(self.learning, batches, strict=True)])
        self.seated = self._seated()
        return now, trajectory

    def play(self, how: Verb) -> np.ndarray:
        """Go on by `roll` or `learn`; seconds (wall, CPU)."""
        key = next(self._keys)
        vars(self).pop("trajectory", None)  # training never has two of them
        jax.block_until_ready((self.now, key))
        began = clocks()
        self.now, self.trajectory = jax.block_until_ready(how(self.now, key))
        jax.block_until_ready(self.seated)
        return clocks() - began

    def beside_bare(self, how: Verb) -> dict:
        """The same beside the bare engine."""
        took: dict[str, list[np.ndarray]] = {"whole": [], "bare": []}
        for _ in range(self.ground.repeats + 1):
            stretch = self.ground.pair.stretch(how, self.now, next(self._keys))
            self.now = stretch.worlds
            took["whole"].append(stretch.whole)
            took["bare"].append(stretch.bare)
        seconds = {name: np.array(each[1:]) for name, each in took.items()}
        return speeds(seconds, self.worlds * self.ground.steps) | ratio(seconds["bare"], seconds["whole"])


def turns(parts: Mapping[str, Callable[[], np.ndarray]], repeats: int) -> dict[str, np.ndarray]:
    """Seconds (repeats, 2), wall and CPU, of parts that take turns; their first ones compile and are left out."""
    took = np.array([[part() for part in parts.values()] for _ in range(repeats + 1)])[1:]
    return {name: took[:, i] for i, name in enumerate(parts)}


def timed(verb: Callable[[], object], before: Callable[[], object] = lambda: None) -> np.ndarray:
    """Seconds (wall, CPU) until all that it gives is there."""
    before()
    began = clocks()
    jax.block_until_ready(verb())
    return clocks() - began


def ratio(top: np.ndarray, bottom: np.ndarray) -> dict:
    """Of seconds (repeats, 2): pair by pair, by the wall's clock and of CPU time."""
    found = np.divide(top, bottom)
    return {"ratio": spread(found[:, 0]), "ratio_of_cpu_time": spread(found[:, 1])}


def speeds(seconds: Mapping[str, np.ndarray], steps: int) -> dict:
    """Control steps/s."""
    return {"steps_per_second": {name: spread(steps / each[:, 0], 0) for name, each in seconds.items()}}
