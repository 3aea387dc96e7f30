"""Rankings of teams as JSON, and the checks of a ranked match."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from storage.records import SeedCluster, competition_ranks


def rankings_json(rankings: Mapping[tuple[int, ...], int]) -> dict[str, int]:
    """Return rankings as a JSON object such as {"1,2,2": 5}."""
    return {",".join(map(str, ranks)): number for ranks, number in rankings.items()}


def clusters_json(clusters: Mapping[SeedCluster, int]) -> dict[str, int]:
    """Return seed clusters as a JSON object such as {"1,2,2;2,1,3;1,3,2": 5}."""
    return {";".join(",".join(map(str, ranks)) for ranks in each): number for each, number in clusters.items()}


def parse_rankings(value: object) -> dict[tuple[int, ...], int]:
    """Return the rankings in a JSON object such as {"1,2,2": 5}. Raises TypeError or ValueError for anything else."""
    return {_ranks(text): number for text, number in _counts(value, "episodes")}


def parse_clusters(value: object) -> dict[SeedCluster, int]:
    """Return the seed clusters in a JSON object such as {"1,2,2;2,1,3;1,3,2": 5}.

    Raises TypeError or ValueError for anything else.
    """
    return {tuple(map(_ranks, text.split(";"))): number for text, number in _counts(value, "seeds")}


def _ranks(text: str) -> tuple[int, ...]:
    return tuple(int(rank) for rank in text.split(","))


def _counts(value: object, of: str) -> list[tuple[str, int]]:
    if not isinstance(value, dict):
        raise TypeError(f"{str(value)[:40]!r} is no JSON object")
    for number in value.values():
        if isinstance(number, bool) or not isinstance(number, int):
            raise TypeError(f"{str(number)[:40]!r} is no number of {of}")
    return list(value.items())


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
        _check_ranking(ranks, teams)
        if number < 0:
            raise ValueError(f"{number} episodes ended {','.join(map(str, ranks))}")


def check_clusters(rankings: Mapping[tuple[int, ...], int], clusters: Mapping[SeedCluster, int]) -> None:
    """Raise ValueError, with the reason, for seed clusters that a row with these rankings cannot have."""
    teams, own = len(next(iter(rankings), ())), Counter[tuple[int, ...]]()
    for cluster, number in clusters.items():
        if number < 0 or not 2 <= len(cluster) <= teams:
            raise ValueError(f"{number} of its seeds have {len(cluster)} episodes each, among {teams} teams")
        for ranks in cluster:
            _check_ranking(ranks, teams)
        own[cluster[0]] += number
    for ranks, number in own.items():
        if number > rankings.get(ranks, 0):
            ended = f"{','.join(map(str, ranks))}, and {rankings.get(ranks, 0)} episodes"
            raise ValueError(f"{number} of its seeds ended {ended}")


def _check_ranking(ranks: Sequence[int], teams: int) -> None:
    if len(ranks) != teams or competition_ranks(ranks) != tuple(ranks):
        raise ValueError(f"{','.join(map(str, ranks))[:60]} is no ranking of {teams} teams")


FROM_COLUMNS: Mapping[str, Callable[[Sequence[Any]], Any]] = {
    "snapshots": lambda values: tuple_of(str, values[0]),
    "voids_by_team": lambda values: tuple_of(int, values[0]),
    "rankings": lambda values: parse_rankings(values[0]),
    "seed_clusters": lambda values: parse_clusters(values[0]),
}
"""Functions that make a field of a ranked match from its column."""
TO_COLUMN: Mapping[str, Callable[[Any], dict[str, int]]] = {"rankings": rankings_json, "seed_clusters": clusters_json}
"""Functions that make the column of a field whose keys are no text."""
