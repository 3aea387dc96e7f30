"""Progress of a league's training, computed once per planning pass and read by both schedulers.

`measure` is a pure function of the settings and of the league's state. `league/scheduling/turn_scheduler.py` reads
which groups need a turn, `league/scheduling/match_scheduler.py` whether any player still trains.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from league.config.experiment import Config
from league.scheduling.stage_completion import learnt_enough
from league.state.jobs import TrainingTurn, decode
from league.state.league_state import Group, LeagueState
from matchmaking.roles import Role
from matchmaking.schedule import LearningCounts, current_phase, remaining
from storage.records import Checkpoint, Phase, Player, Snapshot


class Learner(NamedTuple):
    """A player that learns in the next turn, with the settings and the state that the turn depends on."""

    player: Player
    role: Role
    checkpoint: Checkpoint
    history: Sequence[Snapshot]  # its snapshots, oldest first
    reset: Snapshot | None  # after which it was last reset: only games after it count


@dataclass(frozen=True)
class GroupProgress:
    """Training progress of the players of one group."""

    players: Sequence[Player]
    seconds: float  # of training under this schedule
    steps: int  # environment steps of that training
    finished: bool  # the budget is spent, no player can learn, or the next turn was set aside
    phase: Phase | None = None  # of the next turn; None if none follows, or if the first turn has to make players
    remaining: int | None = None  # iterations or environment steps that are left in that phase, if it counts any
    learners: Sequence[Learner] = ()  # in that phase

    @property
    def retry(self) -> int:
        """Number of setbacks of the group's players, which changes the random numbers of a repeated turn."""
        return sum(p.setbacks for p in self.players)


@dataclass(frozen=True)
class TrainingProgress:
    """Training progress of all groups of a league."""

    groups: Mapping[str, GroupProgress]
    open: frozenset[str]  # groups that have a queued or leased turn

    @property
    def seconds(self) -> float:
        """Seconds that devices have trained for: the sum over groups, each of which has a device to itself."""
        return sum(group.seconds for group in self.groups.values())

    @property
    def finished(self) -> bool:
        """Return whether no player will learn any more under these settings."""
        return all(group.finished for group in self.groups.values())

    @property
    def training(self) -> bool:
        """Return whether a turn is open, or another turn follows."""
        return bool(self.open) or not self.finished


def measure(config: Config, state: LeagueState) -> TrainingProgress:
    """Compute the training progress of each group from the settings and the league's state."""
    turns = [(job.state, decode(job)) for job in state.jobs if job.kind == TrainingTurn.kind]
    opened = frozenset(t.group for status, t in turns if status != "failed" and isinstance(t, TrainingTurn))
    failed = [turn for status, turn in turns if status == "failed" and isinstance(turn, TrainingTurn)]
    groups = {
        group.name: _measure_group(config, state, group, [turn for turn in failed if turn.group == group.name])
        for group in state.learning_groups(config.training.schedule)
    }
    return TrainingProgress(groups, opened)


def trained_enough(config: Config, state: LeagueState) -> bool:
    """Return whether no player will learn any more under these settings."""
    return measure(config, state).finished


def _measure_group(config: Config, state: LeagueState, group: Group, failed: Sequence[TrainingTurn]) -> GroupProgress:
    """Compute the progress of one group; `failed` are its turns that were set aside."""
    name, players, seconds, steps, phase, histories = group
    if any(p.name not in state.checkpoints for p in players):
        return GroupProgress(players, seconds, steps, finished=any(not turn.iterations for turn in failed))
    counts = learning_counts(state, players)
    if config.budget.spent(seconds, steps) or learnt_enough(config, state, players):
        return GroupProgress(players, seconds, steps, finished=True)
    able = {p.name: role for p in players if p.paused is None and (role := config.role(p.role)).learns}
    phase = current_phase(
        config.training.schedule,
        config.league,
        name,
        phase,
        {p.team: p.name for p in players if p.name in able},
        counts,
    )
    learners = [
        Learner(p, role, state.checkpoints[p.name], history, role.last_reset(config.seed, p.name, history))
        for p, history in zip(players, histories, strict=True)
        if p.name in phase.learners and (role := able.get(p.name)) is not None
    ]
    bases = {each.player.name: each.checkpoint.digest for each in learners}
    progress = GroupProgress(players, seconds, steps, not learners, phase, remaining(phase, counts), learners)
    set_aside = any(bases.items() <= turn.bases.items() and turn.retry == progress.retry for turn in failed)
    return replace(progress, finished=True) if set_aside else progress


def learning_counts(state: LeagueState, players: Sequence[Player]) -> dict[str, LearningCounts]:
    """Return how far each player has come, by its checkpoint and by the lower end of its score in this phase."""
    low = {name: score.low for name, score in state.scores.items()}
    at = {p.name: state.checkpoints[p.name] for p in players}
    return {name: LearningCounts(each.iteration, each.step, low.get(name, 0.0)) for name, each in at.items()}
