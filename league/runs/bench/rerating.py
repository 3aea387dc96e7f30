"""Ratings computed again from the rows of entries: the check of a pull request."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from league.runs.bench import references, tasks
from league.runs.bench.entry_file import EntryError
from league.runs.bench.evaluation import measured
from league.runs.bench.games import batch_seed
from league.runs.bench.references import ReferenceSet
from storage.errors import StorageError

CLOSE = {"elo": 0.05, "low": 0.05, "high": 0.05}
"""Differences in Elo that floating-point numbers of another machine may make; all other numbers differ by `TINY`."""
TINY = 2e-6


def again(content: Mapping[str, Any], known: ReferenceSet) -> dict[str, Any]:
    """Return the metrics of an entry that follow from its rows. Raises EntryError, one line, for damaged rows."""
    task = tasks.find(content["task"])
    try:
        names = [each["name"] for each in content["policies"]]
        return measured(task, names, content["rows"], content["attacks"], content["curve"], known)
    except StorageError as error:
        raise EntryError(f"Entry {content['name']}: {error}") from None
    except (LookupError, TypeError, AttributeError, ValueError, ArithmeticError) as error:
        raise EntryError(f"The rows of entry {content['name']} are damaged: {type(error).__name__} {error}.") from None


def differences(content: Mapping[str, Any]) -> list[str]:
    """Return the metrics of an entry that its rows contradict, a line each.

    An entry that met other references than this version knows is one line too.
    """
    if (known := references_of(content)) is None:
        return ["it met references that this version does not know: run `league bench` again"]
    found = again(content, known)
    lines = [line for key in found for line in _unlike(key, content["metrics"].get(key), found[key])]
    return [*_unlike_games(content, known), *_unlike_seeds(content), *lines]


def _unlike_games(content: Mapping[str, Any], known: ReferenceSet) -> Iterator[str]:
    """Yield a line if the rows have another number of games than `games`, and one if `trial` is wrong.

    Games of references against each other and of attackers are none of either.
    """
    task, seed = tasks.find(content["task"]), content.get("seed")
    if task.exact:
        return
    teams = {each["name"]: each["name"].partition(":")[2] for each in content["policies"]}
    counts: Counter[tuple[str, str]] = Counter()
    for row in content["rows"]:
        if row["a"] in teams:
            counts[row["a"], row["b"]] += sum(row["results"]) + row["voids"]
    if played := {number for number in counts.values() if number != content["games"]}:
        yield f"games is {content['games']!r}, and the rows have {min(played)} of a pair"
    missing = any(
        (name, each.name) not in counts
        for name, team in teams.items()
        for each in known.references
        if task.alike or each.team != team
    )
    trial = missing or seed != task.seed or min(counts.values(), default=0) < tasks.GAMES
    if trial != content["trial"]:
        yield f"trial is {content['trial']!r}, and its rows, references and seed make it {trial!r}"


def _unlike_seeds(content: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line if rows were not played from the entry's `seed`."""
    task, seed = tasks.find(content["task"]), content["seed"]
    if task.exact:
        return
    pairs: defaultdict[tuple[str, str], list[int]] = defaultdict(list)
    for row in content["rows"]:
        pairs[row["a"], row["b"]].append(row["seed"])
    for (a, b), found in pairs.items():
        if found != [batch_seed(task, seed, b, number) for number in range(len(found))]:
            yield f"seed is {seed!r}, and the games of {a} against {b} begin from other seeds"
            return


def references_of(content: Mapping[str, Any]) -> ReferenceSet | None:
    """Return the references that an entry met; None if this version does not know them."""
    return references.met(tasks.find(content["task"]), content["references"])


def of_today(content: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return an entry with its metrics among the references of today, to which others may have been added since."""
    today = references.of(tasks.find(content["task"]))
    return content if content["references"] == today.digest else {**content, "metrics": again(content, today)}


def check(entries: Mapping[Path, Mapping[str, Any]]) -> None:
    """Raise EntryError, one line, for the first entry whose rows contradict its figures."""
    for path, content in entries.items():
        if references_of(content) is not None and (lines := differences(content)):
            raise EntryError(f"{path} contradicts itself: {lines[0]}. `league bench rerate` tells all.")


def _unlike(where: str, told: Any, found: Any) -> Iterator[str]:
    """Yield a line for each number or text that differs between two JSON values."""
    if isinstance(found, Mapping) and isinstance(told, Mapping):
        for key in sorted({*found, *told}):
            yield from _unlike(f"{where}.{key}", told.get(key), found.get(key))
    elif isinstance(found, list) and isinstance(told, list) and len(found) == len(told):
        for i, (one, other) in enumerate(zip(told, found, strict=True)):
            yield from _unlike(f"{where}[{i}]", one, other)
    elif not _close(where, told, found):
        yield f"{where} is {_short(told)}, and the rows give {_short(found)}"


def _short(value: Any) -> str:
    """Return a value as text, and lists by their lengths."""
    return f"a list of {len(value)}" if isinstance(value, list) else repr(value)


def _close(where: str, told: Any, found: Any) -> bool:
    numbers = all(isinstance(x, int | float) and not isinstance(x, bool) for x in (told, found))
    if not numbers:
        return told == found
    elo = CLOSE.get(where.rpartition(".")[2], TINY) if ".rating." in where else TINY
    return math.isclose(told, found, abs_tol=elo)


def of_folder(entries: Mapping[Path, Mapping[str, Any]]) -> dict[Path, list[str]]:
    """Return the differences of each entry."""
    return {path: differences(content) for path, content in entries.items()}
