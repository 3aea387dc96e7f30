"""Entries as they are given on a command line: a policy file for each side, checked before anything is played."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arenas import rosters
from league.config.schema import ConfigError
from league.queries.query import Open
from league.runs.bench.tasks import Task
from league.snapshots import policy_file
from league.snapshots.policy_file import Policy
from league.snapshots.programs import stored
from league.snapshots.programs.kinds import kind_of
from league.snapshots.programs.stored import Program
from storage.blobs import arrays
from storage.records import Snapshot

SLOWEST = 2e-3
"""Seconds that a decision of a whole team may take in one world, on the CPU."""
PARAMETERS = 4_000_000
"""Maximum number of a network's parameters, which bounds the time of its decisions."""


@dataclass(frozen=True)
class Entrant:
    """A policy of an entry for one side, checked. `name` is what rows of games call it: `e1`, or `e1:red`."""

    name: str
    team: str
    files: tuple[str, ...]
    content: Policy | Program
    digest: str  # SHA-256 of what acts

    def add_to(self, league: Open) -> Snapshot:
        """Add the policy to a league of its task."""
        if isinstance(self.content, Policy):
            return policy_file.bring_in(league, self.content, self.name)
        from league.snapshots.programs import importing

        players = league.store.players(league.league)
        return importing.bring_in(league, self.content, players[league.teams()[self.team]].roster, self.name)

    def as_json(self) -> dict[str, Any]:
        """Return what an entry's file tells of the policy."""
        kind = "network" if isinstance(self.content, Policy) else self.content.kind
        return {"name": self.name, "team": self.team, "files": list(self.files), "kind": kind, "sha256": self.digest}


def read(task: Task, words: Sequence[str], letter: str = "e") -> list[Entrant]:
    """Read the policies that words name: FILE where sides are alike, else TEAM=FILE, as often for each team.

    A FILE is what `league import` takes: a policy that `league export` wrote, one that comes with the package, x.onnx,
    x.pt or x.py:function, with commas between those of several agents. A policy's name is `letter` with a number.
    Raises ConfigError or StorageError, one line.
    """
    by_team: dict[str, list[str]] = {team: [] for team in task.teams}
    for word in words:
        team, file = _side(task, word)
        if "" in (parts := file.split(",")):
            raise ConfigError(
                ("entry",),
                f"{word} names no file {'at all' if len(parts) == 1 else 'beside one of its commas'}: the"
                " files of a team's agents are one word, a.onnx,b.onnx without spaces",
            )
        by_team[team].append(file)
    counts = {team: len(files) for team, files in by_team.items()}
    if len(set(counts.values())) > 1:
        least = min(counts, key=lambda team: counts[team])
        told = " and ".join(f"{number} for {team}" for team, number in counts.items())
        raise ConfigError(
            ("entry",), f"{task.name} has unlike sides, and a policy for {least} is missing ({told}): give"
            f" --entry {' '.join(f'{team}=FILE' for team in task.teams)}",
        )  # fmt: skip
    found: list[Entrant] = []
    for team, files in by_team.items():
        for number, file in enumerate(files, 1):
            entrant = _read(task, team, file, f"{letter}{number}" if task.alike else f"{letter}{number}:{team}")
            if twin := next((e for e in found if e.team == team and e.digest == entrant.digest), None):
                both = f" (it plays both sides of {task.name})" if task.alike else ""
                raise ConfigError(
                    ("entry",), f"{file} is the same policy as {','.join(twin.files)}: give each once{both}"
                )
            found.append(entrant)
    return found


def _side(task: Task, word: str) -> tuple[str, str]:
    team, equals, file = word.partition("=")
    if equals and team in task.sides:
        return (task.teams[0] if task.alike else team), file
    if not task.alike:
        wanted = " ".join(f"{each}=FILE" for each in task.teams)
        if equals and not Path(word).exists():
            raise ConfigError(("entry",), f"{word}: {task.name} has no side {team!r}, and takes --entry {wanted}")
        raise ConfigError(("entry",), f"{word} does not name its side: {task.name} takes --entry {wanted}")
    if equals and team.isidentifier() and not Path(word.partition(",")[0]).exists():
        raise ConfigError(("entry",), f"{word}: the sides of {task.name} are alike; give --entry FILE, no {team}=")
    return task.teams[0], word


def _read(task: Task, team: str, file: str, name: str) -> Entrant:
    roster = task.sides[team]
    if kind := kind_of(file):
        program = stored.read(kind, file.split(","), roster)
        _require_small(file, stored.parameters(program))
        each = program.seconds / stored.TIMED
        if each > SLOWEST and not task.exact:
            raise ConfigError(
                ("entry",), f"{file} is too slow: decisions take {1e3 * each:.3g} ms each in {stored.TIMED} worlds,"
                f" and a team has {1e3 * SLOWEST:g} ms",
            )  # fmt: skip
        return Entrant(name, team, _names(program), program, hashlib.sha256(program.to_bytes()).hexdigest())
    policy = policy_file.read(policy_file.find(file))
    if rosters.matching_roster(policy.about["roster"], (roster,)) is None:
        raise ConfigError(
            ("entry",), f"{file} is a policy for {policy.about['roster']}, and {team} of {task.name} is {roster}"
        )
    _require_small(file, sum(array.size for array in policy.arrays.values()))
    digest = hashlib.sha256(arrays.to_bytes(policy.arrays)).hexdigest()
    return Entrant(name, team, (Path(file).name,), policy, digest)


def _require_small(file: str, size: int) -> None:
    if size > PARAMETERS:
        raise ConfigError(
            ("entry",), f"{file} is too large: it has {size:,} parameters, and {PARAMETERS:,} are allowed"
        )


def _names(program: Program) -> tuple[str, ...]:
    """Return the names of a program's files without folders."""
    return tuple(Path(name).name for name, _ in program.files)
