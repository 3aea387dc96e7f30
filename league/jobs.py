"""Jobs as typed values, with one encoding: what a row of the store's job table means to this program."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields
from typing import Any, ClassVar

from storage.errors import StorageError
from storage.records import Job


@dataclass(frozen=True)
class TrainingTurn:
    """What one training lease covers: some learning iterations of players that learn together.

    It starts from the checkpoints in `bases` and from no others: a turn whose bases are no longer the newest is
    refused when it ends, so that a player has one lineage. With no iterations it only makes the players.
    """

    kind: ClassVar[str] = "train"

    group: str
    phase: int  # of the group's schedule
    learners: tuple[str, ...]  # players
    present: tuple[str, ...]  # for each team the player that sits there as it is now, "" where the group has none
    bases: Mapping[str, str]  # present player -> digest of its checkpoint, "" before its first
    iterations: int
    past: Mapping[str, tuple[tuple[str, ...], ...]]  # learner -> a lineup per group of worlds: snapshot of each team
    odds: Mapping[str, Mapping[str, tuple[float, int]]] = field(default_factory=dict)
    # learner -> snapshot in `past` -> the chance with which it was drawn, and out of how many
    dice: int = 0  # how often the players had to go back: a repeated turn rolls other dice
    copies: Mapping[str, tuple[str, str, str]] = field(default_factory=dict)
    # learner -> a player from whose checkpoint it goes on, that one's digest, and its newest snapshot


@dataclass(frozen=True)
class RatingMatch:
    """Pairs of snapshots that play a batch of episodes; in an arena of one team the second of a pair is None."""

    kind: ClassVar[str] = "match"

    pairs: tuple[tuple[str, str | None], ...]
    seed: int
    purpose: str = "rating"
    record: bool = True
    due: float | None = None  # while players learn, the second of their training to which it is booked: see share.py


Task = TrainingTurn | RatingMatch
KINDS: Mapping[str, type[Task]] = {task.kind: task for task in (TrainingTurn, RatingMatch)}


def encode(league: str, task: Task, about: Any, priority: int = 0) -> Job:
    """The task as a job to queue. Its key is made of `about`, what it is for: asking twice does no harm."""
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:20]
    return Job(league, task.kind, f"{task.kind}:{digest}", asdict(task), priority)


def decode(job: Job) -> Task:
    """The task in a job. Raises StorageError for a kind or a payload of another program or version."""
    try:
        task = KINDS[job.kind]
        known = {f.name: f.default is MISSING and f.default_factory is MISSING for f in fields(task)}
        if job.payload.keys() - known or {name for name, needed in known.items() if needed} - job.payload.keys():
            raise KeyError(job.kind)  # what has a default may be missing: an older version queued it
        return task(**{name: _frozen(value) for name, value in job.payload.items()})
    except KeyError:
        raise StorageError(f"job {job.key} is of no kind that this version knows ({', '.join(KINDS)})") from None


def references(job: Job) -> list[tuple[str, str]]:
    """The rows that a job cannot do without: the table and the name of each; none for a kind of another program.

    Raises StorageError for a payload of another version.
    """
    if job.kind not in KINDS:
        return []
    task = decode(job)
    if isinstance(task, RatingMatch):
        return [("snapshots", name) for pair in task.pairs for name in pair if name is not None]
    players = (*task.learners, *task.present, *task.bases)
    past = (name for lineups in task.past.values() for seats in lineups for name in seats)
    return [*(("players", name) for name in players if name), *(("snapshots", name) for name in past if name)]


def _frozen(value: Any) -> Any:
    """JSON's lists as tuples, all the way down."""
    if isinstance(value, list | tuple):
        return tuple(map(_frozen, value))
    return {name: _frozen(each) for name, each in value.items()} if isinstance(value, dict) else value
