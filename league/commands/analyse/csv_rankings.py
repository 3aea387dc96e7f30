"""Rankings in users' CSV files, of events of any number of players: read, checked and made a payoff."""

import numpy as np

from league.commands.analyse.csv_columns import (
    Ranks,
    Words,
    coded_columns,
    column_places,
    rank_of,
    require_name,
    row_values,
)
from league.commands.analyse.csv_log import Log
from league.config import text_files
from league.config.schema import ConfigError
from matchmaking.ratings.likelihoods.dispersion import NO_CLUSTERS
from matchmaking.ratings.payoff import rankings_payoff
from matchmaking.ratings.rankings import Rankings

COLUMNS = ("event", "player", "rank")
MAX_PLAYERS, MAX_TIED = 500, 20
"""Most players of an event, and most that share a rank in it: the fit takes time with the square of the first, and
loses digits with the second.
"""


def read(file: str) -> Log:
    """Read the rankings of a CSV file, `-` for standard input. Raises ConfigError, which names what is wrong."""
    return parse(text_files.read(file), text_files.STDIN if file == "-" else file)


def parse(text: str, source: str) -> Log:
    """Parse rankings, separated by commas, semicolons or tabs. `source` is its name in messages. Raises ConfigError."""
    separator = text_files.separator(text, COLUMNS)
    lines = text_files.rows(text, separator, source)
    _, header = next(lines, (0, []))
    header = [name.strip(" \t") for name in header]
    places = column_places(header, source, COLUMNS)
    events, players = Words(), Words()
    found = coded_columns(
        text, separator, places, len(header), {"event": events, "player": players, "rank": Ranks()}
    )  # fmt: skip
    if found is None or _repeats(found["event"], found["player"]):  # row by row, to find the one that is wrong
        events, players, rows, seen = {}, {}, [], set()
        for line, fields in lines:
            place = f"{source}:{line}: "
            event, player, rank = _row(row_values(fields, header, places, place), place)
            if (event, player) in seen:
                raise ConfigError((), f"{player!r} is in event {event!r} twice", place)
            seen.add((event, player))
            rows.append((events.setdefault(event, len(events)), players.setdefault(player, len(players)), rank))
        table = np.array(rows, float).reshape(-1, 3)
        event, player, rank = table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2]
        names, titles = list(players), list(events)
    else:
        event, player, rank = (found[name] for name in COLUMNS)
        names, titles = players.words, events.words
    if not len(event):
        raise ConfigError((), f"{source} has no event in it: a row is {','.join(COLUMNS)}")
    _require_sizes(event, rank, titles, source)
    order = np.argsort(names)
    now = np.empty(len(names), int)
    now[order] = np.arange(len(names))
    sorted_names = tuple(names[i] for i in order.tolist())
    return Log(rankings_payoff(sorted_names, Rankings.of_events(event, now[player], rank)), NO_CLUSTERS)


def _row(value: dict[str, str], place: str) -> tuple[str, str, float]:
    for name in ("event", "player"):
        require_name(value[name], name, place)
    if (rank := rank_of(value["rank"])) is None:
        raise ConfigError(
            (),
            f"rank is {value['rank'][:40]!r}: it must be a number, 1 for the best; who has no rank has no row",
            place,
        )
    return value["event"], value["player"], rank


def _repeats(event: np.ndarray, player: np.ndarray) -> bool:
    """Return whether a player is in an event twice."""
    key = np.sort(event * (int(player.max(initial=0)) + 1) + player)
    return bool((key[1:] == key[:-1]).any())


def _require_sizes(event: np.ndarray, rank: np.ndarray, titles: list[str], source: str) -> None:
    """Raise ConfigError for an event of one player, or with more players or ties than can be fitted."""
    sizes = np.bincount(event)
    for number in np.flatnonzero(sizes < 2)[:1]:
        what = f"event {titles[number]!r} has one player: a ranking needs two or more"
        raise ConfigError((), what, f"{source}: ")
    for number in np.flatnonzero(sizes > MAX_PLAYERS)[:1]:
        what = f"event {titles[number]!r} has {sizes[number]:,} players: at most {MAX_PLAYERS} can be rated together"
        raise ConfigError((), what, f"{source}: ")
    order = np.lexsort((rank, event))
    new = np.append(True, (np.diff(event[order]) != 0) | (np.diff(rank[order]) != 0))
    starts = np.flatnonzero(new)
    tied = np.diff(np.append(starts, len(event)))
    for at in np.flatnonzero(tied > MAX_TIED)[:1]:
        title = titles[event[order[starts[at]]]]
        what = (
            f"in event {title!r} {tied[at]:,} players share a rank: at most {MAX_TIED} can; leave out who has no rank"
        )
        raise ConfigError((), what, f"{source}: ")
