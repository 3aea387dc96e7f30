"""What is found in a store that is looked through."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from storage.archive import shortened
from storage.records import Job

Tell = Callable[[str, int, int | None], None]
"""Is told how it goes on: of what, how much, and of how much (None: that is not known)."""
Kind = Literal["missing", "orphaned", "corrupt"]

Refer = Callable[[Job], Iterable[tuple[str, str]]]
"""Tells to which players and snapshots a job's payload points: the table and the name of each."""


class Finding(NamedTuple):
    """Something that is not as it should be."""

    kind: Kind
    place: str  # such as "database", "matches cup/17" or "blob 01ab..."
    problem: str
    bytes: int = 0  # of what is orphaned


@dataclass
class Report:
    """What was looked at, and what was found."""

    where: str
    rows: int = 0
    blobs: int = 0  # that rows name
    recordings: int = 0  # those of them that are recordings
    dropped: int = 0  # blobs that a row named once and may be removed
    dropped_bytes: int = 0
    told: bool = True  # whether it is known what is orphaned
    findings: list[Finding] = field(default_factory=list)

    @property
    def damaged(self) -> bool:
        """Whether anything is missing or corrupt. What is orphaned takes space, and is nobody's loss."""
        return any(finding.kind != "orphaned" for finding in self.findings)

    def add(self, kind: Kind, place: str, problem: object, size: int = 0) -> None:
        """Add a finding, as text that any terminal takes."""
        self.findings.append(Finding(kind, plain(place), plain(problem), size))


class Use(NamedTuple):
    """A row that names a blob."""

    table: str
    place: str
    sides: frozenset[str]  # of a match
    script: str | None  # of a snapshot
    training: bool = False  # whether a match is of training: its recording names players between two snapshots


def plain(what: object) -> str:
    """What a damaged store says, as one line of text that any terminal takes."""
    return "".join(c if c.isprintable() else "?" for c in shortened(what).encode(errors="replace").decode())
