"""The public references of the tasks: scripts, policies that come with the package, and small policies of the bench.

`references/manifest.json` has a list for each task. A reference has a `name`, a `kind` (script, shipped, learnt or
exploiter), and in a task of unlike sides its `team`. All but scripts have the SHA-256 of their file and their
`provenance` in words, a learnt one also its `file`, its `stage` (early, middle or late), and the seed and steps of its
training. Beside the list stands the file with the games of the references against each other, to which every rating is
fitted, and `former`: the digest and the names of each smaller set that entries met before references were added.
"""

import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from league.queries.query import Open
from league.runs.bench.tasks import Task
from league.snapshots import policy_file
from league.snapshots.policy_file import Policy
from storage.blobs import arrays
from storage.errors import StorageError

FOLDER = Path(__file__).parent / "references"
Kind = Literal["script", "shipped", "learnt", "exploiter"]


@dataclass(frozen=True)
class Reference:
    """A public opponent of a task."""

    name: str  # in rows of games; that of a script is its name in a league, such as pusher or idle:red
    kind: Kind
    team: str | None = None  # in a task of unlike sides
    policy: str = ""  # of a shipped one, its name in the package
    copies: int = 1  # number of agents that act by its file's one
    file: str = ""  # of others that learnt
    sha256: str = ""  # of its file, or of the shipped policy's
    stage: str = ""
    seed: int | None = None
    steps: int | None = None
    provenance: str = ""


@dataclass(frozen=True)
class ReferenceSet:
    """The references of a task, and their games against each other."""

    references: tuple[Reference, ...]
    rows: tuple[Mapping[str, Any], ...]
    digest: str  # of all that a rating depends on

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the references."""
        return tuple(each.name for each in self.references)

    def of(self, team: str | None) -> tuple[Reference, ...]:
        """Return the references of a side; of all sides if they are alike."""
        return tuple(each for each in self.references if each.team == team)

    def only(self, names: Collection[str], digest: str) -> "ReferenceSet":
        """Return the set of some of the references, and of their games against each other."""
        rows = (row for row in self.rows if row["a"] in names and row["b"] in names)
        return ReferenceSet(tuple(each for each in self.references if each.name in names), tuple(rows), digest)


def of(task: Task) -> ReferenceSet:
    """Return the references of a task. Raises StorageError if a file of the package is missing or damaged."""
    return _sets(task.name)[0]


def met(task: Task, digest: str) -> ReferenceSet | None:
    """Return the references with this digest, today's or a smaller set of former days; None if they are not known.

    Raises StorageError as `of`.
    """
    return next((known for known in _sets(task.name) if known.digest == digest), None)


@cache
def _sets(task: str) -> tuple[ReferenceSet, ...]:
    """Return the references of a task and the smaller sets of former days."""
    listed = json.loads(_checked(FOLDER / "manifest.json", ""))["tasks"].get(task, {"references": []})
    found = tuple(Reference(**each) for each in listed["references"])
    rows = json.loads(_checked(FOLDER / listed["rows"]["file"], listed["rows"]["sha256"])) if "rows" in listed else []
    today = ReferenceSet(found, tuple(rows), digest(listed))
    return today, *(today.only(former["names"], former["digest"]) for former in listed.get("former", ()))


def digest(listed: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a task's list in the manifest, without its former sets."""
    own = {key: value for key, value in listed.items() if key != "former"}
    return hashlib.sha256(json.dumps(own, sort_keys=True).encode()).hexdigest()


def bring_in(league: Open, task: Task, reference: Reference) -> None:
    """Add a reference to a league of its task; scripts are there already. Raises StorageError as `checked_file`."""
    if reference.kind == "script":
        return
    policy = copied(
        policy_file.read(checked_file(reference)), task.sides[reference.team or task.teams[0]], reference.copies
    )
    policy_file.bring_in(league, policy, reference.name)


def checked_file(reference: Reference) -> Path:
    """Return the file of a reference that is no script.

    Raises StorageError for a file that is damaged, or no longer the one that the other references met.
    """
    path = FOLDER / reference.file if reference.file else policy_file.find(reference.policy)
    _checked(path, reference.sha256)
    return path


def copied(policy: Policy, roster: str, copies: int) -> Policy:
    """Return the policy of one agent as that of a roster of so many agents, each of which acts by a copy."""
    if copies == 1:
        return policy
    tensors: dict[str, np.ndarray] = {
        f"{i}/{name.removeprefix('0/')}": array for i in range(copies) for name, array in policy.arrays.items()
    }
    digest = hashlib.sha256(arrays.to_bytes(tensors)).hexdigest()
    return Policy(tensors, {**policy.about, "roster": roster, "digest": digest})


def counted(references: Sequence[Reference]) -> str:
    """Describe a list of references by the number of each kind."""
    kinds = [each.kind for each in references]
    return ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds)) or "none"


def _checked(path: Path, sha256: str) -> bytes:
    """Return the bytes of a file, of this SHA-256 unless that is empty.

    Raises StorageError if the file is missing or is another one.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise StorageError(
            f"reference {path.name} of the bench is missing ({error.strerror}): reinstall robot-league."
        ) from None
    if sha256 and hashlib.sha256(data).hexdigest() != sha256:
        raise StorageError(
            f"reference {path.name} of the bench is not the one of its manifest: reinstall robot-league."
        )
    return data
