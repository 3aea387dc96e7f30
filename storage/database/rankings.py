"""Rankings of teams as JSON, and the checks of a ranked match."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from storage.records import competition_ranks


def rankings_json(rankings: Mapping[tuple[int, ...], int]) -> dict[str, int]:
    """Return rankings as a JSON object such as {"1,2,2": 5}."""
    return {",".join(map(str, ranks)): number for ranks, number in rankings.items()}


def parse_rankings(value: object) -> dict[tuple[int, ...], int]:
    """Return the rankings in a JSON object such as {"1,2,2": 5}. Raises TypeError or ValueError for anything else."""
    if not isinstance(value, dict):
        raise TypeError(f"{str(value)[:40]!r} is no JSON object")
    found = {}
    for text, number in value.items():
        if isinstance(number, bool) or not isinstance(number, int):
            raise TypeError(f"{str(number)[:40]!r} is no number of episodes")
        found[tuple(int(rank) for rank in text.split(","))] = number
    return found


def tuple_of(kind: type, value: object) -> tuple:
    """Return a JSON list of values of one type as a tuple. Raises TypeError for anything else."""
    if not isinstance(value, list) or not all(type(each) is kind for each in value):
        raise TypeError(f"{str(value)[:40]!r} is no list of {kind.__name__}")
    return tuple(value)


def check_rankings(
    snapshots: Sequence[str], rankings: Mapping[tuple[int, ...], int], voids: int, voids_by_team: Sequence[int]
) -> None:
    """Raise ValueError, with the reason, for counts of a ranked match that no episodes can have."""
    teams = len(snapshots)
    if teams < 3:
        raise ValueError(f"it has {teams} teams, and a ranked match has three or more")
    if len(voids_by_team) != teams:
        raise ValueError(f"it has {teams} teams, and voids of {len(voids_by_team)}")
    if min(voids_by_team) < 0 or sum(voids_by_team) > voids:
        raise ValueError(f"of {voids} voids, {', '.join(map(str, voids_by_team))} were one team's")
    for ranks, number in rankings.items():
        if len(ranks) != teams or competition_ranks(ranks) != tuple(ranks):
            raise ValueError(f"{','.join(map(str, ranks))[:60]} is no ranking of {teams} teams")
        if number < 0:
            raise ValueError(f"{number} episodes ended {','.join(map(str, ranks))}")


FROM_COLUMNS: Mapping[str, Callable[[Sequence[Any]], Any]] = {
    "snapshots": lambda values: tuple_of(str, values[0]),
    "voids_by_team": lambda values: tuple_of(int, values[0]),
    "rankings": lambda values: parse_rankings(values[0]),
}
"""Functions that make a field of a ranked match from its column."""
