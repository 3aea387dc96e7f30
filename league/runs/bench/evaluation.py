"""An entry from its files to its JSON: check, play, measure."""

import os
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from pathlib import Path
from typing import Any

from league.config import experiment
from league.config.schema import ConfigError
from league.runs.bench import attackers, entry_file, exact, references
from league.runs.bench import entrants as entries
from league.runs.bench.attackers import exploitability
from league.runs.bench.entrants import Entrant
from league.runs.bench.games import BenchLeague, bench_league
from league.runs.bench.metrics import MIDDLE, metrics, seconds_to_75
from league.runs.bench.partial_rows import PartialRows, Row
from league.runs.bench.references import Reference, ReferenceSet
from league.runs.bench.tasks import BATCH, GAMES, Task
from league.snapshots.policy_file import Policy
from league.snapshots.transfer.arena_transfer import changed_actions_of
from league.system.packages.versions import versions
from league.system.provenance import code
from storage.errors import UnknownName

Pair = tuple[str, str]
Progress = Callable[[int, int], None]  # games played, of how many


@dataclass(frozen=True, kw_only=True)
class Request:
    """An entry beside its task and its policies. Raises ConfigError for a number of games that cannot be played."""

    name: str
    about: str = ""
    track: str | None = None  # a name of tasks.TRACKS
    games: int = GAMES
    seed: int | None = None  # None: that of records
    against: tuple[str, ...] = ()  # names of references; empty: all
    attack: int | None = None  # steps of the shorter attack; None: exploitability is not measured
    attackers: int = 1  # seeds of attackers against each policy
    curve: tuple[tuple[float, str], ...] = ()  # seconds of training and the policy's file then, of one training
    partial: Path | None = None  # the file of rows so far, which a run that was stopped left

    def __post_init__(self) -> None:
        if self.games < 2 or self.games % (2 if self.games <= BATCH else BATCH):
            raise ConfigError(
                ("games",), f"--games is {self.games}: it must be even, and above {BATCH} a multiple of {BATCH}"
            )

    @property
    def trial(self) -> bool:
        """Return whether the result is no record."""
        return self.games < GAMES or bool(self.against) or self.seed is not None


def evaluate(
    task: Task, words: Sequence[str], request: Request, progress: Progress = lambda games, of: None,
    tell: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:  # fmt: skip
    """Check an entry's policies, play their games, and return the content of its file, without its digest.

    Raises ConfigError or StorageError, one line, for policies that do not fit, before anything is played.
    """
    entrants, known = entries.read(task, words), references.of(task)
    learnt = _of_curve(task, request, known)
    if not entrants:
        raise ConfigError(("entry",), f"league bench {task.name} needs --entry FILE: a policy to measure")
    seed = task.seed if request.seed is None else request.seed
    partial = PartialRows(request.partial, _decisive(task, [*entrants, *learnt], known, request.games, seed))
    task.build()
    for line in _changed_actions(task, entrants):
        tell(line)
    rows, attacks = (
        (exact.rows(task, entrants), [])
        if task.exact
        else _played(task, entrants, learnt, known, request, seed, partial, progress, tell)
    )
    times = sorted(seconds for seconds, _ in request.curve)
    curve = [{**each.as_json(), "seconds": time} for each, time in zip(learnt, times, strict=True)]
    return {
        "format": entry_file.FORMAT, "name": request.name, "about": request.about, "task": task.name,
        "config_hash": task.config_hash, "references": known.digest, "package": versions().get("robot-league", "?"),
        "commit": code().get("commit"), "versions": versions(), "device": device(), "engine": "c", "seed": seed,
        "games": 0 if task.exact else request.games, "trial": request.trial and not task.exact,
        "seconds": round(partial.seconds, 1), "policies": [e.as_json() for e in entrants], "rows": rows,
        "attacks": attacks, "curve": curve, "track": request.track,
        "metrics": measured(task, [e.name for e in entrants], rows, attacks, curve, known),
    }  # fmt: skip


def _changed_actions(task: Task, entrants: Sequence[Entrant]) -> Iterator[str]:
    """Yield a line for each policy whose robot's actions meant something else where it learnt."""
    here = experiment.dumps(task.config(), comments=False)
    for each in entrants:
        if isinstance(each.content, Policy):
            yield from (f"{each.name}: {line}" for line in changed_actions_of(each.content, here))


def measured(
    task: Task, policies: Sequence[str], rows: Sequence[Row], attacks: Sequence[Row],
    curve: Sequence[Mapping[str, Any]], known: ReferenceSet,
) -> dict[str, Any]:  # fmt: skip
    """Return all metrics of an entry, from its rows. Raises StorageError, one line, for damaged rows."""
    if task.exact:
        return exact.metrics(task, rows)
    return {
        **metrics(task, policies, rows, known),
        "exploitability": exploitability(task, attacks),
        "seconds_to_75": seconds_to_75(task, curve, rows, known),
    }


def _of_curve(task: Task, request: Request, known: ReferenceSet) -> list[Entrant]:
    """Return the policies of a training, the earliest first. Raises ConfigError where there is nothing to measure."""
    if not request.curve:
        return []
    if not task.alike:
        raise ConfigError(("curve",), f"--curve is for tasks of like sides, and those of {task.name} are unlike")
    if all(each.stage != MIDDLE for each in known.references):
        raise ConfigError(("curve",), f"--curve: {task.name} has no reference of a middle stage yet")
    return entries.read(task, [file for _, file in sorted(request.curve)], "c")


def _played(
    task: Task, entrants: Sequence[Entrant], learnt: Sequence[Entrant], known: ReferenceSet, request: Request,
    seed: int, partial: PartialRows, progress: Progress, tell: Callable[[str], None],
) -> tuple[list[Row], list[Row]]:  # fmt: skip
    """Return the rows of all games of an entry, and those of its attackers."""
    chosen = [each for each in known.references if not request.against or each.name in request.against]
    if unknown := set(request.against) - set(known.names):
        raise UnknownName("reference", min(unknown), known.names)
    middle = [each.name for each in known.references if each.stage == MIDDLE]
    pairs = [*_pairs(task, entrants, chosen), *missing(task, known, chosen)]
    pairs += [(each.name, name) for each in learnt for name in middle]
    chosen += [each for each in known.references if learnt and each.name in middle and each not in chosen]
    done, rows = 0, []
    with bench_league(task, request.games) as league:
        bring_in(league, chosen)
        for entrant in (*entrants, *learnt):
            entrant.add_to(league.opened)
        league.make_room()

        def count(games: int) -> None:
            nonlocal done
            done += games
            progress(done, len(pairs) * request.games)

        for a, b in pairs:
            rows += league.play(a, b, request.games, seed, count, partial)
        if request.attack is None:
            return rows, []
        names, seeds = [entrant.name for entrant in entrants], range(1, request.attackers + 1)
        return rows, attackers.attacks(league, names, request.attack, seeds, request.games, partial, tell)


def _decisive(
    task: Task, policies: Sequence[Entrant], known: ReferenceSet, games: int, seed: int
) -> dict[str, str | int | None]:
    """Return all that decides the rows of an entry, by name."""
    return {
        "task": task.name, "configuration": task.config_hash, "set of references": known.digest,
        "version of the package": versions().get("robot-league", "?"), "commit": code().get("commit"),
        "seed": seed, "number of games": games, **{f"policy {each.name}": each.digest for each in policies},
    }  # fmt: skip


def bring_in(league: BenchLeague, chosen: Sequence[Reference]) -> None:
    """Add references to a league of their task."""
    for each in chosen:
        references.bring_in(league.opened, league.task, each)


def _pairs(task: Task, entrants: Sequence[Entrant], chosen: Sequence[Reference]) -> Iterator[Pair]:
    """Yield the pairs of an entry's policies with the references, and with each other."""
    names = {team: [e.name for e in entrants if e.team == team] for team in task.teams}
    for entrant in entrants:
        yield from ((entrant.name, each.name) for each in chosen if task.alike or each.team != entrant.team)
    if task.alike:
        yield from combinations(names[task.teams[0]], 2)
    elif len(entrants) > len(task.teams):
        first, second = names.values()
        yield from product(first, second)


def missing(task: Task, known: ReferenceSet, chosen: Sequence[Reference]) -> Iterator[Pair]:
    """Yield the pairs of references whose games against each other do not come with the package."""
    played = {frozenset((row["a"], row["b"])) for row in known.rows}
    for a, b in combinations(chosen, 2):
        if (task.alike or a.team != b.team) and frozenset((a.name, b.name)) not in played:
            yield a.name, b.name


def device() -> str:
    """Return the processor of this machine and the number of cores that this process may use."""
    named = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
        named = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return f"{named}, {len(os.sched_getaffinity(0))} cores"
