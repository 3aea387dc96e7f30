"""Match logs in users' CSV files: read, checked and summed to a payoff for each arena."""

from collections.abc import Sequence
from difflib import get_close_matches
from typing import Any, NamedTuple

import numpy as np

from league.commands.analyse.csv_columns import Columns, column_places, quick, require_name, row_values
from league.config import text_files
from league.config.schema import ConfigError
from matchmaking.ratings.likelihoods.dispersion import Clusters
from matchmaking.ratings.payoff import Payoff, sum_matches
from storage.records import ArenaKey, MatchTotals

COLUMNS = ("arena", "side_a", "side_b", "wins_a", "draws", "wins_b")
SEED_PAIR = "seed_pair"
LARGEST = 10**9
"""Most games in one row: a larger number is a mistake."""


class Result(NamedTuple):
    """A row of a log: games in which the same player was on side A."""

    arena: str
    a: str
    b: str
    wins: int
    draws: int
    losses: int
    seed_pair: str  # empty if none was given


class Log(NamedTuple):
    """All results of one arena."""

    payoff: Payoff
    clusters: Clusters  # of the seed pairs


def read(file: str) -> Columns:
    """Read the rows of a CSV file, `-` for standard input. Raises ConfigError, which names the wrong line."""
    return parse(text_files.read(file), text_files.STDIN if file == "-" else file)


def parse(text: str, source: str) -> Columns:
    """Parse the rows of a log, separated by commas, semicolons or tabs. `source` is its name in messages.

    Raises ConfigError.
    """
    separator = text_files.separator(text, COLUMNS)
    lines = text_files.rows(text, separator, source)
    _, header = next(lines, (0, []))
    header = [name.strip(" \t") for name in header]
    places = column_places(header, source, COLUMNS, [SEED_PAIR], f", and {SEED_PAIR} if there are seed pairs")
    found = quick(text, separator, places, len(header), LARGEST, SEED_PAIR)
    if found is None:  # row by row, to find the one that is wrong
        found = Columns.of(_result(fields, header, places, f"{source}:{line}: ") for line, fields in lines)
    if not found.games.any():
        raise ConfigError((), f"{source} has no game in it: a row is {','.join(COLUMNS)}")
    return found


def choose(results: Columns, arena: str | None, source: str) -> Columns:
    """Return the results of one arena: the requested arena, or the only one. Raises ConfigError."""
    there = sorted(results.arenas)
    if arena is None and len(there) > 1:
        problem = f"{source} has results of {len(there)} arenas, whose ratings are not comparable"
        raise ConfigError(("arena",), f"{problem}: choose one with --arena: {_listed(there)}")
    if arena is not None and arena not in there:
        raise ConfigError(("arena",), f"there is no arena {arena!r} in {source}{_near(arena, there)}")
    return results.only(arena or there[0])


def known(name: str, names: Sequence[str], source: str) -> str:
    """Return the name, if a player has it. Raises ConfigError."""
    if name not in names:
        raise ConfigError(("anchor",), f"there is no player {name!r} in {source}{_near(name, names)}")
    return name


def sums(results: Columns) -> Log:
    """Sum one arena's results; their order, and the division of games into rows, do not change the sums."""
    a, b, names = results.a, results.b, results.names
    order, starts = _runs(a, b)
    totals = np.add.reduceat(results.games[order], starts)
    a, b = a[order[starts]], b[order[starts]]
    rest = np.zeros((len(starts), 8), np.int64)
    key = ArenaKey(results.arenas[int(results.arena[0])], "", "")
    counts: Any = np.concatenate([totals, totals, rest], 1)  # the player in column A was on side A, which is team 0
    first, second = ([names[int(i)] for i in side.tolist()] for side in (a, b))
    payoff = sum_matches(MatchTotals(key, first, second, counts, [0.0] * len(a), 0))
    return Log(payoff, _clusters(results, payoff))


def _clusters(results: Columns, payoff: Payoff) -> Clusters:
    """Group the games of each seed pair of two players, if it has more than one game; equal groups are counted."""
    place = np.array([payoff.positions.get(name, -1) for name in results.names], int)
    given = results.seed >= 0
    a, b, seed, games = place[results.a[given]], place[results.b[given]], results.seed[given], results.games[given]
    number, score = games.sum(1).astype(float), games[:, 0] + games[:, 1] / 2
    turned = a > b
    edge = payoff.edges(a, b)
    of = np.stack(
        [np.where(turned, 0, number), np.where(turned, number, 0), np.where(turned, number - score, score)], 1
    )
    order, starts = _runs(edge, seed)
    found = np.add.reduceat(of[order], starts) if len(starts) else of
    found = np.column_stack([edge[order[starts]], found])[found[:, :2].sum(1) > 1]
    rows, times = np.unique(found, axis=0, return_counts=True)
    edge, home, away, score = rows.T
    return Clusters(edge.astype(int), home, away, score, times.astype(float))


def _runs(*keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return an order that groups rows with equal keys, and the start of each group in this order."""
    order = np.lexsort(keys)
    changes = np.any([np.diff(key[order], prepend=-2) != 0 for key in keys], 0)
    return order, np.flatnonzero(changes)


def _result(fields: Sequence[str], header: Sequence[str], places: dict[str, int], place: str) -> Result:
    value = row_values(fields, header, places, place)
    for name in ("arena", "side_a", "side_b"):
        require_name(value[name], name, place)
    if value["side_a"] == value["side_b"]:
        raise ConfigError((), f"{value['side_a']!r} plays against itself, which says nothing of strength", place)
    wins, draws, losses = (_count(value[name], name, place) for name in ("wins_a", "draws", "wins_b"))
    return Result(value["arena"], value["side_a"], value["side_b"], wins, draws, losses, value.get(SEED_PAIR, ""))


def _count(text: str, name: str, place: str) -> int:
    if not (text.isascii() and text.isdigit()):
        raise ConfigError((), f"{name} is {text[:40]!r}: a count is a whole number, 0 or more", place)
    if len(text) > 20 or int(text) > LARGEST:
        raise ConfigError((), f"{name} is {text[:40]}: a row has at most {LARGEST:,} games", place)
    return int(text)


def _near(name: str, names: Sequence[str]) -> str:
    near = get_close_matches(name, names, 1)
    return f": did you mean {near[0]!r}?" if near else f"; there is: {_listed(names)}"


def _listed(names: Sequence[str], most: int = 20) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
