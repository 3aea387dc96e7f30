"""Schedule rating matches, from the settings and the league's state alone.

Training has priority on a device that both need (`league/scheduling/rating_budget.py`); after the end of training,
matches get the whole device. `league/scheduling/turn_scheduler.py` schedules the training turns.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from zlib import crc32

import numpy as np

from league.config.experiment import Config
from league.scheduling import training_progress
from league.scheduling.lineups import Lineup, complete, failed_alone
from league.scheduling.progress_metrics import can_meet, newest_snapshots, required_opponents
from league.scheduling.rating_budget import next_slot
from league.scheduling.training_progress import TrainingProgress
from league.scheduling.turn_scheduler import Plan
from league.state.jobs import RatingMatch, decode, encode
from league.state.league_state import LeagueState
from league.system import batch_sizes
from matchmaking.match_design import missing_pairs
from matchmaking.match_selection import pairings
from storage.records import Job, Phase

RATING = "(rating)"  # the group under which the store remembers the rating that follows training
PATIENCE = 120.0  # seconds of training


def is_rating(state: LeagueState) -> bool:
    """Return whether a rating match is queued or being played."""
    return any(job.kind == RatingMatch.kind and job.state in ("queued", "leased") for job in state.jobs)


def rating_phase(config: Config, state: LeagueState) -> Phase:
    """Return the phase of rating that follows training, with its remaining seconds, which a restart does not renew.

    The time used is that from the start of the phase in the store to the last rating match since then, so time in
    which the league was not running costs nothing.
    """
    since = {name: checkpoint.iteration for name, checkpoint in state.checkpoints.items()}
    kept = state.phases.get(RATING)
    budget = config.budget.rate_seconds
    if kept is None or dict(kept.since) != since or kept.until.get("budget") != _finite(budget):
        left = budget
    else:
        left = math.inf if kept.until["seconds"] is None else kept.until["seconds"]
        left -= max(0.0, state.played - kept.created)
    number = 0 if kept is None else kept.number + 1
    return Phase(
        config.league, RATING, number, (), since, {"seconds": _finite(max(0.0, left)), "budget": _finite(budget)}
    )


def rating_over(config: Config, state: LeagueState) -> Phase:
    """Return the row of a rating phase without remaining time: computed from the last match, a little would remain."""
    phase = rating_phase(config, state)
    return replace(phase, until={**phase.until, "seconds": 0.0})


def _finite(seconds: float) -> float | None:
    return None if seconds == math.inf else seconds  # JSON has no infinity


def next_matches(
    config: Config, state: LeagueState, progress: TrainingProgress | None = None, awaited: Sequence[Lineup] = ()
) -> Plan:
    """Return the next rating jobs, one for each rating process; none while one is open or all pairs have their quota.

    While players learn, each newest snapshot meets the newest snapshots of all other players, its reference opponents
    and its own past snapshots, for `episodes_per_pair` episodes each (matchmaking/match_design.py); the remaining
    episodes go to the pool. In arenas of more teams others complete such a pair (league/scheduling/lineups.py). Where a
    success rate ends training, trials begin when training itself reaches it. No batch is queued before the previous one
    has been paid for (league/scheduling/rating_budget.py), nor before any player has learnt. After the end of training
    the same pairs play `final_episodes_per_pair` episodes each. Lineups of a batch that was set aside are played one by
    one, and one that was set aside alone is not played again.

    `progress` is the training progress of this planning pass, by default computed here. `awaited` are lineups without
    which a turn cannot begin (`turn_scheduler.next_turns`): they come before all others and are not booked, because
    nobody learns meanwhile.
    """
    if is_rating(state) or not any(s.player for s in state.snapshots):
        return Plan()
    progress = progress or training_progress.measure(config, state)
    rating, due = config.rating, None
    if progress.training and not awaited:
        if config.deterministic and not config.budget.by_rating:
            return Plan()  # the training done when a batch is due depends on the clock
        due = next_slot(rating.share, progress.seconds, state.batches)
        if due is None or all(s.initial for s in state.snapshots if s.player) or _too_early(config, state, progress):
            return Plan()
    alone, never = _set_aside(state)
    if alone:
        return Plan(tuple(rating_job(config, state, [lineup], due) for lineup in alone))
    each = batch_sizes.batch(rating, "cpu").pairings  # the manager's settings have the number of its own device
    room = each * max(1, config.workers.match)
    wanted = awaited or _wanted(config, state, progress.finished, room + len(never))
    lineups = [lineup for lineup in wanted if lineup not in never][:room]
    batches = [lineups[i : i + each] for i in range(0, len(lineups), each)]
    return Plan(tuple(rating_job(config, state, batch, due) for batch in batches))


def _too_early(config: Config, state: LeagueState, progress: TrainingProgress) -> bool:
    """Return whether training waits for a success rate that its own episodes have not reached.

    A trial would then only delay the one that can end training, as batches are paid for one after the other. Success
    in training ends episodes early, so its share of ended episodes is too high while it rises, rarely too low: after
    PATIENCE seconds without a batch, trials are played anyway.
    """
    target = config.budget.success
    if target is None or config.budget.plateau is not None or not state.one_team:
        return False
    last = state.batches.due if state.batches is not None else 0.0
    return progress.seconds - last < PATIENCE and all(share < target for share in state.successes.values())


def _wanted(config: Config, state: LeagueState, over: bool, room: int) -> list[Lineup]:
    if state.one_team:
        return _trials(config, state, over)[:room]
    frozen = {s.name: s for s in state.snapshots if s.thinned is None}

    def may_meet(a: str, b: str) -> bool:
        return can_meet(frozen[a], frozen[b], state.players)

    target_episodes = config.rating.final_episodes_per_pair if over else config.rating.episodes_per_pair
    required = required_opponents(config, state, over)
    missing = missing_pairs(
        state.ladder.payoff, required, quota=config.rating.episodes_per_pair, target_episodes=target_episodes
    )
    found = complete(missing, state)[:room]
    if len(found) < room:
        pool = pairings(
            state.ladder, list(frozen), quota=config.rating.episodes_per_pair, per_batch=room, may_meet=may_meet,
            kinds={s.name: f"roster {s.roster}" for s in state.snapshots},
        )  # fmt: skip
        met = {frozenset(lineup) for lineup in found}
        found += [
            lineup for lineup in complete(pool, state, config.rating.episodes_per_pair) if frozenset(lineup) not in met
        ]
    return found[:room]


def _trials(config: Config, state: LeagueState, over: bool) -> list[Lineup]:
    """Return the snapshots of an arena of one team that have not played their quota, newest first.

    If training waits for a success rate, no batch consists of older snapshots only, because the newest snapshot would
    have to wait for it.
    """
    quota = config.rating.final_episodes_per_pair if over else config.rating.episodes_per_pair
    newest = {s.name for s in newest_snapshots(state)}
    able = [s for s in state.snapshots if s.thinned is None]
    order = sorted(able, key=lambda s: (s.name not in newest, -s.iteration, s.name))
    found = [
        s.name
        for s in order
        if state.ladder.trial_episodes(s.name) < (quota if s.name in newest else config.rating.episodes_per_pair)
    ]
    if config.budget.by_rating and not over and newest.isdisjoint(found):
        return []
    return [(name, None) for name in found]


def _set_aside(state: LeagueState) -> tuple[list[Lineup], set[Lineup]]:
    """Return the lineups of failed batches, to be played alone now, and the lineups that failed alone.

    A failed batch whose pairs have met since is ignored: the key of a new batch of them would differ.
    """
    together: dict[Lineup, None] = {}
    never = failed_alone(state)
    for job in state.jobs:
        if job.kind == RatingMatch.kind and job.state == "failed":
            task = decode(job)
            assert isinstance(task, RatingMatch)
            if len(task.lineups) > 1 and encode(job.league, task, _about(state, task.lineups)).key == job.key:
                together |= dict.fromkeys(task.lineups)
    return [lineup for lineup in together if lineup not in never], never


def _episodes(state: LeagueState, lineup: Lineup) -> int:
    """Count the episodes that the pairs of a lineup have played, void episodes included."""
    names = [name for name in lineup if name is not None]
    if len(names) == 1:
        return state.ladder.trial_episodes(names[0])
    payoff = state.ladder.payoff
    first, second = np.array([[payoff.index(name) for name in pair] for pair in combinations(names, 2)]).T
    met = payoff.between(first, second)
    return int(met[:, :3].sum() + met[:, 8].sum())


def _about(state: LeagueState, lineups: Sequence[Lineup]) -> list[list]:
    """Return the identity of a batch. It includes the episodes played so far, so the same lineups may meet again."""
    return [[*lineup, _episodes(state, lineup)] for lineup in lineups]


def rating_job(config: Config, state: LeagueState, lineups: Sequence[Lineup], due: float | None) -> Job:
    """Return the job of a batch of these lineups, booked to second `due` of training; None: after training."""
    about = _about(state, lineups)
    seed = crc32(f"{config.seed}/{about}".encode())
    return encode(config.league, RatingMatch(tuple(lineups), seed, record=config.rating.record, due=due), about)


def rating_goes_on(config: Config, state: LeagueState) -> bool:
    """Return whether rating after training was interrupted: time remains, and there are matches to play."""
    if not config.workers.match or rating_phase(config, state).until["seconds"] == 0:
        return False
    return is_rating(state) or bool(next_matches(config, state).jobs)
