"""The findings of a store's verification."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from storage.maintenance.archive import shortened
from storage.records import Job

ProgressCallback = Callable[[str, int, int | None], None]
"""Callback with the kind of work, the amount done, and the total (None: unknown)."""
Kind = Literal["missing", "orphaned", "corrupt"]

JobReferences = Callable[[Job], Iterable[tuple[str, str]]]
"""Function from a job to the players and snapshots that its payload refers to: the table and the name of each."""


class StoreFinding(NamedTuple):
    """A fault found in a store."""

    kind: Kind
    place: str  # such as "database", "matches cup/17" or "blob 01ab..."
    problem: str
    bytes: int = 0  # size, if orphaned


@dataclass
class VerificationReport:
    """The amounts of data verified, and the findings."""

    where: str
    rows: int = 0
    blobs: int = 0  # blobs that rows name
    recordings: int = 0  # recordings among them
    dropped: int = 0  # blobs that a row once named and that may be removed
    dropped_bytes: int = 0
    references_known: bool = True  # all rows were read, so that orphans are known
    findings: list[StoreFinding] = field(default_factory=list)

    @property
    def damaged(self) -> bool:
        """True if anything is missing or corrupt. An orphaned blob takes space, but nothing is lost."""
        return any(finding.kind != "orphaned" for finding in self.findings)

    def add(self, kind: Kind, place: str, problem: object, size: int = 0) -> None:
        """Add a finding, as text that any terminal can print."""
        self.findings.append(StoreFinding(kind, single_line(place), single_line(problem), size))


class BlobReference(NamedTuple):
    """A row that names a blob."""

    table: str
    place: str
    sides: frozenset[str]  # snapshot names, for a match
    script: str | None  # for a snapshot
    training: bool = False  # a training match: its recording names players, between two of their snapshots

    @property
    def is_match(self) -> bool:
        """True if the blob is a match's recording."""
        return self.table in ("matches", "ranked_matches")


def single_line(what: object) -> str:
    """Return a text of a damaged store as one line that any terminal can print."""
    return "".join(c if c.isprintable() else "?" for c in shortened(what).encode(errors="replace").decode())
