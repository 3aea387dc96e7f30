"""What should be done next, read off the store: pure functions from what has happened to the next jobs.

The plan lives in no process. Whoever manages a league asks again and again; a job's key says what it is for, and the
store queues a key once, so that asking twice does no harm. What was set aside is not asked for again.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from zlib import crc32

import numpy as np

from league.config.experiment import Config
from league.jobs import RatingMatch, TrainingTurn, decode, encode
from league.lives import born, steps_left
from league.measures import can_meet, initial_opponents, learnt_enough, newest_snapshots, yardsticks
from league.odds import odds
from league.share import booking
from league.standing import Standing
from matchmaking.opponents import draw
from matchmaking.schedule import Learnt, first_phase, next_due, next_phase, pairings, remaining
from storage.records import Job, Phase, Player

RATING = "(rating)"  # the group under which the store remembers the rating that follows training
Pair = tuple[str, str | None]
Lineups = tuple[tuple[str, ...], ...]  # for each group of worlds who sits in every team
Chances = dict[str, tuple[float, int]]  # snapshot -> the chance with which it was drawn, and out of how many


@dataclass(frozen=True)
class Plan:
    """What to queue: jobs, and the phases of schedules that they belong to."""

    jobs: tuple[Job, ...] = ()
    phases: tuple[Phase, ...] = ()


# Training ------------------------------------------------------------------------------------------------------------


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


# Rating --------------------------------------------------------------------------------------------------------------


def is_rating(standing: Standing) -> bool:
    """Whether a rating match waits or is being played."""
    return any(job.kind == RatingMatch.kind and job.state in ("queued", "leased") for job in standing.jobs)


def rating_phase(config: Config, standing: Standing) -> Phase:
    """The rating that follows training, with the seconds it has left: a restart does not give it new ones.

    What it has used is the time from the start of the phase in the store to the last rating match since then; so time
    in which the league was not running costs nothing.
    """
    since = {name: checkpoint.iteration for name, checkpoint in standing.checkpoints.items()}
    kept = standing.phases.get(RATING)
    budget = config.budget.rate_seconds
    if kept is None or dict(kept.since) != since or kept.until.get("budget") != _told(budget):
        left = budget
    else:
        left = math.inf if kept.until["seconds"] is None else kept.until["seconds"]
        left -= max(0.0, standing.played - kept.created)
    number = 0 if kept is None else kept.number + 1
    return Phase(config.league, RATING, number, (), since, {"seconds": _told(max(0.0, left)), "budget": _told(budget)})


def _told(seconds: float) -> float | None:
    return None if seconds == math.inf else seconds  # JSON has no infinity


def next_matches(config: Config, standing: Standing) -> Plan:
    """The next rating jobs, one for each process that plays them; none while one is open or all is rated enough.

    While players learn, new snapshots meet those by whom the score against initial is told, then the pool. No batch is
    queued before the last one has been paid for (league/share.py), nor while nobody has learnt anything yet. When
    nobody learns any more, each newest snapshot first meets all by which progress is told, for `final_quota` episodes
    each. Pairs of a batch that was set aside are played one by one, and what was set aside alone is not played again.
    """
    if is_rating(standing) or not any(s.player for s in standing.snapshots):
        return Plan()
    rating, due = config.rating, None
    if somebody_trains(config, standing):
        due = booking(rating.share, standing.trained(config.training.schedule), standing.batches)
        if due is None or all(s.initial for s in standing.snapshots if s.player):
            return Plan()
    alone, never = _set_aside(standing)
    if alone:
        return Plan(tuple(_match(config, standing, [pair], due) for pair in alone))
    room = rating.pairings * max(1, config.workers.match)
    pairs = [pair for pair in _wanted(config, standing, room + len(never)) if pair not in never][:room]
    batches = [pairs[i : i + rating.pairings] for i in range(0, len(pairs), rating.pairings)]
    return Plan(tuple(_match(config, standing, batch, due) for batch in batches))


def _wanted(config: Config, standing: Standing, room: int) -> list[Pair]:
    if standing.one_team:
        return _trials(config, standing)[:room]
    frozen = {s.name: s for s in standing.snapshots}

    def may_meet(a: str, b: str) -> bool:
        return can_meet(frozen[a], frozen[b], standing.players)

    found: Sequence[Pair] = []
    if trained_enough(config, standing):
        tell = {s.name: [o.name for o in yardsticks(config, standing, s)] for s in newest_snapshots(standing)}
        found = pairings(
            standing.ladder, list(tell), quota=config.rating.final_quota, per_batch=room, always=tell,
            may_meet=lambda a, b: may_meet(a, b) and b in tell.get(a, ()),
        )  # fmt: skip
    if not found:
        first = {
            s.name: [o.name for o in initial_opponents(s, standing.snapshots, standing.players)]
            for s in newest_snapshots(standing)
        }
        everyone = [s.name for s in standing.snapshots]
        found = pairings(
            standing.ladder, everyone, quota=config.rating.quota, per_batch=room, always=first, may_meet=may_meet,
            kinds={s.name: f"roster {s.roster}" for s in standing.snapshots},
        )  # fmt: skip
    return list(found)


def _trials(config: Config, standing: Standing) -> list[Pair]:
    """In an arena of one team: the snapshots that have not shown often enough whether they succeed, newest first.

    Where training waits for a success, no batch is of others alone: the next snapshot would have to wait for it.
    """
    over = trained_enough(config, standing)
    quota = config.rating.final_quota if over else config.rating.quota
    newest = {s.name for s in newest_snapshots(standing)}
    order = sorted(standing.snapshots, key=lambda s: (s.name not in newest, -s.iteration, s.name))
    found = [
        s.name for s in order if standing.ladder.tried(s.name) < (quota if s.name in newest else config.rating.quota)
    ]
    if config.budget.success is not None and not over and newest.isdisjoint(found):
        return []
    return [(name, None) for name in found]


def _set_aside(standing: Standing) -> tuple[list[Pair], set[Pair]]:
    """Pairs of batches that failed, to be tried alone now; and those that failed alone.

    A failed batch whose pairs have met since says nothing any more: its key is no longer that of the same pairs.
    """
    together: dict[Pair, None] = {}
    never: set[Pair] = set()
    for job in standing.jobs:
        if job.kind == RatingMatch.kind and job.state == "failed":
            task = decode(job)
            assert isinstance(task, RatingMatch)
            if len(task.pairs) == 1:
                never.add(task.pairs[0])
            elif encode(job.league, task, _about(standing, task.pairs)).key == job.key:
                together |= dict.fromkeys(task.pairs)
    return [pair for pair in together if pair not in never], never


def _episodes(standing: Standing, pair: Pair) -> int:
    """Episodes that the pair has played, void ones included."""
    a, b = pair
    if b is None:
        return standing.ladder.tried(a)
    payoff = standing.ladder.payoff
    return int(payoff.episodes[payoff.index(a), payoff.index(b)])


def _about(standing: Standing, pairs: Sequence[Pair]) -> list[list]:
    """What a batch is for. What was played so far is part of it: the same pairs may meet again, for other games."""
    return [[*pair, _episodes(standing, pair)] for pair in pairs]


def _match(config: Config, standing: Standing, pairs: Sequence[Pair], due: float | None) -> Job:
    about = _about(standing, pairs)
    seed = crc32(f"{config.seed}/{about}".encode())
    return encode(config.league, RatingMatch(tuple(pairs), seed, record=config.rating.record, due=due), about)


def cut_short(config: Config, standing: Standing) -> bool:
    """Whether rating was: a newest snapshot has not met a yardstick, or not tried alone, for the quota."""
    quota = config.rating.quota
    if standing.one_team:
        return any(standing.ladder.tried(s.name) < quota for s in newest_snapshots(standing))
    return any(
        _episodes(standing, (s.name, other.name)) < quota
        for s in newest_snapshots(standing)
        for other in yardsticks(config, standing, s)
    )
