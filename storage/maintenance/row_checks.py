"""Checks of rows whose values have the right types and yet are impossible: negative counts, contradictory counts."""

import math
import tomllib
from collections.abc import Callable, Mapping
from typing import Any, get_args

from storage.database.rankings import check_clusters, check_rankings, parse_clusters, parse_rankings, tuple_of
from storage.maintenance.row_transfer import is_digest
from storage.records import Purpose

_SIGNED = {("matches", "seed"), ("ranked_matches", "seed"), ("jobs", "priority")}
_NAMES = {"name", "league", "player", "team", "role", "group", "a", "b", "roster", "script", "parent", "host"}
"""Columns shown in tables and lines: a line end in a name could forge a line of output."""


def check_row(table: str, row: Mapping[str, Any]) -> None:
    """Raise ValueError, with the reason, for a complete row of a table that no league can have."""
    for name, value in row.items():
        if isinstance(value, int | float) and value < 0 and (table, name) not in _SIGNED:
            raise ValueError(f"{name} is {value}, below 0")
        if name in _NAMES and isinstance(value, str) and not value.isprintable():
            raise ValueError(f"{name} {value[:40]!r} has characters that are invisible")
    if check := _CHECKS.get(table):
        check(row)


def _league(row: Mapping[str, Any]) -> None:
    try:
        tomllib.loads(row["config"])
    except (ValueError, RecursionError) as error:
        raise ValueError(f"its configuration is not TOML: {error}") from None


def _digest(row: Mapping[str, Any]) -> None:
    if not is_digest(row["digest"]):
        raise ValueError(f"digest {row['digest'][:64]!r} is no blob's name")


def _snapshot(row: Mapping[str, Any]) -> None:
    _digest(row)
    if (row["origin"] == "scripted") != (row["script"] is not None):
        raise ValueError(f"its origin is {row['origin']} and its script {row['script']!r}")
    if row["thinned"] is not None and (row["player"] is None or row["initial"]):
        raise ValueError("it is thinned, but scripts, imports and first policies never are")


def _played(row: Mapping[str, Any]) -> None:
    """Check what rows of both tables of matches have."""
    if row["purpose"] not in get_args(Purpose):
        raise ValueError(f"purpose {row['purpose'][:40]!r} is none of {', '.join(get_args(Purpose))}")
    if row["recording"] is not None and not is_digest(row["recording"]):
        raise ValueError(f"recording {row['recording'][:64]!r} is no blob's name")


def _ranked_match(row: Mapping[str, Any]) -> None:
    _played(row)
    try:
        snapshots, rankings = tuple_of(str, row["snapshots"]), parse_rankings(row["rankings"])
        check_rankings(snapshots, rankings, row["voids"], tuple_of(int, row["voids_by_team"]))
        check_clusters(rankings, parse_clusters(row.get("seed_clusters", {})))
    except TypeError as error:
        raise ValueError(str(error)) from None
    if strange := next((name for name in snapshots if not name.isprintable()), None):
        raise ValueError(f"snapshot {strange[:40]!r} has characters that are invisible")
    if sum(rankings.values()) != row["episodes"]:
        raise ValueError(f"it counts {row['episodes']} episodes, and its rankings {sum(rankings.values())}")


def _match(row: Mapping[str, Any]) -> None:
    _played(row)
    for what in ("wins", "draws", "losses"):
        if row[f"side_{what}"] > row[what]:
            raise ValueError(f"of {row[what]} {what}, {row[f'side_{what}']} were on the first side")
    if row["voids_a"] + row["voids_b"] > row["voids"]:
        raise ValueError(f"of {row['voids']} voids, {row['voids_a']} and {row['voids_b']} were one side's")
    ll, ld, dd_wl, dw, ww = (row[name] for name in ("ll", "ld", "dd_wl", "dw", "ww"))
    pairs, games = ll + ld + dd_wl + dw + ww, row["wins"] + row["draws"] + row["losses"]
    least = {"wins": dw + 2 * ww, "draws": ld + dw, "losses": 2 * ll + ld}
    for what, number in least.items():
        if row[what] < number:
            raise ValueError(f"its seed pairs have at least {number} {what}, and {row[what]} are counted")
    if 2 * pairs > games:
        raise ValueError(f"{pairs} seed pairs are more than {games} games have")


def _curve(row: Mapping[str, Any]) -> None:
    for name, value in row["values"].items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ValueError(f"{name[:40]!r} is no figure")


def _meeting(row: Mapping[str, Any]) -> None:
    if row["chance"] > 1 + 1e-9:
        raise ValueError(f"chance is {row['chance']}, above 1")


def _phase(row: Mapping[str, Any]) -> None:
    if not all(isinstance(name, str) for name in row["learners"]):
        raise ValueError("learners are not names")
    for name, at in row["since"].items():
        if isinstance(at, bool) or not isinstance(at, int) or at < 0:
            raise ValueError(f"since has no iteration for {name[:40]!r}")


_CHECKS: Mapping[str, Callable[[Mapping[str, Any]], None]] = {
    "leagues": _league, "runs": _league, "checkpoints": _digest, "snapshots": _snapshot, "matches": _match,
    "ranked_matches": _ranked_match, "curves": _curve, "meetings": _meeting, "phases": _phase,
}  # fmt: skip
