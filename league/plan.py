"""What should be done next, read off the store: pure functions from what has happened to the next jobs.

The plan lives in no process. Whoever manages a league asks again and again; a job's key says what it is for, and the
store queues a key once, so that asking twice does no harm.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from zlib import crc32

import numpy as np

from league.config import Config
from matchmaking.opponents import draw
from matchmaking.payoff import Payoff, tally
from matchmaking.schedule import learners, next_due, next_swap, pairings
from storage.records import Checkpoint, Job, Match, Player, Snapshot
from storage.store import Store

TRAIN, MATCH = "train", "match"


@dataclass(frozen=True)
class Standing:
    """A league as its store has it now."""

    players: Sequence[Player]
    snapshots: Sequence[Snapshot]
    checkpoints: Sequence[Checkpoint]  # the newest of each player
    matches: Sequence[Match]
    jobs: Sequence[Job]  # that wait, are worked on or have failed
    batches: int = 0  # of rating matches that were ever queued

    @classmethod
    def of(cls, store: Store, league: str, known: Sequence[Match] = ()) -> "Standing":
        """Read it; of the match log only what came after the matches that are `known`."""
        players = store.players(league)
        newest = [checkpoint for p in players if (checkpoint := store.checkpoint(league, p.name))]
        log = [*known, *store.matches(league, "rating", after=known[-1].id if known else 0)]
        jobs = [job for state in ("queued", "leased", "failed") for job in store.jobs(league, state)]
        return cls(players, store.snapshots(league), newest, log, jobs, store.count_jobs(league, MATCH))

    @property
    def newest(self) -> Checkpoint | None:
        """The checkpoint that has come furthest, None before the first turn."""
        return max(self.checkpoints, key=lambda c: c.iteration, default=None)

    def is_open(self, kind: str) -> bool:
        """Whether a job of that kind waits or is being worked on."""
        return any(job.kind == kind and job.state in ("queued", "leased") for job in self.jobs)

    def history(self, player: str) -> list[Snapshot]:
        """A player's snapshots, oldest first."""
        return [s for s in self.snapshots if s.player == player]

    def payoff(self) -> Payoff:
        """Who beat whom, with a place for every snapshot."""
        return tally(self.matches, players=[s.digest for s in self.snapshots])


def trained_enough(config: Config, standing: Standing) -> bool:
    """Whether the training budget is spent."""
    newest = standing.newest
    return newest is not None and config.budget.spent(newest.seconds, newest.step)


def next_turn(config: Config, standing: Standing) -> Job | None:
    """The next training job; None while one is open or when the budget is spent. The first only makes the players."""
    if standing.is_open(TRAIN) or trained_enough(config, standing):
        return None
    if standing.newest is None:
        first = last = 0
        teams: Sequence[int] = range(len(standing.players))
        past: dict[str, list[dict[str, str]]] = {}
    else:
        first = standing.newest.iteration
        last = _turn_end(config, first, standing.newest)
        teams = learners(config.training.schedule, first, len(standing.players))
        past = {standing.players[t].name: _past(config, standing, standing.players[t], first) for t in teams}
    payload = {"first": first, "last": last, "learners": list(teams), "past": past}
    # The budget is in the key: a turn that a smaller budget cut short is another turn than the one that goes on.
    return Job(config.league, TRAIN, f"{TRAIN}:{first}-{last}", payload, priority=1)


def _turn_end(config: Config, first: int, newest: Checkpoint) -> int:
    """A turn ends where a snapshot is due, the learners change or enough would be lost; or with the step budget."""
    training = config.training
    ends = [first + training.turn, next_due(first, training.snapshots_per_doubling)]
    swap = next_swap(training.schedule, first)
    if swap is not None:
        ends.append(swap)
    if config.budget.steps is not None:
        per_iteration = training.worlds * training.rollout
        ends.append(first + max(1, -(-(config.budget.steps - newest.step) // per_iteration)))
    return min(ends)


def _past(config: Config, standing: Standing, learner: Player, iteration: int) -> list[dict[str, str]]:
    """Past opponents of a learning player: one entry per group of worlds, other player -> digest."""
    opponents = config.training.opponents
    if not opponents.past:
        return []
    rng = np.random.default_rng([config.seed, iteration, learner.team])
    payoff = standing.payoff() if opponents.kind == "prioritized" else None
    groups: list[dict[str, str]] = [{} for _ in range(opponents.groups)]
    mine = standing.history(learner.name)[-1]
    for other in standing.players:
        history = standing.history(other.name)
        if other == learner or not history:
            continue
        rates = None
        if payoff is not None:
            rates = payoff.scores()[payoff.index(mine.digest), [payoff.index(s.digest) for s in history]]
        for group, i in zip(groups, draw(opponents.weights(len(history), rates), opponents.groups, rng), strict=True):
            group[other.name] = history[i].digest
    return groups


def next_matches(config: Config, standing: Standing) -> list[Job]:
    """The next rating jobs, one for each process that plays them; none while one is open or all is rated enough.

    While players learn, new snapshots meet their initial one first, then the pool. When the budget is spent, each
    newest snapshot first meets all by which progress is told, for `final_quota` episodes each.
    """
    if standing.is_open(MATCH) or not any(s.player for s in standing.snapshots):
        return []
    rating, payoff = config.rating, standing.payoff()
    room = rating.pairings * max(1, config.workers.match)
    roster = {s.digest: s.roster for s in standing.snapshots}
    rosters = {player.roster for player in standing.players}

    def may_meet(a: str, b: str) -> bool:
        return len(rosters) == 1 or roster[a] != roster[b]

    plan: list[tuple[str, str]] = []
    if trained_enough(config, standing):
        tell = {s.digest: [o.digest for o in yardsticks(config, standing, s)] for s in newest_snapshots(standing)}
        plan = pairings(
            payoff, list(tell), quota=rating.final_quota, per_batch=room, always=tell,
            may_meet=lambda a, b: may_meet(a, b) and b in tell.get(a, ()),
        )  # fmt: skip
    if not plan:
        first = {s.digest: [initial(standing, s).digest] for s in newest_snapshots(standing)}
        everyone = [s.digest for s in standing.snapshots]
        plan = pairings(payoff, everyone, quota=rating.quota, per_batch=room, always=first, may_meet=may_meet)
    batches = [plan[i : i + rating.pairings] for i in range(0, len(plan), rating.pairings)]
    return [_match(config, standing.batches + i, batch) for i, batch in enumerate(batches)]


def newest_snapshots(standing: Standing) -> list[Snapshot]:
    """Each player's newest snapshot."""
    return [history[-1] for p in standing.players if (history := standing.history(p.name))]


def initial(standing: Standing, snapshot: Snapshot) -> Snapshot:
    """Whom the score against initial is measured with: the player's own first snapshot, or, where rosters differ, that
    of an opponent (HARL-A's metric).
    """
    firsts = [standing.history(p.name)[0] for p in standing.players if standing.history(p.name)]
    own = [s for s in firsts if s.player == snapshot.player]
    alike = len({player.roster for player in standing.players}) == 1
    return own[0] if alike else next(s for s in firsts if s.roster != snapshot.roster)


def milestones(config: Config, standing: Standing, player: str) -> dict[str, Snapshot]:
    """A player's first snapshot after each milestone of training time that it has passed."""
    found = {}
    for name, mark in zip(config.rating.milestones, config.rating.milestone_seconds, strict=True):
        late = [s for s in standing.history(player) if s.seconds >= mark]
        if late:
            found[name] = late[0]
    return found


def yardsticks(config: Config, standing: Standing, snapshot: Snapshot) -> list[Snapshot]:
    """By whom a newest snapshot's progress is told: its initial one, those of the milestones, the scripts."""
    player = str(snapshot.player)
    own = [] if len({p.roster for p in standing.players}) > 1 else list(milestones(config, standing, player).values())
    scripts = [s for s in standing.snapshots if s.script in config.rating.scripts]
    found = [initial(standing, snapshot), *own, *scripts]
    return [s for s in dict.fromkeys(found) if s.digest != snapshot.digest]


def _match(config: Config, number: int, pairs: Sequence[tuple[str, str]]) -> Job:
    seed = crc32(f"{config.seed}/{MATCH}/{number}".encode())
    return Job(config.league, MATCH, f"{MATCH}:{number}", {"pairs": [list(pair) for pair in pairs], "seed": seed})
