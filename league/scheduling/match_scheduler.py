"""Schedule rating matches, from the settings and the league's state alone.

Training has priority on a device that both need: rating matches take the share `rating.share` of its time, enforced by
booking batches. Every batch is booked to a second of the league's training. After a batch that took s seconds of a
device, the next one is due s / share seconds of training later. Matches therefore take that share of training time in
total, for any duration of a batch. The account consists of two numbers of the match log, the newest booking and the
seconds of its batches, so it survives a kill and hours of rating after training, when matches get the whole device.

In arenas of three and more teams a pair that is to meet is completed by other snapshots to a lineup, because a ranking
of n teams counts as a game of every pair in it. With a required pair (`matchmaking.match_design`) the newest snapshots
of other players take the seats that are left: the pairs of newest snapshots give the lineup of the newest of all
players, and a newest snapshot and its parent meet among the others' newest. With a pair of the pool those take them
that have played least.
"""

import math
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple
from zlib import crc32

import numpy as np

from league.config.experiment import Config
from league.scheduling import training_progress
from league.scheduling.progress_metrics import meeting_rosters, required_opponents
from league.scheduling.training_progress import TrainingProgress
from league.scheduling.turn_scheduler import Plan
from league.state.jobs import RatingMatch, decode, encode, failed_alone
from league.state.league_state import Batches, LeagueState
from league.system import batch_sizes
from matchmaking.match_design import missing_pairs, others_after
from matchmaking.match_selection import pairings
from storage.records import Job, Phase, Player, Purpose, Snapshot

RATING = "(rating)"  # the group under which the store remembers the rating that follows training
PATIENCE = 120.0  # seconds of training
FIRST_RATED = 64
"""Iterations of the first snapshots that are rated where ratings end training: walking and pushing took 56 to 181."""
FIRST_MATCH = 600.0  # seconds after the time for rating in which a league's first match is waited for
CREDIT = 60.0  # seconds of training for which unused time for rating is kept; older time is forfeited

Lineup = tuple[str | None, ...]
"""Names of snapshots, one for each team; in an arena of one team a snapshot and None."""


class RatingTime(NamedTuple):
    """The end of the time for rating that follows training, on the monotonic clock of this process."""

    until: float = math.inf  # infinite before training is over

    @classmethod
    def of(cls, seconds: float | None) -> "RatingTime":
        """Return a time that begins now and has so many seconds; None: without an end."""
        return cls(sys.float_info.max if seconds is None else time.monotonic() + seconds)

    def over(self, extra: float = 0.0) -> bool:
        """Return whether the time is over, and `extra` seconds with it."""
        return time.monotonic() > self.until + extra


def plan_rating(
    config: Config,
    state: LeagueState,
    progress: TrainingProgress,
    training: bool,
    rating_time: RatingTime,
    awaited: Sequence[tuple[str, str]] = (),
) -> tuple[Plan, RatingTime, bool]:
    """Return the next rating jobs with the phase of rating that begins or ends, its time, and whether it goes on.

    `training`: a turn of training is open, queued now, or waits for the `awaited` pairs to meet. The time for rating
    begins when there is none.
    """
    phases = ()
    if training:
        rating_time = RatingTime()
    elif rating_time == RatingTime():
        phases = (rating_phase(config, state),)
        rating_time = RatingTime.of(phases[0].until["seconds"])
    if rating_time.over() and not _awaits_first_match(config, state, rating_time):
        return Plan((), phases or (rating_over(config, state),)), rating_time, False
    jobs = next_matches(config, state, progress, awaited).jobs if config.workers.match else ()
    return Plan(jobs, phases), rating_time, bool(jobs) or is_rating(state)


def _awaits_first_match(config: Config, state: LeagueState, rating_time: RatingTime) -> bool:
    """Return whether the league's first rating match is queued or played, for FIRST_MATCH more at most: on a slow
    machine compiling alone may outlast the time for rating, and then there would be neither rating nor recording.
    """
    plays = config.budget.rate_seconds > 0 and config.workers.match > 0
    return plays and not state.played and is_rating(state) and not rating_time.over(FIRST_MATCH)


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


def rating_goes_on(config: Config, state: LeagueState) -> bool:
    """Return whether rating after training was interrupted: time remains, and there are matches to play."""
    if not config.workers.match or rating_phase(config, state).until["seconds"] == 0:
        return False
    return is_rating(state) or bool(next_matches(config, state).jobs)


def next_matches(
    config: Config, state: LeagueState, progress: TrainingProgress | None = None,
    awaited: Sequence[tuple[str, str]] = (),
) -> Plan:  # fmt: skip
    """Return the next rating jobs, one for each rating process; none while one is open or all pairs have their quota.

    While players learn, each newest snapshot meets the newest snapshots of all other players, its reference opponents
    and its own past snapshots, for `episodes_per_pair` episodes each (matchmaking/match_design.py); the remaining
    episodes go to the pool. Where a success rate ends training, trials begin when training itself reaches it. No batch
    is queued before its `next_slot`, nor before any player has learnt. After the end of training the same pairs play
    `final_episodes_per_pair` episodes each. Lineups of a batch that was set aside are played one by one, and one that
    was set aside alone is not played again.

    `progress` is the training progress of this planning pass, by default computed here. `awaited` are pairs without
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
    wanted = complete(awaited, state) or _wanted(config, state, progress.finished, room + len(never))
    lineups = [lineup for lineup in wanted if lineup not in never][:room]
    batches = [lineups[i : i + each] for i in range(0, len(lineups), each)]
    return Plan(tuple(rating_job(config, state, batch, due) for batch in batches))


def _too_early(config: Config, state: LeagueState, progress: TrainingProgress) -> bool:
    """Return whether a batch would only delay the one that can end training, as each is paid for before the next.

    That is so while training waits for a success rate that its own episodes have not reached. Success in training ends
    episodes early, so its share of ended episodes is too high while it rises, rarely too low: after PATIENCE seconds
    without a batch, trials are played anyway. Where other ratings end training, the first batch waits for snapshots
    that have learnt for FIRST_RATED iterations; for CREDIT seconds that postpones no later batch.
    """
    target = config.budget.success
    if target is None or not _waits_for_success(config):
        unpractised = all(s.iteration < FIRST_RATED for s in state.newest_snapshots)
        return config.budget.by_rating and state.batches is None and progress.seconds < CREDIT and unpractised
    last = state.batches.due if state.batches is not None else 0.0
    return progress.seconds - last < PATIENCE and all(share < target for share in state.successes.values())


def _waits_for_success(config: Config) -> bool:
    """Return whether nothing but a success rate, which only arenas of one team have, can end training by ratings."""
    return config.budget.success is not None and config.budget.plateau is None


def next_slot(share: float, trained: float, last: Batches | None) -> float | None:
    """Return the second of training to which batches queued now are booked; None if none may be queued yet.

    Args:
        share: the setting `rating.share`.
        trained: seconds of training that the league has had.
        last: the newest batches.
    """
    if share == 0.0:
        return None
    due = 0.0
    if last is not None and last.due <= trained:  # otherwise the schedule, which defines training time, has changed
        due = last.due + last.seconds / share
    if due > trained and share < 1.0:
        return None
    return min(max(due, trained - CREDIT), trained)


# Which snapshots meet -------------------------------------------------------------------------------------------------


def _wanted(config: Config, state: LeagueState, over: bool, room: int) -> list[Lineup]:
    if state.one_team:
        return _trials(config, state, over)[:room]
    frozen = {s.name: s for s in state.snapshots if s.thinned is None}

    sides = meeting_rosters(state.players)

    def may_meet(a: str, b: str) -> bool:
        return (frozen[a].roster, frozen[b].roster) in sides

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

    If training waits for a success rate, only the newest snapshots play: a batch lasts as long as its longest episode,
    and the episodes of older ones, which fail more often, are long. If it waits for a plateau, which needs many rated
    snapshots, older ones play too, but no batch consists of them alone, because the newest would have to wait for it.
    """
    quota = config.rating.final_episodes_per_pair if over else config.rating.episodes_per_pair
    newest = {s.name for s in state.newest_snapshots}
    able = [s for s in state.snapshots if s.thinned is None]
    order = sorted(able, key=lambda s: (s.name not in newest, -s.iteration, s.name))
    found = [
        s.name
        for s in order
        if state.ladder.trial_episodes(s.name) < (quota if s.name in newest else config.rating.episodes_per_pair)
    ]
    if _waits_for_success(config) and not over:
        found = [name for name in found if name in newest]
    if config.budget.by_rating and not over and newest.isdisjoint(found):
        return []
    return [(name, None) for name in found]


def complete(pairs: Sequence[tuple[str, str]], state: LeagueState, quota: int | None = None) -> list[Lineup]:
    """Return the lineups of these pairs, in their order; in an arena of two teams the pairs themselves.

    Pairs that give the same set of snapshots give one lineup, and a pair that nobody can complete gives none. Pairs of
    the pool have a `quota`, the episodes as which a planned lineup counts; required pairs have none.
    """
    rosters = team_rosters(state.players)
    if len(rosters) < 3:
        return [*pairs]
    able = {s.name: s for s in state.snapshots if s.thinned is None}
    newest = [s.name for s in state.newest_snapshots if s.name in able]
    rest = sorted(able.values(), key=lambda s: (s.script is not None, -s.iteration, s.name))
    payoff = state.ladder.payoff
    episodes = {} if quota is None else {name: int(payoff.total_episodes[payoff.index(name)]) for name in able}
    found: dict[frozenset[str], tuple[str, ...]] = {}
    for pair in pairs:
        if quota is None:
            after = others_after(newest, pair[0]) if pair[0] in newest else newest
            others = [able[name] for name in after] + rest
        else:
            others = sorted(rest, key=lambda s: episodes[s.name])
        lineup = _seated([able[name] for name in pair], others, rosters)
        if lineup is None:
            continue
        found.setdefault(frozenset(lineup), lineup)
        if quota is not None:
            episodes |= {name: episodes[name] + quota for name in lineup}
    return [*found.values()]


def team_rosters(players: Sequence[Player]) -> list[str]:
    """Return the roster of each team, in their order."""
    by_team = {p.team: p.roster for p in players}
    return [by_team[team] for team in sorted(by_team)]


def _seated(pair: Sequence[Snapshot], others: Sequence[Snapshot], rosters: Sequence[str]) -> tuple[str, ...] | None:
    """Return a snapshot for each team: the pair at the first teams that they fit, then the first others that fit.

    None if there are not enough different snapshots of a roster.
    """
    seats: list[str | None] = [None] * len(rosters)
    for snapshot in (*pair, *others):
        free = [i for i, roster in enumerate(rosters) if seats[i] is None and roster == snapshot.roster]
        if free and snapshot.name not in seats:
            seats[free[0]] = snapshot.name
    whole = tuple(name for name in seats if name is not None)
    return whole if len(whole) == len(rosters) and {s.name for s in pair} <= set(whole) else None


# Batches as jobs ------------------------------------------------------------------------------------------------------


def _set_aside(state: LeagueState) -> tuple[list[Lineup], set[Lineup]]:
    """Return the lineups of failed batches, to be played alone now, and the lineups that failed alone.

    A failed batch whose pairs have met since is ignored: the key of a new batch of them would differ.
    """
    together: dict[Lineup, None] = {}
    never = failed_alone(state.jobs)
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
    return int(payoff.episodes_between(first, second).sum())


def _about(state: LeagueState, lineups: Sequence[Lineup], purpose: Purpose = "rating") -> list[list]:
    """Return the identity of a batch, from which its key and its seed follow.

    It includes the episodes played so far, so the same lineups may meet again. They are counted on the present ladder,
    and from 0 on another one: where there are several, the ladder is part of the identity, with the last match of the
    others, because a batch planned for this ladder may have been played on another one (after a change of rules, or by
    a worker with another engine). The league's own batches on its only ladder have the identities of earlier versions.
    """
    about: list[list] = [[*lineup, _episodes(state, lineup)] for lineup in lineups]
    if state.last_elsewhere:
        about.append([*(state.arena or ()), state.last_elsewhere])
    return about if purpose == "rating" else [*about, [purpose]]


def rating_job(
    config: Config, state: LeagueState, lineups: Sequence[Lineup], due: float | None, purpose: Purpose = "rating"
) -> Job:
    """Return the job of a batch of these lineups, booked to second `due` of training; None: after training."""
    about = _about(state, lineups, purpose)
    seed = crc32(f"{config.seed}/{about}".encode())
    return encode(config.league, RatingMatch(tuple(lineups), seed, purpose, config.rating.record, due), about)
