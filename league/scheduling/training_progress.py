"""Progress of a league's training, computed once per planning pass and read by both schedulers.

`measure` is a pure function of the settings and of the league's state. `league/scheduling/turn_scheduler.py` reads
which groups need a turn, `league/scheduling/match_scheduler.py` whether any player still trains.

A group's training ends when its budget is spent or its players have learnt enough. A snapshot counts for that after
`rating.episodes_per_pair` episodes that measure progress: alone in an arena of one team, else against each of its
initial opponents or of the scripts of `budget.against`. Its score is the mean of those against each, so it does not
depend on whom it met first or most. An opponent in a match that was set aside for good is not awaited. The best
snapshot has the highest lower end of the 95 % interval, since the highest of many scores is often due to luck. There
all its games count as independent: the interval that is shown takes account of seed pairs, by their variance, of which
games that were all won have none, so there they would count for less than if one had been drawn.
"""

import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from league.config.experiment import Config
from league.config.sections import Budget, Rating
from league.scheduling.progress_metrics import budget_opponents
from league.state.jobs import TrainingTurn, decode, pairs_failed_alone
from league.state.league_state import Group, LeagueState
from matchmaking.ratings.ladder import Ladder
from matchmaking.ratings.scores import Score, wilson
from matchmaking.roles import Role
from matchmaking.schedule import LearningCounts, current_phase, remaining
from storage.records import Checkpoint, Phase, Player, Snapshot

HALF = 0.5
"""Lower end of the interval above which a constant score is a plateau; below, the player has not begun to learn."""
LAST = 2
"""Number of newest snapshots of which one must be rated before an older one counts as better: else ratings lag."""


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
        """Number of setbacks of the players that learn, which changes the random numbers of a repeated turn.

        A paused player keeps its setbacks, and the turns of the others do not repeat anything.
        """
        return sum(p.setbacks for p in self.players if p.paused is None)

    @property
    def setbacks(self) -> int:
        """Number of setbacks of all players of the group, which never falls before one of them has learnt again."""
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
    groups = {}
    for group in state.learning_groups(config.training.schedule):
        groups[group.name] = _measure_group(config, state, group, [turn for turn in failed if turn.group == group.name])
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


# Learnt enough --------------------------------------------------------------------------------------------------------


class Rated(NamedTuple):
    """A snapshot, and its success rate alone or its mean score against the opponents that measure progress."""

    snapshot: Snapshot
    score: Score
    opponents: Sequence[Snapshot] = ()  # none in an arena of one team

    def __str__(self) -> str:
        """Return the rating as a sentence, e.g. `blue@64 scores 83 % (80-86 %) against its initial snapshot`."""
        return f"{self.snapshot.name} {self.in_words}"

    @property
    def in_words(self) -> str:
        """The score and its interval in words."""
        share = f"{100 * self.score.score:.0f} % ({100 * self.score.low:.0f}-{100 * self.score.high:.0f} %)"
        if not self.opponents:
            return f"succeeds in {share}"
        if all(o.player == self.snapshot.player for o in self.opponents):
            return f"scores {share} against its initial snapshot"
        if any(o.player for o in self.opponents):
            return f"scores {share} against initial opponents"
        return f"scores {share} against {', '.join(o.name for o in self.opponents)}"


def rated(state: LeagueState, player: str, quota: int, against: Sequence[str] = ()) -> list[Rated]:
    """Return a player's snapshots that have played their quota, with their scores, oldest first.

    `against` is the setting `budget.against`.
    """
    ladder, found, never = state.ladder, [], pairs_failed_alone(state.jobs)
    for snapshot in state.history(player):
        if snapshot.name not in ladder.payoff.positions:
            continue
        opponents = []
        if state.one_team:
            score = ladder.success(snapshot.name) if ladder.trial_episodes(snapshot.name) >= quota else None
        else:
            opponents = _met(ladder, snapshot, budget_opponents(against, state, snapshot), quota, never)
            score = ladder.mean_score(snapshot.name, *(o.name for o in opponents))
        if score is not None and score.games:
            found.append(Rated(snapshot, score, opponents))
    return found


def _met(
    ladder: Ladder, snapshot: Snapshot, opponents: Sequence[Snapshot], quota: int, never: Container[frozenset[str]]
) -> list[Snapshot]:
    """Return the opponents that a snapshot has valid games with; none until it has met all of them for the quota.

    The pairs `never` are in matches that were set aside for good: they are not awaited.
    """
    known = [o for o in opponents if o.name in ladder.payoff.positions]
    own, at = (np.array([ladder.payoff.index(s.name) for s in some], int) for some in ([snapshot], known))
    episodes = dict(zip(known, ladder.payoff.episodes_between(own, at).tolist(), strict=True))
    met = [o for o in opponents if episodes.get(o, 0) >= quota]
    if any(o not in met and frozenset((snapshot.name, o.name)) not in never for o in opponents):
        return []
    return [o for o in met if ladder.score(snapshot.name, o.name).games]


def best(found: Sequence[Rated]) -> Rated | None:
    """Return the snapshot with the highest lower end, the newest of equal ones; None if `found` is empty."""
    return max(found, key=lambda each: (_surely(each), each.snapshot.iteration), default=None)


def _surely(found: Rated) -> float:
    """Return what a snapshot scores at least, by which snapshots are compared; a game won more never lowers it."""
    return float(wilson(found.score.score, found.score.games, 0.95)[0])


def why(budget: Budget, quota: int, state: LeagueState, player: Player) -> str | None:
    """Return the evidence that a player has learnt what its budget requires, as a sentence; None without evidence."""
    found = rated(state, player.name, quota, budget.against)
    if not found:
        return None
    asked = budget.success if state.one_team else budget.score
    if asked is not None and (top := max(found, key=lambda each: each.score.low)).score.low > asked:
        return str(top)
    first = max(found, key=_surely)  # the oldest of equal ones: those after it are no better
    later = sum(each.snapshot.iteration > first.snapshot.iteration for each in found)
    if budget.plateau is not None and first.score.low > HALF and later >= budget.plateau:
        return f"{first}, and none of the {later} snapshots after it is better"
    return None


def learnt_enough(config: Config, state: LeagueState, players: Sequence[Player]) -> bool:
    """Return whether these players have learnt what the budget requires: all by ratings, or all by reward.

    Those who never learn are not asked. If nobody learns, nobody has learnt enough.
    """
    budget, asked = config.budget, learning(config, players)
    by_rating = budget.by_rating and all(
        why(budget, config.rating.episodes_per_pair, state, p) is not None for p in asked
    )
    by_reward = budget.reward is not None and all(state.rewards.get(p.name, -math.inf) >= budget.reward for p in asked)
    return bool(asked) and (by_rating or by_reward)


def learning(config: Config, players: Sequence[Player]) -> list[Player]:
    """Return those of some players who ever learn, by their roles and the schedule."""
    schedule = config.training.schedule
    return [
        p for p in players if config.role(p.role).learns and (schedule.kind != "frozen" or p.team == schedule.learner)
    ]


def handed_on(
    state: LeagueState, player: str, quota: int = Rating().episodes_per_pair, against: Sequence[str] = ()
) -> Rated | None:
    """Return the snapshot that another league starts from, if that is not the player's newest state.

    Return None if the newest rated snapshot is the best, if none of the LAST newest snapshots is rated, and if no rated
    snapshot still has its policy.
    """
    newest = {s.name for s in state.history(player)[-LAST:]}
    found = rated(state, player, quota, against)
    if not found or found[-1].snapshot.name not in newest:
        return None
    top = best([each for each in found if each.snapshot.thinned is None])
    return None if top is None or top.snapshot.name == found[-1].snapshot.name else top
