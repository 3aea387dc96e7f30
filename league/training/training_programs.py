"""Compiled programs of training: beginning worlds, restarting some of them, and the rollout."""

from typing import NamedTuple

from agents.rollout.new_worlds import make_reset, make_restart
from agents.rollout.rollout import make_rollout
from arenas.arena import Arena
from league.config.experiment import Config
from league.scheduling.episode_lengths import settles
from league.system.compiled import Compiled


class _Setting(NamedTuple):
    """The settings on which the programs depend."""

    rollout: int  # decisions
    stagger: bool
    settle: bool  # episodes of new worlds do not count at first: those that end first are the short ones
    sequence: int | None  # decisions of a chunk of recurrent learning
    privileged: bool

    @classmethod
    def of(cls, config: Config, arena: Arena) -> "_Setting":
        training, learner = config.training, config.learner
        settle, privileged = settles(config, arena.timing.decisions), learner.critic_input == "privileged"
        return cls(training.rollout_length, training.stagger, settle, learner.sequence, privileged)


class TrainingPrograms:
    """Programs of training in one arena, compiled for each shape of their arguments at their first use.

    They depend on the arena and on some settings, but on no learner, so one value serves all trainers of a process that
    have the same arena and settings.
    """

    def __init__(self, config: Config, arena: Arena):
        arena.engine.compile_ahead()  # while learners are made and programs are traced
        self.arena, self._setting = arena, _Setting.of(config, arena)
        rollout, stagger, settle, sequence, privileged = self._setting
        self.reset, self.restart = make_reset(arena, stagger, settle), make_restart(arena, stagger, settle)
        self.rollout = Compiled(make_rollout(arena, rollout, sequence, privileged), arena)

    def fit(self, config: Config, arena: Arena) -> bool:
        """Return whether programs made for these settings and this arena would be the same."""
        return self.arena is arena and self._setting == _Setting.of(config, arena)
