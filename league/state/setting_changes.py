"""Changes of settings from one run of a league to the next, and of the learner's from a snapshot to the one after it.

Each snapshot keeps the configuration that was in force when it was taken, so the store needs no other record. Loads
neither an arena nor torch; `run_changes` loads the arenas' settings.
"""

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from arenas.arena_settings import Table
from league.config.build import build
from league.config.schema import UNSET, ConfigError, Key, dotted, is_table, key_of, literal, settings
from league.config.sections import PlayerSettings, named_players
from storage.records import Snapshot

OF_RUNS = ("seed", "deterministic", "engine", "arena", "training", "roles")
"""Settings beside the learner's that decide what players learn; players, budgets and workers are told elsewhere."""
OF_LEARNERS = ("class", "settings", "hidden", "lr")  # settings of a player that its learner has


class Ancestor(NamedTuple):
    """A snapshot in a lineage."""

    snapshot: Snapshot
    changes: tuple[str, ...]  # of the learner's settings since the snapshot before it


def lineage(snapshots: Sequence[Snapshot], name: str) -> list[Ancestor]:
    """Return a snapshot and those from which it continues, oldest first; a parent of another league is left out."""
    known = {snapshot.name: snapshot for snapshot in snapshots}
    found = [known[name]]
    while (parent := found[-1].parent) in known and known[parent or ""] not in found:
        found.append(known[parent or ""])
    found.reverse()
    before = ["", *(snapshot.settings for snapshot in found)]
    return [
        Ancestor(snapshot, tuple(learner_changes(earlier, snapshot.settings, snapshot.player)) if earlier else ())
        for earlier, snapshot in zip(before, found, strict=False)
    ]


def learner_changes(before: str, now: str, player: str | None = None) -> list[str]:
    """Return how the learner's settings differ between two configurations as text: `learner.lr 0.001 -> 0.01`.

    With a `player` only its own settings are compared, beside those of the league. Settings that cannot be read, as
    those of another version, count as unchanged.
    """
    if not before:
        return []
    one, other = (_values(text, player) for text in (before, now))
    if one is None or other is None:
        return []
    return _differences(one, other)


def run_changes(before: str, now: str) -> list[str]:
    """Return how the settings OF_RUNS differ between two configurations as text: `training.worlds 64 -> 128`.

    A configuration that cannot be read, as that of another version, counts as unchanged.
    """
    from league.config import experiment

    if not before:
        return []
    try:
        one, other = (dict(_settings_of_runs(experiment.dumps(experiment.loads(text)))) for text in (before, now))
    except (ValueError, ConfigError, RecursionError):
        return []
    return _differences(one, other)


def start_changed(before: str, now: str) -> bool:
    """Return whether `after` differs between two configurations as text, the league's or that of a player of both, or
    `after_parts`.

    It does not if one cannot be read.
    """
    try:
        one, other = (tomllib.loads(text) for text in (before, now))
        theirs, ours = ({each.name: each.after for each in _players(table)} for table in (one, other))
    except (ValueError, ConfigError, RecursionError):
        return False
    changed = any(theirs[name] != ours[name] for name in theirs.keys() & ours.keys())
    return any(one.get(key, []) != other.get(key, []) for key in ("after", "after_parts")) or changed


def _settings_of_runs(text: str) -> Iterator[tuple[str, Any]]:
    """Yield the settings OF_RUNS of a configuration with their dotted keys; records of a list by their names."""
    left: list[tuple[Key, Any]] = [((name,), value) for name, value in tomllib.loads(text).items() if name in OF_RUNS]
    while left:
        key, value = left.pop(0)
        if isinstance(value, list) and value and isinstance(value[0], dict):
            value = {str(each.get("name", number)): each for number, each in enumerate(value)}
        if isinstance(value, dict):
            left = [*(((*key, name), each) for name, each in value.items()), *left]
        else:
            yield dotted(key), value


def _differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    names = [name for name in dict.fromkeys([*one, *other]) if one.get(name) != other.get(name)]
    return [f"{name} {_shown(one, name)} -> {_shown(other, name)}" for name in names]


def _values(text: str, player: str | None) -> dict[str, Any] | None:
    """Return the learners' settings in a configuration by their keys; None for text that cannot be read."""
    from agents.settings import HappoConfig

    try:
        table = tomllib.loads(text)
        learner = build(HappoConfig, table.get("learner", {}))
        found = {dotted(("learner", *key)): value for key, value in _flat(learner) if value is not None}
        players = _players(table)
    except (ValueError, ConfigError, RecursionError):
        return None
    for each in players:
        if player in (None, each.name):
            found |= {
                dotted(("players", each.name, *key)): value
                for key, value in _flat(each)
                if key[0] in OF_LEARNERS and value is not None
            }
    return found


def _players(table: Mapping[str, Any]) -> tuple[PlayerSettings, ...]:
    """Return the players of a configuration, with default names and groups filled in."""
    return named_players(tuple(build(PlayerSettings, each) for each in table.get("players", [])))


def _flat(values: Any, prefix: Key = ()) -> Iterator[tuple[Key, Any]]:
    """Yield each setting of a table with its key, those of tables within it too."""
    for each in settings(values):
        key, value = (*prefix, key_of(each)), getattr(values, each.name)
        if is_table(value):
            yield from _flat(value, key)
        elif isinstance(value, Table):
            yield from (((*key, name), own) for name, own in value.items())
        else:
            yield key, value


def _shown(values: Mapping[str, Any], name: str) -> str:
    return literal(values[name]) if name in values else UNSET
