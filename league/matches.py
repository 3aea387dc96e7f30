"""Which rating matches come next, read off the store: the other half of the plan (`league/plan.py`).

Matches come after training where both want a device (`league/share.py`); when nobody learns any more they have it all.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from zlib import crc32

from league.config.experiment import Config
from league.jobs import RatingMatch, decode, encode
from league.measures import can_meet, initial_opponents, newest_snapshots, yardsticks
from league.plan import Plan, somebody_trains, trained_enough
from league.share import booking
from league.standing import Standing
from matchmaking.pairings import pairings
from storage.records import Job, Phase

RATING = "(rating)"  # the group under which the store remembers the rating that follows training
Pair = tuple[str, str | None]


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


def rating_over(config: Config, standing: Standing) -> Phase:
    """That rating has no time left, as a row: by the last match alone a little would seem to be."""
    phase = rating_phase(config, standing)
    return replace(phase, until={**phase.until, "seconds": 0.0})


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
        if config.deterministic and config.budget.success is None:
            return Plan()  # how much has been learnt when a batch is due is for the clock to say
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
    frozen = {s.name: s for s in standing.snapshots if s.thinned is None}

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
        everyone = list(frozen)
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
    able = [s for s in standing.snapshots if s.thinned is None]
    order = sorted(able, key=lambda s: (s.name not in newest, -s.iteration, s.name))
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


def rating_goes_on(config: Config, standing: Standing) -> bool:
    """Whether rating after training was broken off: it has time left, and there is something to play."""
    if not config.workers.match or rating_phase(config, standing).until["seconds"] == 0:
        return False
    return is_rating(standing) or bool(next_matches(config, standing).jobs)
