"""Schedules as values: which team learns when, when a snapshot is due, and which pairs should be rated next."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np

from matchmaking.ladder import Ladder
from matchmaking.payoff import Payoff, Score, score_interval
from matchmaking.ratings import ELO
from storage.records import Phase

Kind = Literal["simultaneous", "leapfrog", "ladder", "frozen"]


@dataclass(frozen=True)
class Schedule:
    """Which teams learn: all of them, one after the other, or one alone, whom the others copy now and then or never."""

    kind: Kind = "simultaneous"
    """simultaneous: every team learns; leapfrog: the teams take turns; ladder: only `learner` learns, and after each
    period the other teams take over its policies; frozen: only `learner` ever learns."""

    period: int = 50
    """Leapfrog: learning iterations in a team's turn. Ladder: between two copies."""

    period_steps: int | None = None
    """The same in environment steps (decisions × worlds), as HARL counts: it ends after the first iteration by which
    the team has learnt in it from so many (none: by `period`)."""

    until_score: float | None = None
    """Leapfrog: a team's turn also ends as soon as it surely scores more than this (none: only by period): when the
    95 % interval of its score in training begins above it, over the turn's newest iterations of 500 episodes in all."""

    learner: int = 0
    """The team that learns first (leapfrog) or alone (ladder, frozen), counted from 0."""

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ValueError(f"kind is {self.kind!r}; choose one of {', '.join(get_args(Kind))}")
        if self.period < 1:
            raise ValueError(f"period is {self.period}; a turn lasts 1 iteration or more")
        if self.period_steps is not None and self.period_steps < 1:
            raise ValueError(f"period_steps is {self.period_steps}; a turn lasts 1 environment step or more")
        if self.until_score is not None and not 0 < self.until_score < 1:
            raise ValueError(f"until_score is {self.until_score}; a score lies between 0 and 1, e.g. 0.7")
        if self.until_score is not None and self.kind != "leapfrog":
            raise ValueError(f"until_score ends a turn of leapfrog, and kind is {self.kind!r}")
        if self.learner < 0:
            raise ValueError(f"learner is {self.learner}; it is a team's number, counted from 0")

    @property
    def adds_up(self) -> bool:
        """Whether a group has learnt for the sum of its players' own counts of steps and seconds, which grow in turn.

        Else for the largest: they grow together, or are the learner's that were copied.
        """
        return self.kind in ("leapfrog", "frozen")


class Learnt(NamedTuple):
    """How much a player has learnt, by its own counts: they grow only while it learns."""

    iterations: int = 0
    steps: int = 0  # environment steps: decisions × worlds
    low: float = 0.0  # the lower end of its score's interval in the turn that is under way, see `turn_score`


WINDOW = 500  # episodes: a score of 0.7 over so many is known to ± 0.04


def turn_score(results: Sequence[tuple[float, float]]) -> Score:
    """A learner's score of late, with its 95 % interval, by the episodes that ended and their mean score.

    Args:
        results: (episodes, score) of each iteration of its turn, oldest first. The newest of them that have WINDOW
            episodes in all are looked at, for the policy of before is another; all where there are fewer.

    Every game counts as decisive, which makes the interval wider where some are drawn. It is one of a single look: a
    turn in which it is looked at after each iteration ends a little early now and then, as early as its luck has it.
    """
    episodes = points = 0.0
    for number, score in reversed(results):
        if episodes >= WINDOW:
            break
        episodes, points = episodes + number, points + number * score
    low, high = score_interval(points, 0, episodes - points)
    return Score(points / episodes if episodes else math.nan, float(low), float(high), round(episodes))


def first_phase(
    schedule: Schedule, league: str, group: str, able: Mapping[int, str], learnt: Mapping[str, Learnt]
) -> Phase:
    """The phase in which a group of players begins.

    Args:
        schedule: who learns when.
        league: the league's name.
        group: the name of the group whose players learn together.
        able: team -> the group's player in it; a player that is paused is left out, and so never learns.
        learnt: player -> how much it has learnt by now, for every player of the group, paused or not.
    """
    return _phase(schedule, league, group, 0, able, learnt, _counted(schedule, None, able, learnt))


def next_phase(schedule: Schedule, phase: Phase, able: Mapping[int, str], learnt: Mapping[str, Learnt]) -> Phase | None:
    """The phase that follows now; None while `phase` goes on. Arguments are those of `first_phase`.

    A phase ends by what its `until` says, when one of its learners is paused, and when the schedule no longer fits it,
    be it that a paused player goes on or that the settings were changed. In leapfrog the turn passes to the next team;
    a learner that can go on no longer hands over to whoever has learnt least. In ladder the same team learns on; the
    end of a phase is when the others take over its policies. Where nobody can learn, the phase that follows has no
    learners, and lasts until somebody can.
    """
    counted = _counted(schedule, phase, able, learnt)
    if (counted,) == phase.learners and remaining(phase, learnt):
        return None  # its turn goes on
    following = _phase(schedule, phase.league, phase.group, phase.number + 1, able, learnt, counted)
    lasts = not following.until and not phase.until
    return None if lasts and following.learners == phase.learners else following


def remaining(phase: Phase, learnt: Mapping[str, Learnt]) -> int | None:
    """How much the phase's one learner still has to learn, by its own counts; None where nothing is counted.

    In environment steps where `phase.until` names a step, else in iterations; nothing once it scores what is asked.
    """
    if not phase.until:
        return None
    (learner,) = phase.learners
    now = learnt.get(learner, Learnt())
    if now.low > phase.until.get("score", 1.0):
        return 0
    if "step" in phase.until:
        return max(0, phase.until["step"] - now.steps)
    return max(0, phase.since.get(learner, 0) + phase.until["iterations"] - now.iterations)


def _counted(
    schedule: Schedule, phase: Phase | None, able: Mapping[int, str], learnt: Mapping[str, Learnt]
) -> str | None:
    """Who learns until a count is reached, in a schedule that has such phases, if anybody can."""
    match schedule.kind:
        case "leapfrog":
            return _leaper(schedule, phase, able, learnt)
        case "ladder":
            return able.get(schedule.learner)
        case "simultaneous" | "frozen":
            return None


def _leaper(
    schedule: Schedule, phase: Phase | None, able: Mapping[int, str], learnt: Mapping[str, Learnt]
) -> str | None:
    """Whose turn it is in leapfrog, if anybody can learn."""
    if phase is None or not phase.until:  # the first one, another schedule's, or one of nobody: begin
        return able.get(_next_team(schedule.learner, able))
    now = next((team for team, player in able.items() if player in phase.learners), None)
    if now is None:
        order = sorted(able, key=lambda team: (learnt.get(able[team], Learnt()), team < schedule.learner, team))
        return able[order[0]] if order else None
    return able[now] if remaining(phase, learnt) else able[_next_team(now + 1, able)]


def _phase(
    schedule: Schedule, league: str, group: str, number: int, able: Mapping[int, str], learnt: Mapping[str, Learnt],
    counted: str | None,
) -> Phase:  # fmt: skip
    """A phase that begins now; in leapfrog and ladder `counted` learns, if anybody can."""
    match schedule.kind:
        case "simultaneous":
            learners = tuple(able[team] for team in sorted(able))
        case "frozen":
            learners = (able[schedule.learner],) if schedule.learner in able else ()
        case "leapfrog" | "ladder":
            learners = () if counted is None else (counted,)
    until = {} if counted is None else _until(schedule, learnt.get(counted, Learnt()))
    return Phase(league, group, number, learners, {name: each.iterations for name, each in learnt.items()}, until)


def _until(schedule: Schedule, start: Learnt) -> dict[str, float]:
    """What ends a turn that begins now: so many iterations after `start`, or the step that its player then reaches.

    And, where the schedule has one, a score, whichever comes first.
    """
    score = {} if schedule.until_score is None else {"score": schedule.until_score}
    if schedule.period_steps is None:
        return {"iterations": schedule.period, **score}
    return {"step": start.steps + schedule.period_steps, **score}


def _next_team(start: int, able: Mapping[int, str]) -> int:
    """The first team from `start` on, counted round, that has somebody who can learn; -1 without any."""
    return min(able, key=lambda team: (team < start, team), default=-1)


def next_due(iteration: int, per_doubling: int = 1) -> int:
    """The first iteration after `iteration` at which a snapshot is due: ⌊2^(m/r)⌉ for whole m, r = `per_doubling`.

    With r = 1 these are 1, 2, 4, 8, ...: learning is fast at first, and a history of n iterations is told by about
    r log2(n) snapshots. The initial snapshot is iteration 0.
    """
    if per_doubling < 1:
        raise ValueError(f"per_doubling is {per_doubling}; it must be 1 or more")
    m = max(math.floor(per_doubling * math.log2(max(iteration, 1))) - 1, 0)
    while (due := round(2 ** (m / per_doubling))) <= iteration:
        m += 1
    return due


def pairings(
    ladder: Ladder,
    candidates: Sequence[str],
    *,
    quota: int,
    per_batch: int,
    always: Mapping[str, Sequence[str]] | None = None,
    may_meet: Callable[[str, str], bool] = lambda a, b: True,
    kinds: Mapping[str, str] | None = None,
) -> list[tuple[str, str]]:
    """The pairs of snapshots to be rated next, most useful first.

    Again and again the candidate with the fewest episodes is chosen, the newest of those if they tie: everything plays
    something before anything plays much. Its opponent is the first of its `always` list that it has not met for
    `quota` episodes, else the candidate of whom a game tells most about the gap: a game's information is the variance
    of its score, p(1-p), and what it adds to the knowledge of a gap of variance V grows with p(1-p) V (expected
    information gain, Lindley 1956). That prefers equals over the far, and the unknown over the known.
    A planned pair counts as `quota` episodes for the rest of the batch, and as the information that they will give.
    Ties go to the newest, so the same arguments always give the same plan. Void episodes count as played, lest a pair
    that always fails be planned for ever. Where every pair has its quota, nothing is fitted.

    Args:
        ladder: what has been played, with a place for all names used here.
        candidates: snapshots that want a rating, oldest first.
        quota: episodes after which a pair is played enough.
        per_batch: at most so many pairs.
        always: snapshot -> opponents that it shall meet first, e.g. its player's initial snapshot, in order.
        may_meet: whether two snapshots can play each other at all, e.g. by their rosters; symmetric.
        kinds: snapshot -> its kind, where that decides who may meet: then one of each is asked for all.

    Returns:
        pairs (candidate, opponent), no pair twice and no one against itself; empty once every pair has its quota.
    """
    payoff = ladder.payoff
    newest_first = [payoff.index(name) for name in reversed(candidates)]
    first_of = {payoff.index(a): [payoff.index(b) for b in others] for a, others in (always or {}).items()}
    wanted = _wanted(payoff, newest_first, first_of, quota)
    wanted &= _able(payoff.names, wanted, kinds or {}, may_meet)
    if not wanted.any():
        return []
    knowledge = _Knowledge(ladder)
    effort = payoff.episodes.sum(1).astype(float)

    def opponent(i: int) -> int:
        required = [j for j in first_of.get(i, ()) if wanted[i, j]]
        return required[0] if required else knowledge.most_telling(i, [j for j in newest_first if wanted[i, j]])

    plan: list[tuple[str, str]] = []
    while len(plan) < per_batch and wanted.any():
        # The first of the newest among those of least effort; a candidate whose list asks for nobody is left out.
        i = min((i for i in newest_first if wanted[i].any()), key=effort.__getitem__)
        j = opponent(i)
        plan.append((payoff.names[i], payoff.names[j]))
        effort[[i, j]] += quota
        wanted[[i, j], [j, i]] = False  # never twice in a batch
        knowledge.expect(i, j, quota)
    return plan


def _wanted(
    payoff: Payoff,
    candidates: Sequence[int],
    always: Mapping[int, Sequence[int]],
    quota: int,
) -> np.ndarray:
    """(P, P) Whether candidate i asks for j: one it may choose, and has not met for `quota` episodes."""
    wanted = np.zeros(payoff.episodes.shape, bool)
    wanted[np.ix_(candidates, candidates)] = True
    for i in candidates:
        wanted[i, list(always.get(i, ()))] = True
    np.fill_diagonal(wanted, False)
    return wanted & (payoff.episodes < quota)


def _able(
    names: Sequence[str], wanted: np.ndarray, kinds: Mapping[str, str], may_meet: Callable[[str, str], bool]
) -> np.ndarray:
    """(P, P) Who may meet whom, of those that are wanted. A snapshot without a kind is one of its own."""
    _, first, kind = np.unique([kinds.get(name, name) for name in names], return_index=True, return_inverse=True)
    met = np.zeros((len(first), len(first)), bool)
    i, j = np.nonzero(wanted)
    met[kind[i], kind[j]] = True
    for a, b in np.argwhere(met).tolist():
        met[a, b] = may_meet(names[int(first[a])], names[int(first[b])])
    return met[kind[:, None], kind]


class _Knowledge:
    """What is known of the gaps between snapshots, and will be once the planned games have been played."""

    def __init__(self, ladder: Ladder):
        chance = ladder.ratings.expected_scores()
        self._information = chance * (1 - chance)  # of one game, in (log odds)⁻²
        self._covariance = ladder.ratings.covariance / ELO**2

    def most_telling(self, i: int, others: Sequence[int]) -> int:
        """Of whom one game against i tells most; the first of them if they tie."""
        c = self._covariance
        gain = self._information[i] * (c[i, i] + np.diag(c) - 2 * c[i])
        rounded = np.round(gain, 6)  # so that the last bits of the linear algebra do not break ties
        return max(others, key=rounded.__getitem__)

    def expect(self, i: int, j: int, games: int) -> None:
        """Count on so many games between i and j, by the Sherman-Morrison formula."""
        shared = self._covariance[i] - self._covariance[j]
        expected = games * self._information[i, j]
        self._covariance = self._covariance - np.outer(shared, shared) * expected / (
            1 + expected * (shared[i] - shared[j])
        )
