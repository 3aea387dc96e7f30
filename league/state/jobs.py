"""Jobs as typed values, and their encoding as rows of the store's job table."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields
from itertools import combinations
from typing import Any, ClassVar

from storage.errors import StorageError
from storage.records import Job


@dataclass(frozen=True)
class TrainingTurn:
    """The work of one training lease: some learning iterations of players that learn together.

    It starts from the checkpoints in `bases` only: a turn whose bases are no longer the newest is refused at its end,
    so that a player has one lineage. With no iterations it only creates the players.
    """

    kind: ClassVar[str] = "train"

    group: str
    phase: int  # of the group's schedule
    learners: tuple[str, ...]  # players
    present: tuple[str, ...]  # for each team the player that sits there in its current state, "" if the group has none
    bases: Mapping[str, str]  # present player -> digest of its checkpoint, "" before its first
    iterations: int
    past: Mapping[str, tuple[tuple[str, ...], ...]]  # learner -> for each group of worlds the snapshot of each team
    chances: Mapping[str, Mapping[str, tuple[float, int]]] = field(default_factory=dict)
    # learner -> snapshot in `past` -> the probability with which it was drawn, and the number of candidates
    retry: int = 0  # number of times that the players were set back: a repeated turn uses other random numbers
    copies: Mapping[str, tuple[str, str, str]] = field(default_factory=dict)
    # learner -> the player from whose checkpoint it continues, that checkpoint's digest, that player's newest snapshot


@dataclass(frozen=True)
class RatingMatch:
    """Lineups of snapshots, one for each team, that play a batch of episodes.

    In an arena of one team a lineup is a snapshot and None.
    """

    kind: ClassVar[str] = "match"

    lineups: tuple[tuple[str | None, ...], ...]
    seed: int
    purpose: str = "rating"
    record: bool = True
    due: float | None = None  # while players learn, the second of their training to which it is booked


Task = TrainingTurn | RatingMatch
STORED_NAMES = {"chances": "odds", "retry": "dice", "lineups": "pairs"}
"""Names under which stored jobs have these fields."""
KINDS: Mapping[str, type[Task]] = {task.kind: task for task in (TrainingTurn, RatingMatch)}


def encode(league: str, task: Task, about: Any, priority: int = 0) -> Job:
    """Return a task as a job to queue. Its key is a hash of `about`, its purpose: queueing it twice has no effect."""
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:20]
    return Job(league, task.kind, f"{task.kind}:{digest}", _payload(task), priority)


def _payload(task: Task) -> dict[str, Any]:
    return {STORED_NAMES.get(name, name): value for name, value in asdict(task).items()}


def decode(job: Job) -> Task:
    """Return the task in a job. Raises StorageError for a kind or a payload of another program or version."""
    try:
        task = KINDS[job.kind]
        names = {STORED_NAMES.get(f.name, f.name): f.name for f in fields(task)}
        known = {
            stored: f.default is MISSING and f.default_factory is MISSING
            for stored, f in zip(names, fields(task), strict=True)
        }
        if job.payload.keys() - known or {name for name, needed in known.items() if needed} - job.payload.keys():
            raise KeyError(job.kind)  # fields with a default may be missing, if an older version queued the job
        return task(**{names[stored]: _as_tuples(value) for stored, value in job.payload.items()})
    except KeyError:
        raise StorageError(f"job {job.key} is of no kind that this version knows ({', '.join(KINDS)})") from None


def references(job: Job) -> list[tuple[str, str]]:
    """Return the rows that a job needs, as (table, name); none for a kind of another program.

    Raises StorageError for a payload of another version.
    """
    if job.kind not in KINDS:
        return []
    task = decode(job)
    if isinstance(task, RatingMatch):
        return [("snapshots", name) for lineup in task.lineups for name in lineup if name is not None]
    players = (*task.learners, *task.present, *task.bases)
    past = (name for groups in task.past.values() for seats in groups for name in seats)
    return [*(("players", name) for name in players if name), *(("snapshots", name) for name in past if name)]


def failed_alone(jobs: Sequence[Job]) -> set[tuple[str | None, ...]]:
    """Return the lineups whose match was set aside although it was a job of its own: they are not played again."""
    tasks = [decode(job) for job in jobs if job.kind == RatingMatch.kind and job.state == "failed"]
    return {each.lineups[0] for each in tasks if isinstance(each, RatingMatch) and len(each.lineups) == 1}


def pairs_failed_alone(jobs: Sequence[Job]) -> set[frozenset[str]]:
    """Return the pairs of snapshots in the lineups that failed alone."""
    return {frozenset(pair) for lineup in failed_alone(jobs) for pair in combinations(filter(None, lineup), 2)}


def _as_tuples(value: Any) -> Any:
    """Convert lists of JSON to tuples, recursively."""
    if isinstance(value, list | tuple):
        return tuple(map(_as_tuples, value))
    return {name: _as_tuples(each) for name, each in value.items()} if isinstance(value, dict) else value
