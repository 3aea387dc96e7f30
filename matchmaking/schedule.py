"""Schedules as values: which team learns when, and when a snapshot is due."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

from matchmaking.ratings.scores import Score, score_interval
from storage.records import Phase

Kind = Literal["simultaneous", "leapfrog", "ladder", "frozen"]


@dataclass(frozen=True)
class Schedule:
    """Learning teams: all of them, one after the other, or one alone that the others copy now and then or never."""

    kind: Kind = "simultaneous"
    """simultaneous: every team learns; leapfrog: the teams take turns; ladder: only `learner` learns, and after each
    period the other teams take over its policies; frozen: only `learner` ever learns."""

    period: int = 50
    """Leapfrog: learning iterations in a team's phase. Ladder: learning iterations between two copies."""

    period_steps: int | None = None
    """Period in environment steps (decisions × worlds), as HARL counts: it ends after the iteration in which the team
    reaches so many steps (none: by `period`)."""

    until_score: float | None = None
    """Leapfrog: a team's phase also ends once it scores more than this with 95 % confidence (none: only by period). The
    score is that of training, over the phase's newest iterations of 500 episodes in all."""

    learner: int = 0
    """Number of the team that learns first (leapfrog) or alone (ladder, frozen), from 0."""

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ValueError(f"kind is {self.kind!r}; choose one of {', '.join(get_args(Kind))}")
        if self.period < 1:
            raise ValueError(f"period is {self.period}; a phase lasts 1 iteration or more")
        if self.period_steps is not None and self.period_steps < 1:
            raise ValueError(f"period_steps is {self.period_steps}; a phase lasts 1 environment step or more")
        if self.until_score is not None and not 0 < self.until_score < 1:
            raise ValueError(f"until_score is {self.until_score}; a score lies between 0 and 1, e.g. 0.7")
        if self.until_score is not None and self.kind != "leapfrog":
            raise ValueError(f"until_score ends a phase of leapfrog, and kind is {self.kind!r}")
        if self.learner < 0:
            raise ValueError(f"learner is {self.learner}; it is a team's number, counted from 0")

    @property
    def sums_counts(self) -> bool:
        """True if a group has learnt for the sum of its players' counts of steps and seconds, which grow in turn.

        Otherwise the largest count holds: they grow together, or are copies of the learner's.
        """
        return self.kind in ("leapfrog", "frozen")


class LearningCounts(NamedTuple):
    """Amount that a player has learnt, by its own counts: they grow only while it learns."""

    iterations: int = 0
    steps: int = 0  # environment steps: decisions × worlds
    low: float = 0.0  # lower end of its score's interval in the current phase, see `phase_score`


WINDOW = 500  # episodes: they give a score of 0.7 to ± 0.04


def phase_score(results: Sequence[tuple[float, float]]) -> Score:
    """Return a learner's recent score, with its 95 % interval, from finished episodes and their mean score.

    Args:
        results: (episodes, score) of each iteration of its phase, oldest first. Only the newest with WINDOW episodes
            in all count, because the policy before was another; all count if there are fewer.

    Every game counts as decisive, which makes the interval wider if some are drawn. The interval holds for a single
    look: checked after each iteration, a phase now and then ends a little early by chance.
    """
    episodes = points = 0.0
    for number, score in reversed(results):
        if episodes >= WINDOW:
            break
        episodes, points = episodes + number, points + number * score
    low, high = score_interval(points, 0, episodes - points)
    return Score(points / episodes if episodes else math.nan, float(low), float(high), round(episodes))


def first_phase(
    schedule: Schedule, league: str, group: str, available: Mapping[int, str], learnt: Mapping[str, LearningCounts]
) -> Phase:
    """Return the first phase of a group of players.

    Args:
        schedule: which team learns when.
        league: the league's name.
        group: the name of the group whose players learn together.
        available: team -> the group's player in it; paused players are left out, and so never learn.
        learnt: player -> its counts so far, for every player of the group, paused or not.
    """
    return _phase(schedule, league, group, 0, available, learnt, _timed_learner(schedule, None, available, learnt))


def current_phase(
    schedule: Schedule, league: str, group: str, phase: Phase | None, available: Mapping[int, str],
    learnt: Mapping[str, LearningCounts],
) -> Phase:  # fmt: skip
    """Return the phase that a group is in: its newest, `phase`, or the first or next phase. Arguments are as below."""
    if phase is None:
        return first_phase(schedule, league, group, available, learnt)
    return next_phase(schedule, phase, available, learnt) or phase


def next_phase(
    schedule: Schedule, phase: Phase, available: Mapping[int, str], learnt: Mapping[str, LearningCounts]
) -> Phase | None:
    """Return the phase that follows now, or None while `phase` continues. Arguments are those of `first_phase`.

    A phase ends when its `until` is reached, when one of its learners is paused, and when the schedule no longer fits
    it, because a paused player continues or the settings changed. In leapfrog the turn passes to the next team; a
    learner that cannot continue hands over to the player with the smallest counts. In ladder the same team keeps
    learning; at the end of a phase the others take over its policies. If no player can learn, the following phase has
    no learners, and lasts until one can.
    """
    timed_learner = _timed_learner(schedule, phase, available, learnt)
    if (timed_learner,) == phase.learners and remaining(phase, learnt):
        return None  # its turn continues
    following = _phase(schedule, phase.league, phase.group, phase.number + 1, available, learnt, timed_learner)
    lasts = not following.until and not phase.until
    return None if lasts and following.learners == phase.learners else following


def remaining(phase: Phase, learnt: Mapping[str, LearningCounts]) -> int | None:
    """Return what the phase's one learner still has to learn, by its own counts; None if nothing is counted.

    In environment steps if `phase.until` names a step, else in iterations; 0 once its score suffices.
    """
    if not phase.until:
        return None
    (learner,) = phase.learners
    now = learnt.get(learner, LearningCounts())
    if now.low > phase.until.get("score", 1.0):
        return 0
    if "step" in phase.until:
        return max(0, phase.until["step"] - now.steps)
    return max(0, phase.since.get(learner, 0) + phase.until["iterations"] - now.iterations)


def _timed_learner(
    schedule: Schedule, phase: Phase | None, available: Mapping[int, str], learnt: Mapping[str, LearningCounts]
) -> str | None:
    """Return the player that learns until a count is reached, in schedules with such phases, if any can."""
    match schedule.kind:
        case "leapfrog":
            return _leapfrog_learner(schedule, phase, available, learnt)
        case "ladder":
            return available.get(schedule.learner)
        case "simultaneous" | "frozen":
            return None


def _leapfrog_learner(
    schedule: Schedule, phase: Phase | None, available: Mapping[int, str], learnt: Mapping[str, LearningCounts]
) -> str | None:
    """Return the player whose turn it is in leapfrog, if any can learn."""
    if phase is None or not phase.until:  # the first phase, one of another schedule, or one without learners
        return available.get(_next_team(schedule.learner, available))
    now = next((team for team, player in available.items() if player in phase.learners), None)
    if now is None:
        order = sorted(
            available, key=lambda team: (learnt.get(available[team], LearningCounts()), team < schedule.learner, team)
        )
        return available[order[0]] if order else None
    return available[now] if remaining(phase, learnt) else available[_next_team(now + 1, available)]


def _phase(
    schedule: Schedule,
    league: str,
    group: str,
    number: int,
    available: Mapping[int, str],
    learnt: Mapping[str, LearningCounts],
    timed_learner: str | None,
) -> Phase:
    """Return a phase that begins now; in leapfrog and ladder `timed_learner` learns, if there is one."""
    match schedule.kind:
        case "simultaneous":
            learners = tuple(available[team] for team in sorted(available))
        case "frozen":
            learners = (available[schedule.learner],) if schedule.learner in available else ()
        case "leapfrog" | "ladder":
            learners = () if timed_learner is None else (timed_learner,)
    until = {} if timed_learner is None else _until(schedule, learnt.get(timed_learner, LearningCounts()))
    return Phase(league, group, number, learners, {name: each.iterations for name, each in learnt.items()}, until)


def _until(schedule: Schedule, start: LearningCounts) -> dict[str, float]:
    """Return the end of a turn that begins now: a number of iterations after `start`, or the step that is then reached.

    Also a score, if the schedule has one; whichever comes first.
    """
    score = {} if schedule.until_score is None else {"score": schedule.until_score}
    if schedule.period_steps is None:
        return {"iterations": schedule.period, **score}
    return {"step": start.steps + schedule.period_steps, **score}


def _next_team(start: int, available: Mapping[int, str]) -> int:
    """Return the first team from `start` on, cyclically, that has an available player; -1 if there is none."""
    return min(available, key=lambda team: (team < start, team), default=-1)


def next_due(iteration: int, per_doubling: int = 1) -> int:
    """Return the first iteration after `iteration` at which a snapshot is due: ⌊2^(m/r)⌉, m whole, r = `per_doubling`.

    With r = 1 these are 1, 2, 4, 8, ...: learning is fast at first, and about r log2(n) snapshots cover a history of n
    iterations. The initial snapshot is iteration 0. Raises ValueError for r below 1.
    """
    if per_doubling < 1:
        raise ValueError(f"per_doubling is {per_doubling}; it must be 1 or more")
    m = max(math.floor(per_doubling * math.log2(max(iteration, 1))) - 1, 0)
    while (due := round(2 ** (m / per_doubling))) <= iteration:
        m += 1
    return due
