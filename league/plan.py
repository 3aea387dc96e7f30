"""What should be done next, read off the store: pure functions from what has happened to the next jobs.

The plan lives in no process. Whoever manages a league asks again and again; a job's key says what it is for, and the
store queues a key once, so that asking twice does no harm. What was set aside is not asked for again.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from zlib import crc32

import numpy as np

from league.config.experiment import Config
from league.jobs import TrainingTurn, decode, encode
from league.lives import born, steps_left
from league.measures import learnt_enough
from league.odds import odds
from league.population import copy_now
from league.standing import Standing
from matchmaking.opponents import draw
from matchmaking.schedule import Learnt, first_phase, next_due, next_phase, remaining
from storage.records import Job, Phase, Player

Lineups = tuple[tuple[str, ...], ...]  # for each group of worlds who sits in every team
Chances = dict[str, tuple[float, int]]  # snapshot -> the chance with which it was drawn, and out of how many


@dataclass(frozen=True)
class Plan:
    """What to queue: jobs, and the phases of schedules that they belong to."""

    jobs: tuple[Job, ...] = ()
    phases: tuple[Phase, ...] = ()


def spent(config: Config, standing: Standing, group: str) -> tuple[float, int]:
    """Seconds and environment steps that a group has been trained for under this schedule."""
    return standing.spent(group, config.training.schedule)


def stands_still(config: Config, standing: Standing, group: str) -> bool:
    """Whether a group has nothing to train: its budget is spent, nobody may learn, or its turn was set aside."""
    players = standing.groups[group]
    if _unmade(standing, group):
        return any(turn.group == group and not turn.iterations for turn in _turns(standing, "failed"))
    if config.budget.spent(*spent(config, standing, group)) or learnt_enough(config, standing, players):
        return True
    learners = _learners(config, players, _phase(config, standing, group))
    bases = {p.name: standing.checkpoints[p.name].digest for p in learners}
    return not learners or any(
        turn.group == group and bases.items() <= turn.bases.items() and turn.dice == _dice(players)
        for turn in _turns(standing, "failed")
    )


def trained_enough(config: Config, standing: Standing) -> bool:
    """Whether nobody will learn any more under these settings."""
    return all(stands_still(config, standing, group) for group in standing.groups)


def is_training(standing: Standing) -> bool:
    """Whether a training turn waits or is being worked on."""
    return any(True for _ in _turns(standing, "queued", "leased"))


def somebody_trains(config: Config, standing: Standing) -> bool:
    """Whether a turn is open, or another one follows."""
    return is_training(standing) or not trained_enough(config, standing)


def next_turns(config: Config, standing: Standing) -> Plan:
    """A turn for every group that has none open and is not done; the first one only makes the players."""
    jobs, phases = [], []
    for group in _next_groups(config, standing):
        players = standing.groups[group]
        if _unmade(standing, group):
            turn = _first_turn(standing, group, players)
        else:
            phase = _phase(config, standing, group)
            phases.append(phase)
            turn = _turn(config, standing, group, players, phase)
        # The number of iterations is in the key: a turn that a smaller budget cut short is not the one that goes on.
        about = [group, turn.phase, turn.learners, turn.iterations, dict(turn.bases), turn.dice]
        jobs.append(encode(config.league, turn, about, priority=1))
    return Plan(tuple(jobs), tuple(phases))


def _next_groups(config: Config, standing: Standing) -> list[str]:
    """The groups whose turn is planned now.

    All players are made before one of them learns, for each may meet all. In a deterministic league groups take turns,
    who has learnt from the fewest steps first: else whom they meet would hang on who is quicker.
    """
    busy = {turn.group for turn in _turns(standing, "queued", "leased")}
    able = [group for group in standing.groups if not stands_still(config, standing, group)]
    able = [group for group in able if _unmade(standing, group)] or able
    if not config.deterministic:
        return [group for group in able if group not in busy]
    return sorted(able, key=lambda group: spent(config, standing, group)[1])[:1] if not busy else []


def _unmade(standing: Standing, group: str) -> bool:
    return any(p.name not in standing.checkpoints for p in standing.groups[group])


def _learners(config: Config, players: Sequence[Player], phase: Phase) -> list[Player]:
    """Who of a group learns in a turn of that phase."""
    return [p for p in players if p.name in phase.learners and _able(config, p)]


def _able(config: Config, player: Player) -> bool:
    return player.paused is None and config.role(player.role).learns


def _first_turn(standing: Standing, group: str, players: Sequence[Player]) -> TrainingTurn:
    new = [p for p in players if p.name not in standing.checkpoints]
    teams = 1 + max(p.team for p in standing.players)
    return TrainingTurn(
        group, -1, tuple(p.name for p in new), _seats(new, teams), {p.name: "" for p in new}, 0, {}, {}, _dice(players)
    )


def _turn(config: Config, standing: Standing, group: str, players: Sequence[Player], phase: Phase) -> TrainingTurn:
    learners = _learners(config, players, phase)
    teams = 1 + max(p.team for p in standing.players)
    seats = _seats(players, teams)
    at = {p.name: standing.checkpoints[p.name] for p in players}
    met = {p.name: _opponents(config, standing, p, seats) for p in learners}
    return TrainingTurn(
        group,
        phase.number,
        tuple(p.name for p in learners),
        seats,
        {name: checkpoint.digest for name, checkpoint in at.items()},
        _iterations(config, standing, group, learners, phase),
        {name: lineups for name, (lineups, _) in met.items()},
        {name: chances for name, (_, chances) in met.items()},
        _dice(players),
        {p.name: copy for p in learners if (copy := copy_now(config, standing, p))},
    )


def _iterations(config: Config, standing: Standing, group: str, learners: Sequence[Player], phase: Phase) -> int:
    """A turn ends where a snapshot is due, the phase ends or enough would be lost; or with the step budget.

    Where every machine chooses its number of worlds, steps say nothing here: the trainer looks at them as it goes.
    """
    training, limits, steps = config.training, [config.training.turn], []
    for player in learners:
        role, at = config.role(player.role), standing.checkpoints[player.name]
        if role.timeout is not None:
            steps.append(steps_left(role, standing.history(player.name)[-1], at.step) or 0)
        elif not role.has_lives:
            limits.append(next_due(at.iteration, training.snapshots_per_doubling) - at.iteration)
    more = remaining(phase, _learnt(standing, learners))
    if more is not None:
        (steps if "step" in phase.until else limits).append(more)
    if config.budget.steps is not None:
        steps.append(config.budget.steps - spent(config, standing, group)[1])
    if training.worlds is not None:
        limits += [-(-n // (training.worlds * training.rollout)) for n in steps]
    return max(1, min(limits))


def _learnt(standing: Standing, players: Sequence[Player]) -> dict[str, Learnt]:
    at = {p.name: standing.checkpoints[p.name] for p in players}
    low = {name: score.low for name, score in standing.scores.items()}
    return {name: Learnt(each.iteration, each.step, low.get(name, 0.0)) for name, each in at.items()}


def _opponents(config: Config, standing: Standing, learner: Player, seats: Sequence[str]) -> tuple[Lineups, Chances]:
    """Opponents of a learning player for the whole turn, drawn at once: for each of its groups of worlds who sits in
    every team, "" in its own and where it is the present player. And with which chance, of how many, each was drawn.
    """
    opponents, role = config.opponents(learner), config.role(learner.role)
    present, past = opponents.split()
    if "" in seats:  # a team without a player in this group can only be its past
        present, past = 0, present + past
    if not past:
        return (), {}
    iteration = standing.checkpoints[learner.name].iteration
    anew = born(role, config.seed, learner.name, standing.history(learner.name))
    rng = np.random.default_rng([config.seed, iteration, crc32(learner.name.encode())])
    lineups, chances = [[""] * len(seats) for _ in range(past)], {}
    for team, opponent in enumerate(seats):
        if team == learner.team:
            continue
        found = odds(opponents, standing, learner, team, opponent, role, anew.iteration if anew else -1)
        names = (*found.names, "")
        for lineup, i in zip(lineups, draw(found.weights, past, rng), strict=True):
            lineup[team] = names[i]
            if names[i]:
                chances[names[i]] = (float(found.weights[i]), len(found.names))
    return tuple(map(tuple, lineups)), chances


def _phase(config: Config, standing: Standing, group: str) -> Phase:
    """The phase that the group is in, or goes over to now."""
    players = standing.groups[group]
    schedule = config.training.schedule
    able = {p.team: p.name for p in players if _able(config, p)}
    phase, learnt = standing.phases.get(group), _learnt(standing, players)
    if phase is None:
        return first_phase(schedule, config.league, group, able, learnt)
    return next_phase(schedule, phase, able, learnt) or phase


def _seats(players: Sequence[Player], teams: int) -> tuple[str, ...]:
    by_team = {p.team: p.name for p in players}
    return tuple(by_team.get(team, "") for team in range(teams))


def _dice(players: Sequence[Player]) -> int:
    return sum(p.setbacks for p in players)


def _turns(standing: Standing, *states: str) -> Iterator[TrainingTurn]:
    for job in standing.jobs:
        if job.kind == TrainingTurn.kind and job.state in states:
            task = decode(job)
            assert isinstance(task, TrainingTurn)
            yield task
