"""Schedule training turns: pure functions from the settings and the league's state to the next jobs.

No process holds the plan. The manager computes it again and again. A job's key describes its purpose, and the store
queues each key once, so computing a plan twice does no harm. A job that was set aside is not queued again.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from league.config.experiment import Config
from league.scheduling import training_progress
from league.scheduling.episode_lengths import longest_episode
from league.scheduling.opponent_sampling import opponent_distribution, table_pairs
from league.scheduling.population import copy_now
from league.scheduling.training_progress import GroupProgress, Learner, TrainingProgress
from league.state.jobs import TrainingTurn, decode, encode, pairs_failed_alone
from league.state.league_state import LeagueState
from matchmaking.opponents import Opponents
from matchmaking.schedule import next_due
from storage.records import Job, Phase, Player

AHEAD, BEHIND = 2, 4
"""A group keeps its worker until it is so many of the longest episodes ahead of another that waits, or behind it."""

Assignments = tuple[tuple[str, ...], ...]  # for each group of worlds the snapshot or player of every team
Chances = dict[str, tuple[float, int]]  # snapshot -> the chance with which it was drawn, and out of how many


@dataclass(frozen=True)
class Plan:
    """Jobs to queue, the phases of schedules that they belong to, and the pairs without
    whose matches a turn cannot begin.
    """

    jobs: tuple[Job, ...] = ()
    phases: tuple[Phase, ...] = ()
    awaited: tuple[tuple[str, str], ...] = ()


def next_turns(config: Config, state: LeagueState, progress: TrainingProgress | None = None) -> Plan:
    """Return a turn for every group that has none open and is not finished; the first turn only makes the players.

    A group whose opponents are drawn from a payoff table that is to be complete has no turn until it is: the pairs
    that have to meet are in the plan.

    `progress` is the training progress of this planning pass, by default computed here.
    """
    progress = progress or training_progress.measure(config, state)
    jobs, phases, awaited = [], [], dict[tuple[str, str], None]()
    for name in _next_groups(config, progress):
        group = progress.groups[name]
        if missing := _awaited(config, state, group):
            awaited |= dict.fromkeys(missing)
            continue
        turn = (
            _first_turn(state, name, group) if group.phase is None else _turn(config, state, name, group, group.phase)
        )
        # The number of iterations is in the key: a turn that a smaller budget cut short differs from its continuation.
        # All setbacks are in it too, and not `turn.retry`, which is 0 again once the critic of a resting player has
        # paused that player: such a turn has the learners and the bases of one that is done.
        about = [name, turn.phase, turn.learners, turn.iterations, dict(turn.bases), group.setbacks]
        jobs.append(encode(config.league, turn, about, priority=1))
        phases += [group.phase] if group.phase is not None else []
    return Plan(tuple(jobs), tuple(phases), tuple(awaited))


def continued_turn(
    config: Config, state: LeagueState, planned: Sequence[Job], kept: Mapping[str, Mapping[str, str]], longest: int
) -> str | None:
    """Return the key of the turn that a worker takes before older ones, because it has its worlds; None: the oldest.

    It is that of the least trained of its groups, unless another group that waits is too far behind, or so far before
    that this worker is too slow for its own: no group waits or lags for ever. A worker that is alone keeps all worlds.

    Args:
        config: the league's settings.
        state: the league at the end of the worker's last turn.
        planned: jobs that are not in `state` yet.
        kept: of each group whose worlds the worker has: the digests of the players' checkpoints at that moment.
        longest: decisions of the arena's longest episode.
    """
    jobs = [job for job in (*state.jobs, *planned) if job.kind == TrainingTurn.kind]
    if config.deterministic or not any(job.state == "leased" for job in jobs):
        return None
    own, at = dict[str, str](), dict[str, int]()
    for job in jobs:
        if job.state == "queued" and isinstance(turn := decode(job), TrainingTurn):
            at[turn.group] = state.iterations(turn.group, config.training.schedule)
            if turn.bases == kept.get(turn.group):
                own[turn.group] = job.key
    unit = max(longest / config.training.rollout_length, config.training.iterations_per_turn)  # turns may be longer
    others = [at[group] for group in at.keys() - own]
    fair = [group for group in own if all(-BEHIND * unit < at[group] - other < AHEAD * unit for other in others)]
    return own[min(fair, key=at.__getitem__)] if fair else None


def _awaited(config: Config, state: LeagueState, group: GroupProgress) -> list[tuple[str, str]]:
    """Return the pairs that have to meet before a group's next turn; none if its rules do not wait for matches.

    A pair in a match that was set aside for good is not awaited.
    """
    missing: dict[frozenset[str], tuple[str, str]] = {}
    payoff, quota = state.ladder.payoff, config.rating.episodes_per_pair
    for learner in group.learners:
        rule = learner.role.opponents
        if rule is None or not rule.await_matches:
            continue
        for team in {p.team for p in state.players} - {learner.player.team}:
            pairs = table_pairs(rule, state, learner.player, team, learner.role)
            first, second = np.array([[payoff.index(name) for name in pair] for pair in pairs], int).reshape(-1, 2).T
            for at in np.flatnonzero(payoff.episodes_between(first, second) < quota).tolist():
                missing.setdefault(frozenset(pairs[at]), pairs[at])
    never = pairs_failed_alone(state.jobs) if missing else set()
    return [pair for names, pair in missing.items() if names not in never]


def _next_groups(config: Config, progress: TrainingProgress) -> list[str]:
    """Return the groups whose turn is planned now.

    All players are made before any of them learns, because each may meet all others. In a deterministic league the
    groups take turns, fewest steps first, so that opponents do not depend on timing.
    """
    able = [name for name, group in progress.groups.items() if not group.finished]
    able = [name for name in able if progress.groups[name].phase is None] or able
    if not config.deterministic:
        return [name for name in able if name not in progress.open]
    return sorted(able, key=lambda name: progress.groups[name].steps)[:1] if not progress.open else []


def _first_turn(state: LeagueState, name: str, group: GroupProgress) -> TrainingTurn:
    new = [p for p in group.players if p.name not in state.checkpoints]
    teams = 1 + max(p.team for p in state.players)
    return TrainingTurn(
        name, -1, tuple(p.name for p in new), _seats(new, teams), {p.name: "" for p in new}, 0, {}, {}, group.retry
    )


def _turn(config: Config, state: LeagueState, name: str, group: GroupProgress, phase: Phase) -> TrainingTurn:
    seats = _seats(group.players, 1 + max(p.team for p in state.players))
    met = {learner.player.name: _opponents(config, state, learner, seats) for learner in group.learners}
    return TrainingTurn(
        name,
        phase.number,
        tuple(met),
        seats,
        {p.name: state.checkpoints[p.name].digest for p in group.players},
        _iterations(config, group, phase),
        {learner: assignments for learner, (assignments, _) in met.items()},
        {learner: chances for learner, (_, chances) in met.items()},
        group.retry,
        {p.name: copy for p, *_ in group.learners if (copy := copy_now(config, state, p))},
    )


def _iterations(config: Config, group: GroupProgress, phase: Phase) -> int:
    """Return the length of a turn: until a snapshot is due, the phase or the step budget ends, or the longest turn.

    If every machine chooses its number of worlds, limits in steps are left out here: the trainer checks them after
    each iteration.
    """
    training, limits, steps = config.training, [config.training.iterations_per_turn], []
    for _, role, at, history, _ in group.learners:
        if role.timeout is not None:
            steps.append(role.steps_left(history[-1].step, at.step) or 0)
        elif not role.has_generations:
            limits.append(next_due(at.iteration, training.snapshots_per_doubling) - at.iteration)
    if group.remaining is not None:
        (steps if "step" in phase.until else limits).append(group.remaining)
    if config.budget.steps is not None:
        steps.append(config.budget.steps - group.steps)
    if training.worlds is not None:
        limits += [-(-n // (training.worlds * training.rollout_length)) for n in steps]
    return max(1, min(limits))


def _opponents(
    config: Config, state: LeagueState, learner: Learner, seats: Sequence[str]
) -> tuple[Assignments, Chances]:
    """Draw the opponents of a learning player for the whole turn.

    A group keeps its opponent over turns (`Opponents.episodes`), unless the rule has come to draw another.

    Returns:
        For each of its groups of worlds the snapshot of every team, "" in its own team and for a present player; and
        for each snapshot the probability with which it was drawn, and the size of the pool.
    """
    player, rule = learner.player, learner.role.opponents
    assert rule is not None
    present, past = rule.split()
    if "" in seats:  # a team without a player in this group can only be its past
        present, past = 0, present + past
    if not past:
        return (), {}
    since = -1 if learner.reset is None else learner.reset.iteration
    periods = _periods(config, rule, learner.checkpoint.iteration, past)
    assignments, chances = [[""] * len(seats) for _ in range(past)], {}
    for team, opponent in enumerate(seats):
        if team == player.team:
            continue
        found = opponent_distribution(rule, state, player, team, opponent, learner.role, since)
        groups = [f"{config.seed}/{player.name}/{team}/{k}/{period}" for k, period in enumerate(periods)]
        for assignment, (name, chance) in zip(assignments, found.draw(groups), strict=True):
            assignment[team] = name
            if name:
                chances[name] = (chance, len(found.names))
    return tuple(map(tuple, assignments)), chances


def _periods(config: Config, rule: Opponents, iteration: int, groups: int) -> list[int]:
    """Return for each group of worlds the number of the period, at an iteration, in which it keeps its opponent.

    A period is `Opponents.episodes` of the arena's longest episodes, in whole iterations. The groups' periods begin one
    after the other, so that not all of a learner's opponents change at once.
    """
    period = max(1, math.ceil(rule.episodes * longest_episode(config) / config.training.rollout_length))
    return [(iteration + k * period // groups) // period for k in range(groups)]


def _seats(players: Sequence[Player], teams: int) -> tuple[str, ...]:
    by_team = {p.team: p.name for p in players}
    return tuple(by_team.get(team, "") for team in range(teams))
