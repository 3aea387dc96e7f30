"""Match logs that people bring as CSV files: read, checked and summed, a payoff for each arena."""

import csv
import sys
from collections import defaultdict
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from league.config.schema import ConfigError
from matchmaking.payoff import Payoff, tally
from matchmaking.ratings import Clusters
from storage.records import ArenaKey, Match, PairCounts

COLUMNS = ("arena", "side_a", "side_b", "wins_a", "draws", "wins_b")
SEED_PAIR = "seed_pair"
LARGEST = 10**9
"""Games in one row: more are a slip."""


class Result(NamedTuple):
    """A row of a log: games in which the same player was on side A."""

    arena: str
    a: str
    b: str
    wins: int
    draws: int
    losses: int
    seed_pair: str  # empty where none was given


class Log(NamedTuple):
    """All results of one arena."""

    payoff: Payoff
    clusters: Clusters  # of the seed pairs


def read(file: str) -> list[Result]:
    """The rows of a CSV file, `-` for standard input. Raises ConfigError, with the line that is wrong."""
    try:
        if file == "-":
            return parse(sys.stdin, "standard input")
        with Path(file).open(encoding="utf-8", newline="") as text:
            return parse(text, file)
    except OSError as error:
        raise ConfigError((), f"cannot read {file}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ConfigError((), f"{file} is not text in UTF-8: {error.reason} at byte {error.start}") from error


def parse(text: Iterable[str], source: str) -> list[Result]:
    """The rows of a log. `source` is what messages call it. Raises ConfigError."""
    lines = csv.reader(text, strict=True, skipinitialspace=True)
    try:
        header = [name.strip("\ufeff \t") for name in next(lines, [])]
        places = _places(header, source)
        found = []
        for fields in lines:
            if any(map(str.strip, fields)):
                found.append(_result(fields, header, places, f"{source}:{lines.line_num}: "))
    except csv.Error as error:
        raise ConfigError((), f"{error}", f"{source}:{lines.line_num}: ") from error
    if not any(result.wins or result.draws or result.losses for result in found):
        raise ConfigError((), f"{source} has no game in it: a row is {','.join(COLUMNS)}")
    return found


def choose(results: Sequence[Result], arena: str | None, source: str) -> list[Result]:
    """Those of one arena: the one asked for, or the only one. Raises ConfigError."""
    there = sorted({result.arena for result in results})
    if arena is None and len(there) > 1:
        told = f"{source} has results of {len(there)} arenas, whose ratings are not comparable"
        raise ConfigError(("arena",), f"{told}: choose one with --arena: {_listed(there)}")
    if arena is not None and arena not in there:
        raise ConfigError(("arena",), f"there is no arena {arena!r} in {source}{_near(arena, there)}")
    return [result for result in results if arena in (None, result.arena)]


def known(name: str, names: Sequence[str], source: str) -> str:
    """The name, if somebody has it. Raises ConfigError."""
    if name not in names:
        raise ConfigError(("anchor",), f"there is no player {name!r} in {source}{_near(name, names)}")
    return name


def sums(results: Iterable[Result]) -> Log:
    """One arena's results, summed: what order they come in, and how games are spread over rows, changes nothing."""
    counts: dict[tuple[str, str], list[int]] = defaultdict(lambda: [0, 0, 0])  # wins, draws, losses of the one on A
    clusters: dict[tuple[str, str, str], list[float]] = defaultdict(lambda: [0, 0, 0])  # see Clusters
    arena = ""
    for arena, a, b, wins, draws, losses, seed_pair in results:  # noqa: B007  (all are of one)
        _add(counts[a, b], wins, draws, losses)
        games, score = wins + draws + losses, wins + draws / 2
        if seed_pair and a < b:
            _add(clusters[a, b, seed_pair], games, 0, score)
        elif seed_pair:
            _add(clusters[b, a, seed_pair], 0, games, games - score)
    payoff = tally([_match(ArenaKey(arena, "", ""), *pair, *side) for pair, side in counts.items()])
    ends = zip(payoff.first.tolist(), payoff.second.tolist(), strict=True)
    edges = {(payoff.names[i], payoff.names[j]): edge for edge, (i, j) in enumerate(ends)}
    kinds = [(edges[a, b], *of) for (a, b, _), of in clusters.items() if of[0] + of[1] > 1]
    rows, number = np.unique(np.array(kinds, float).reshape(-1, 4), axis=0, return_counts=True)
    edge, home, away, score = rows.T
    return Log(payoff, Clusters(edge.astype(int), home, away, score, number.astype(float)))


def _add(to: list[Any], *new: float) -> None:
    for i, each in enumerate(new):
        to[i] += each


def _match(key: ArenaKey, a: str, b: str, wins: int, draws: int, losses: int) -> Match:
    """Games in which a was on side A, which is team 0."""
    return Match("", key, a, b, wins, draws, losses, 0, wins, draws, losses, PairCounts(), seed=0)


def _places(header: Sequence[str], source: str) -> dict[str, int]:
    """Where each column stands."""
    if not any(header):
        raise ConfigError((), f"{source} is empty: its first line names the columns {','.join(COLUMNS)}")
    for name in COLUMNS:
        if name not in header:
            near = get_close_matches(name, [each for each in header if each not in COLUMNS], 1)
            hint = f" (is it {near[0]!r}?)" if near else ""
            needs = f"the first line names the columns {','.join(COLUMNS)}, and {SEED_PAIR} if there are seed pairs"
            raise ConfigError((), f"there is no column {name}{hint}: {needs}", f"{source}:1: ")
    for name in (*COLUMNS, SEED_PAIR):
        if header.count(name) > 1:
            raise ConfigError((), f"there are {header.count(name)} columns {name}", f"{source}:1: ")
    return {name: header.index(name) for name in (*COLUMNS, SEED_PAIR) if name in header}


def _result(fields: Sequence[str], header: Sequence[str], places: dict[str, int], place: str) -> Result:
    if len(fields) != len(header):
        raise ConfigError((), f"{len(fields)} fields where the first line names {len(header)} columns", place)
    value = {name: fields[at].strip() for name, at in places.items()}
    for name in ("arena", "side_a", "side_b"):
        if not value[name]:
            raise ConfigError((), f"{name} is empty: it must be a name", place)
    if value["side_a"] == value["side_b"]:
        raise ConfigError((), f"{value['side_a']!r} plays against itself, which says nothing of strength", place)
    wins, draws, losses = (_count(value[name], name, place) for name in ("wins_a", "draws", "wins_b"))
    return Result(value["arena"], value["side_a"], value["side_b"], wins, draws, losses, value.get(SEED_PAIR, ""))


def _count(text: str, name: str, place: str) -> int:
    if not (text.isascii() and text.isdigit()):
        raise ConfigError((), f"{name} is {text!r}: a count is a whole number, 0 or more", place)
    if len(text) > 20 or int(text) > LARGEST:
        raise ConfigError((), f"{name} is {text}: a row has at most {LARGEST:,} games", place)
    return int(text)


def _near(name: str, names: Sequence[str]) -> str:
    near = get_close_matches(name, names, 1)
    return f": did you mean {near[0]!r}?" if near else f"; there is: {_listed(names)}"


def _listed(names: Sequence[str], most: int = 20) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
